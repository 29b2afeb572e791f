"""Whether the runs of a fit start on the constraints, at the first guess and where the unknowns are changed."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from jourdain_jax.analysis.measurements import Measurements
from jourdain_jax.analysis.unknowns import Unknowns
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.scene.scene import Scene

MOST = 4096  # starts that were found right, and are not looked at again

_right: dict[tuple, None] = {}


def check_starts(scene: Scene, runs: Sequence[Measurements], unknowns: Unknowns) -> None:
    """ValueError unless the start of each run meets the constraints at the first guess, and still does when the unknowns change."""
    guess = unknowns.guess
    elsewhere = guess + 1e-3 * unknowns.sizes(guess) * np.where(unknowns.fixed, 0.0, np.sin(1.0 + np.arange(guess.size)))  # by unequal amounts
    of_scene = jax.tree.flatten(scene)
    for index, run in enumerate(runs):
        key = _key(*of_scene, run, unknowns, index)
        if (here := key(guess)) in _right:
            continue
        _check(scene, run, unknowns, guess, index, "is not admissible")
        # whether given values depend on each other is no matter of the numbers that change
        if (changed := key(np.where(unknowns.fixed, guess, 0.0))) not in _right:
            _check(
                scene, run, unknowns, elsewhere, index, "no longer meets the constraints when the unknowns change: the values in `start` depend on each other"
            )
        _right.update({here: None, changed: None})
        while len(_right) > MOST:
            del _right[next(iter(_right))]


def _key(leaves: list, treedef, run: Measurements, unknowns: Unknowns, index: int) -> Callable[[np.ndarray], tuple]:
    """A function of the unknowns: all numbers of the start of a run with these, and what is no number. `leaves`, `treedef`: of the scene."""
    layout = unknowns.layout
    others, of_run = jax.tree.flatten((run.t0, run.inputs))
    fixed = (layout, treedef, of_run, *map(_content, others))

    def key(theta: np.ndarray) -> tuple:
        shared, local = unknowns.split(theta)
        start = layout.start(run.start, local[index])
        return *fixed, *start, *map(_content, layout.leaves(leaves, treedef, shared)), *map(_content, start.values())

    return key


def _content(x):
    return x if callable(x) else np.asarray(x).tobytes()


def _with(scene: Scene, run: Measurements, unknowns: Unknowns, theta: np.ndarray, index: int) -> tuple[Scene, dict]:
    shared, local = unknowns.split(theta)
    return unknowns.layout.scene(scene, shared), unknowns.layout.start(run.start, local[index])


def _check(scene: Scene, run: Measurements, unknowns: Unknowns, theta: np.ndarray, index: int, why: str) -> None:
    moved, given = _with(scene, run, unknowns, theta, index)
    try:
        consistent_start(moved, t0=run.t0, inputs=run.inputs, **given)
    except ValueError as error:
        raise ValueError(f"the start of run {index} {why}. {error}") from None
