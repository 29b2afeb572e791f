"""Whether the runs of a fit start on the constraints, at the first guess and where the unknowns are changed."""

from collections.abc import Sequence

import jax
import numpy as np

from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.unknowns import Unknowns
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.scene.scene import Scene

MOST = 4096  # kinds of starts that were found right, and are not looked at again

_right: dict[tuple, None] = {}


def check_starts(scene: Scene, runs: Sequence[Experiment], unknowns: Unknowns) -> None:
    """ValueError unless the start of each run meets the constraints at the first guess, and still does when the unknowns change.

    Where it did at other numbers of the unknowns, this is no matter of the numbers, and it is not looked at again: a look at new parameters takes longer than
    a fit. Where the motion fails at the first guess, ask `check_first_guess`.
    """
    guess = unknowns.guess
    leaves, treedef = jax.tree.flatten(scene)
    for index, run in enumerate(runs):
        if (key := _key(leaves, treedef, run, unknowns, index)) in _right:
            continue
        elsewhere = guess + 1e-3 * unknowns.sizes(guess) * np.where(unknowns.fixed, 0.0, np.sin(1.0 + np.arange(guess.size)))  # by unequal amounts
        _check(scene, run, unknowns, guess, index, "is not admissible")
        _check(scene, run, unknowns, elsewhere, index, "no longer meets the constraints when the unknowns change: the values in `start` depend on each other")
        _right[key] = None
        while len(_right) > MOST:
            del _right[next(iter(_right))]


def check_first_guess(scene: Scene, runs: Sequence[Experiment], unknowns: Unknowns) -> None:
    """ValueError unless the start of each run meets the constraints at the first guess."""
    for index, run in enumerate(runs):
        _check(scene, run, unknowns, unknowns.guess, index, "is not admissible")


def _key(leaves: list, treedef, run: Experiment, unknowns: Unknowns, index: int) -> tuple:
    """What a start consists of, and its numbers but for those of unknowns. `leaves`, `treedef`: of the scene."""
    layout = unknowns.layout
    others, of_run = jax.tree.flatten((run.t0, run.inputs))
    shared, local = unknowns.split(np.where(unknowns.fixed, unknowns.guess, 0.0))
    start = layout.start(run.start, local[index])
    return layout, treedef, of_run, *start, *map(_content, (*others, *layout.leaves(leaves, treedef, shared), *start.values()))


def _content(x):
    return x if callable(x) else np.asarray(x).tobytes()


def _with(scene: Scene, run: Experiment, unknowns: Unknowns, theta: np.ndarray, index: int) -> tuple[Scene, dict]:
    shared, local = unknowns.split(theta)
    return unknowns.layout.scene(scene, shared), unknowns.layout.start(run.start, local[index])


def _check(scene: Scene, run: Experiment, unknowns: Unknowns, theta: np.ndarray, index: int, why: str) -> None:
    moved, given = _with(scene, run, unknowns, theta, index)
    try:
        consistent_start(moved, t0=run.t0, inputs=run.inputs, **given)
    except ValueError as error:
        raise ValueError(f"the start of run {index} {why}. {error}") from None
