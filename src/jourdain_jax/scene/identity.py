"""Caches keyed by scene: by its class, the names that its methods read (`outside_names.py`) and the shapes of
its parameters; some caches also by the parameters' values.

Facts that hold at every state of a scene, such as rank and independent speeds, must be known before
compilation. They are determined at a few states, with numbers for the parameters. Reference parameters are
the numbers used in place of traced parameters.
"""

import sys
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import MISSING, fields
from functools import lru_cache, wraps
from operator import is_
from threading import Lock
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.progress import all_objects_kept
from jourdain_jax.calculus.reals import all_finite, is_traced_type, largest
from jourdain_jax.scene.coordinates import stacked_parameters


def clear_caches() -> None:
    """Empty the caches of this package and of JAX, and free their memory.

    Every scene is traced, probed and compiled again at its next use. Call this after changing values in
    helper functions, modules or classes. Machine code is kept: it depends only on the text of its program,
    and another thread may be running it.
    """
    for name, module in list(sys.modules.items()):
        if name.startswith("jourdain_jax.") and ".native" not in name:
            for value in list(vars(module).values()):
                # skip modules: reading them would trigger lazy imports
                if callable(value) and hasattr(value, "cache_clear"):
                    value.cache_clear()
    jax.clear_caches()


def once_per_values(probe, of_traced: Callable | None = None):
    """Decorate a function so that it runs once per class, parameter values and further keys. The function
    gets concrete parameters, even during tracing.

    `of_traced`: a function that is called instead, without caching, for scenes with traced parameters.
    """
    cached = lru_cache(maxsize=512)(lambda wrapped, *case: _described(probe, wrapped.scene, case))

    @wraps(probe)
    def of(scene, *case: Hashable):
        leaves, treedef = jax.tree.flatten(scene)
        known = _asked_about_before(leaves, treedef)
        if known is None:
            reference = with_reference_parameters(scene)
            if reference is not scene:
                if of_traced is not None:
                    return of_traced(scene, *case)
                leaves, treedef = jax.tree.flatten(reference)
            known = Values(leaves, treedef)
            if all(isinstance(x, jax.Array) for x in leaves):
                _latest[:] = [known]
        return cached(known, *case)

    vars(of)["cache_clear"] = cached.cache_clear
    return of


class Values:
    """A hashable key of a scene: its class and the values of its leaves."""

    def __init__(self, leaves: list, treedef):
        self.leaves, self.structure = leaves, (treedef, jax.config.jax_enable_x64)
        self.key = self.structure, tuple((x.tobytes(), x.shape, x.dtype) for x in map(np.asarray, leaves))
        self._hash = hash(self.key)

    @property
    def scene(self):
        """The scene of this key."""
        return jax.tree.unflatten(self.structure[0], self.leaves)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self.key == other.key


# one call looks up one scene several times; JAX arrays are immutable, so their numbers are read once
_latest: list[Values] = []


def _asked_about_before(leaves: list, treedef) -> Values | None:
    """Return the key of the latest scene if its leaves are the same objects as `leaves`."""
    for known in _latest:
        same = len(known.leaves) == len(leaves) and all(map(is_, known.leaves, leaves))
        if same and known.structure == (treedef, jax.config.jax_enable_x64):
            return known
    return None


vars(_asked_about_before)["cache_clear"] = _latest.clear

_STAND_IN: ContextVar[tuple] = ContextVar("stand_in", default=(None, None))


@contextmanager
def reference_parameters(scene, varied: Collection[str] | None = None) -> Iterator[None]:
    """Return a context in which the values of `scene` replace traced parameters of scenes of the
    same structure.

    `varied`: names of the parameters (None: all) that get generic numbers near those of `scene`.
    """
    token = _STAND_IN.set((scene, varied))
    try:
        yield
    finally:
        _STAND_IN.reset(token)


def with_reference_parameters(scene):
    """Return the scene with generic numbers in place of traced parameters: near the reference, near the
    class's defaults, or near one.

    Generic numbers keep terms that a default of zero (a tilt, a rate) would hide, and tell two
    lengths with equal defaults apart.
    """
    leaves, treedef = jax.tree.flatten(scene)
    unknown = [is_traced_type(type(x)) for x in leaves]
    if not any(unknown):
        return scene
    near, vary = _defaults(scene), [True] * len(leaves)
    known, varied = _STAND_IN.get()
    if known is not None and jax.tree.structure(known) == treedef:
        for place, (path, y) in enumerate(jax.tree_util.tree_leaves_with_path(known)):
            if not is_traced_type(type(y)) and np.shape(y) == np.shape(leaves[place]):
                near[place], vary[place] = y, varied is None or path[0].name in varied
    for place in np.flatnonzero(unknown):
        x, y = leaves[place], near[place]
        leaves[place] = _generic(x, y, place) if vary[place] else np.asarray(y, x.dtype)
    return jax.tree.unflatten(treedef, leaves)


def with_usual_parameters(scene):
    """Return the scene with the class's defaults as parameters, and numbers near one where there are none;
    and whether all have defaults.
    """
    leaves, treedef = jax.tree.flatten(scene)
    pairs = list(zip(leaves, _defaults(scene), strict=True))
    stated = [y is not None and np.shape(y) == np.shape(x) for x, y in pairs]
    usual = [
        np.asarray(y, x.dtype) if known else _generic(x, y, place)
        for place, ((x, y), known) in enumerate(zip(pairs, stated, strict=True))
    ]
    return jax.tree.unflatten(treedef, usual), all(stated)


def _defaults(scene) -> list:
    """Return the class's default for every leaf of a scene; None for a leaf without one."""
    found: list = []
    for field in fields(scene):
        if field.metadata.get("static", False):
            continue
        count = len(jax.tree.leaves(getattr(scene, field.name)))
        stated = field.default if field.default_factory is MISSING else field.default_factory()
        stated = None if stated is MISSING else stated
        default = jax.tree.leaves(stated)
        found += default if len(default) == count else [stated if count == 1 else None] * count
    return found


def _generic(x, near, place: int) -> np.ndarray:
    """Return numbers of the shape of x near the given ones (or near one), different for every `place`."""
    draws = np.random.default_rng(place).uniform(size=np.shape(x))
    try:
        near = np.broadcast_to(np.asarray(near, x.dtype), np.shape(x))
    except (TypeError, ValueError):  # not numbers, or a shape that does not fit
        near = np.full(np.shape(x), np.nan)
    if not all_finite(near):
        # sorted: sample points of a table must increase
        return np.asarray(1.0 + 0.1 * (np.sort(draws) if draws.ndim == 1 else draws), x.dtype)
    if near.ndim == 1 and near.size > 1 and np.all(np.diff(near) > 0):
        steps = np.diff(near, append=2 * near[-1] - near[-2])
        return np.asarray(near + 0.01 * draws * steps, x.dtype)
    return np.asarray(varied(near, 0.01 * draws, 0.1), x.dtype)


def varied(given: np.ndarray, change: Float[np.ndarray, "*more"], zero: float) -> np.ndarray:
    """Return the numbers `given`, changed by the fractions `change`, which may have leading axes. A
    number that is 0 counts as `zero`.

    If the entries of an inertia tensor I were changed separately, the result might belong to no body. Instead
    the body is stretched, sheared and rotated by a small matrix E:

        S = tr(I)/2 1 - I,      S' = (1 + E) S (1 + E)',      I' = tr(S') 1 - S'
    """
    given = np.asarray(given)
    if not _is_inertia(given):
        return np.where(given == 0, zero, given) * (1 + change)
    F = np.eye(3) + change / 2
    S = F @ _second_moments(given) @ np.swapaxes(F, -1, -2)
    return np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S


def _second_moments(I: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    return np.trace(I) / 2 * np.eye(3) - I


def _is_inertia(x: np.ndarray) -> bool:
    """Return whether the array may be an inertia tensor and is not a rotation matrix. The tolerance is one
    per cent, the accuracy of published moments.
    """
    if x.shape != (3, 3) or not np.any(x) or np.any(np.abs(x - x.T) > 1e-9 * largest(x)):
        return False
    if np.allclose(x @ x.T, np.eye(3)):
        return False
    return bool(np.linalg.eigvalsh(_second_moments(x))[0] >= -0.01 * np.trace(x))


def once_per_class(describe: Callable, most: int = 1024) -> Callable:
    """Decorate a function so that it runs once per class, shapes of the parameters and further keys. Its
    result must depend on these alone.

    `most`: maximum number of stored results.
    """
    known: dict = {}
    keeping = Lock()  # two threads may compute the same result

    @wraps(describe)
    def of(scene, *case: Hashable):
        leaves, treedef = jax.tree.flatten(scene)
        key = (treedef, tuple(np.shape(x) for x in leaves), jax.config.jax_enable_x64, case)
        if (found := known.get(key)) is None:
            found = (_described(describe, scene, case),)
            with keeping:
                known[key] = found
                if len(known) > most:
                    known.pop(next(iter(known)))  # the oldest
        return found[0]

    vars(of)["cache_clear"] = known.clear
    return of


_BEFORE: ContextVar[Mapping[Hashable, Any]] = ContextVar("before", default=MappingProxyType({}))


@contextmanager
def found_before(found: Mapping[Hashable, Any]) -> Iterator[None]:
    """Return a context in which decorated functions take their results from `found`: function name and first
    further key -> result.
    """
    token = _BEFORE.set(found)
    try:
        yield
    finally:
        _BEFORE.reset(token)


@all_objects_kept()
def _described(describe: Callable, scene, case: tuple):
    if (key := (describe.__name__, *case[:1])) in (before := _BEFORE.get()):
        return before[key]
    try:
        return describe(scene, *case)
    except (TypeError, ValueError) as error:
        if many := stacked_parameters(scene):
            raise ValueError(f"{many} ({error})") from error
        raise
