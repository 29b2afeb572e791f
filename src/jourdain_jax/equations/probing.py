"""Looking at a scene with numbers in it, also while its parameters are being traced.

What holds of a scene at every state (the rank of its rows, which speeds are independent) is a static choice: it must be known before
anything is compiled, and it is found by evaluating the scene at a few states.
"""

import gc
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from functools import lru_cache, wraps
from inspect import signature

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.program.uncompiled import uncompiled
from jourdain_jax.scene.numbers import is_traced
from jourdain_jax.scene.scene import Scene

MOST_CASES = 1024  # that are kept of one function


@contextmanager
def without_collecting() -> Iterator[None]:
    """Garbage collection off: what is built meanwhile is many small objects, nearly all of which stay, and looking through them takes a tenth of the time."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def probed_once(probe):
    """A function of a scene that runs on concrete parameters, also while they are traced, and once per class and values."""
    cached = lru_cache(maxsize=512)(lambda wrapped: probe(wrapped.scene))

    @wraps(probe)
    def of(scene: Scene):
        concrete = concretised(scene)
        leaves, treedef = jax.tree.flatten(concrete)
        key = tuple((np.asarray(x).tobytes(), np.shape(x), str(np.asarray(x).dtype)) for x in leaves)
        return cached(_Hashable(concrete, (treedef, key, type(scene))))

    return of


def described_once(describe: Callable) -> Callable:
    """A function of a scene (and of what else tells its cases apart) that depends on its class and the shapes of its parameters only: worked out once."""
    known: dict = {}

    @wraps(describe)
    def of(scene: Scene, *case: Hashable):
        leaves, treedef = jax.tree.flatten(scene)
        key = (treedef, tuple(np.shape(x) for x in leaves), jax.config.jax_enable_x64, case)
        if key not in known:
            if len(known) >= MOST_CASES:
                known.pop(next(iter(known)))  # the oldest
            known[key] = describe(scene, *case)
        return known[key]

    return of


class _Hashable:
    """A scene with the key it is cached by."""

    def __init__(self, scene, key):
        self.scene, self.key = scene, key

    def __hash__(self):
        return hash(self.key)

    def __eq__(self, other):
        return self.key == other.key


_STAND_IN: ContextVar[Scene | None] = ContextVar("stand_in", default=None)


@contextmanager
def standing_in(scene: Scene) -> Iterator[None]:
    """Inside, numbers near those of `scene` stand in for the parameters of scenes of its class that are traced (as far as it has numbers)."""
    token = _STAND_IN.set(scene)
    try:
        yield
    finally:
        _STAND_IN.reset(token)


def concretised(scene: Scene) -> Scene:
    """The scene with numbers in place of traced parameters: generic ones near those that stand in, the class's defaults, or one.

    Generic, because a default of zero (a tilt, a rate) must not pass for a term that is absent, nor two equal defaults for one length.
    """
    leaves, treedef = jax.tree.flatten(scene)
    if not any(_is_traced(x) for x in leaves):
        return scene
    near = _defaults(scene)
    known = _STAND_IN.get()
    if known is not None and jax.tree.structure(known) == treedef:
        near = [y if _is_number(y) and np.shape(y) == np.shape(x) else d for x, y, d in zip(leaves, jax.tree.leaves(known), near, strict=True)]
    numbers = [_generic(x, y, place) if _is_traced(x) else x for place, (x, y) in enumerate(zip(leaves, near, strict=True))]
    return jax.tree.unflatten(treedef, numbers)


def _defaults(scene: Scene) -> list:
    """The class's default for every leaf of a scene, or None."""
    found: list = []
    for field in fields(scene):
        if field.metadata.get("static", False):
            continue
        leaves = jax.tree.leaves(getattr(scene, field.name))
        default = jax.tree.leaves(field.default)
        if len(default) != len(leaves):
            default = [field.default if len(leaves) == 1 else None] * len(leaves)
        found += default
    return found


def _is_traced(x) -> bool:
    return isinstance(x, jax.core.Tracer)


def _is_number(x) -> bool:
    return x is not None and not _is_traced(x)


def _generic(x, near, place: int) -> np.ndarray:
    """Numbers of the shape of x, near what is given (or one), unlike those at any other `place`."""
    draws = np.random.default_rng(place).uniform(size=np.shape(x))
    try:
        near = np.broadcast_to(np.asarray(near, x.dtype), np.shape(x))
    except (TypeError, ValueError):  # no numbers, or as many of them as do not fit
        near = np.full(np.shape(x), np.nan)
    if not np.all(np.isfinite(near)):
        return np.asarray(1.0 + 0.1 * (np.sort(draws) if draws.ndim == 1 else draws), x.dtype)  # knots of a table increase
    if near.ndim == 1 and near.size > 1 and np.all(np.diff(near) > 0):
        steps = np.diff(near, append=2 * near[-1] - near[-2])
        return np.asarray(near + 0.01 * draws * steps, x.dtype)
    return np.asarray(np.where(near == 0, 0.1, near) * (1.0 + 0.01 * draws), x.dtype)


class Seldom:
    """Counts calls: true for the first `often` ones of a kind, if their numbers are known. So long compiling does not pay (`on_numbers` instead)."""

    def __init__(self, often: int):
        self.often = often
        self._calls: Counter[Hashable] = Counter()

    def __call__(self, kind: Hashable, numbers) -> bool:
        """Whether this call of that kind is one of the first; `numbers`: anything with leaves."""
        if is_traced(numbers):
            return False
        self._calls[kind] += 1
        return self._calls[kind] <= self.often


def on_numbers(f: Callable) -> Callable:
    """`f` run at once on concrete arguments, uncompiled: NumPy arrays out, also while something else is being traced."""

    @lru_cache(maxsize=32)
    def program(treedef, rest, x64):
        return uncompiled(lambda numbers: f(*eqx.combine(numbers, jax.tree.unflatten(treedef, rest))))

    @wraps(f)
    def run(*arguments):
        arguments = jax.tree.map(lambda x: np.asarray(x) if eqx.is_array_like(x) else x, arguments)
        numbers, others = eqx.partition(arguments, eqx.is_array)
        rest, treedef = jax.tree.flatten(others, is_leaf=_is_none)
        return program(treedef, tuple(rest), jax.config.jax_enable_x64)(numbers)

    return run


def at_once(f: Callable) -> Callable:
    """`f` of numbers run uncompiled, so that a first call at a prompt takes a tenth of the time; of traced values, as it stands.

    What `f` finds out by the scene's own numbers (rank, privileged speeds) must be among its arguments: inside, the numbers are traced.
    """
    known, parameters = on_numbers(f), signature(f)

    @wraps(f)
    def run(*given, **named):
        bound = parameters.bind(*given, **named)
        bound.apply_defaults()
        arguments = bound.args
        return f(*arguments) if is_traced(arguments) else jax.tree.map(jnp.asarray, known(*arguments))

    return run


def _is_none(x) -> bool:
    return x is None
