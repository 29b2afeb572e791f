"""Looking at a scene with numbers in it, also while its parameters are being traced.

What holds of a scene at every state (the rank of its rows, which speeds are independent) is a static choice: it must be known before
anything is compiled, and it is found by evaluating the scene at a few states.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache, wraps

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.program.uncompiled import uncompiled
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene


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
    """A function of a scene whose answer depends on its class and the shapes of its parameters only: worked out once."""
    known: dict = {}

    @wraps(describe)
    def of(scene: Scene):
        leaves, treedef = jax.tree.flatten(scene)
        key = (treedef, tuple(np.shape(x) for x in leaves), jax.config.jax_enable_x64)
        if key not in known:
            known[key] = describe(scene)
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

    Generic, because a default of zero (a tilt, a rate) must not pass for a term that is absent.
    """
    if not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(scene)):
        return scene
    known = _STAND_IN.get()
    if known is not None and jax.tree.structure(known) == jax.tree.structure(scene):
        near = lambda x, y: _generic(np.asarray(y, x.dtype)) if _is_traced(x) and not _is_traced(y) and np.shape(x) == np.shape(y) else x  # noqa: E731
        scene = jax.tree.map(near, scene, known)
    for name, value, _ in parameters_of(scene):
        if isinstance(value, jax.core.Tracer):
            default = scene.__dataclass_fields__[name].default
            usable = isinstance(default, int | float) or hasattr(default, "shape")
            number = _generic(np.broadcast_to(np.asarray(default, value.dtype), value.shape)) if usable else _near_one(value)
            scene = eqx.tree_at(lambda s, name=name: getattr(s, name), scene, number)
    return jax.tree.map(lambda x: _near_one(x) if isinstance(x, jax.core.Tracer) else x, scene)


def _is_traced(x) -> bool:
    return isinstance(x, jax.core.Tracer)


def _generic(x: np.ndarray) -> np.ndarray:
    return np.asarray(np.where(x == 0, 0.1, x) * (1.0 + 0.01 * np.random.default_rng(0).uniform(size=x.shape)), x.dtype)


def _near_one(x) -> np.ndarray:
    return np.asarray(1.0 + 0.1 * np.random.default_rng(0).uniform(size=x.shape), x.dtype)


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


def _is_none(x) -> bool:
    return x is None
