"""Whether the runs of a fit start on the constraints, at the first guess and where the unknowns are changed."""

from collections.abc import Sequence

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
    guess, layout = unknowns.guess, unknowns.layout
    elsewhere = guess + 1e-3 * unknowns.sizes(guess) * np.where(unknowns.fixed, 0.0, np.sin(1.0 + np.arange(guess.size)))  # by unequal amounts
    for theta, changed in ((guess, False), (elsewhere, True)):
        shared, local = unknowns.split(theta)
        for index, run in enumerate(runs):
            leaves, treedef = jax.tree.flatten((scene, run.start, run.t0, run.inputs))
            numbers = shared, local[index], *leaves
            key = layout, treedef, *(x if callable(x) else np.asarray(x).tobytes() for x in numbers)
            if key in _right:
                continue
            moved, given = layout.scene(scene, shared), layout.start(run.start, local[index])
            try:
                consistent_start(moved, t0=run.t0, inputs=run.inputs, **given)
            except ValueError as error:
                why = "no longer meets the constraints when the unknowns change: the values in `start` depend on each other" if changed else "is not admissible"
                raise ValueError(f"the start of run {index} {why}. {error}") from None
            _right[key] = None
            while len(_right) > MOST:
                del _right[next(iter(_right))]
