"""The tilting disc in heyoka: Taylor series of the hand-derived equations, compiled to machine code, alone and in SIMD batches.

Every trajectory of `disc_run` has its own start; in a batch each SIMD lane takes its own steps. Needs `pip install heyoka` (extra `bench`).
Source: F. Biscani and D. Izzo, Mon. Not. R. Astron. Soc. 504 (2021) 2614.
"""

from collections.abc import Callable

import numpy as np

from . import dense, disc_run, heyoka_lowered
from .hand_derived import HAND_DERIVED, tilting_disc
from .heyoka_lowered import MISSING, heyoka


def system() -> list:
    """The hand-derived equations as heyoka takes them."""
    if heyoka is None:
        raise ImportError(MISSING)
    known = HAND_DERIVED["tilting-disc"]
    y = heyoka.make_vars(*known.coordinates, *known.speeds)
    qdot, vdot = tilting_disc(dense.DISC_PARAMETERS, heyoka.time, tuple(y[:5]), tuple(y[5:]), xp=heyoka)
    return list(zip(y, (*qdot, *vdot), strict=True))


def final_states(tolerance: float, width: int = 1, fast_math: bool = True) -> Callable[[np.ndarray], np.ndarray]:
    """A compiled function from initial minimal states (lanes, 8) to final ones.

    **Arguments:** `tolerance` of the Taylor steps; `width`, trajectories per SIMD batch, which must divide the number of lanes (1: no batches);
    `fast_math`, which lets the compiler reorder sums: faster by a quarter here, with the same error.
    **Raises:** `ImportError` where heyoka is not installed; `ValueError` where an integration does not reach its end.
    """
    return heyoka_lowered.final_states(system(), disc_run.END, tolerance, width, fast_math=fast_math)
