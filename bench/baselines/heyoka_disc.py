"""The tilting disc in heyoka: Taylor series of the hand-derived equations, compiled to machine code, alone and in SIMD batches.

    python -m baselines.heyoka_disc [--lanes 1024]        (in `bench/`)

Every trajectory of `disc_run` has its own start; in a batch each SIMD lane takes its own steps. Needs `pip install heyoka` (extra `bench`).
Source: F. Biscani and D. Izzo, Mon. Not. R. Astron. Soc. 504 (2021) 2614.
"""

import argparse
import json
from collections.abc import Callable

import numpy as np

from . import dense, disc_run, heyoka_lowered
from .hand_derived import HAND_DERIVED, tilting_disc
from .heyoka_lowered import MISSING, heyoka
from .timing import fastest


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


def seconds_per_trajectory(tolerance: float, width: int = 1, fast_math: bool = True, lanes: int = disc_run.LANES, repeats: int = 7) -> float:
    """Wall time of all trajectories of the disc run one after another (or batch after batch), over their number; the fastest of some repeats."""
    run, starts = final_states(tolerance, width, fast_math), disc_run.starts(lanes)
    return fastest(lambda: run(starts), repeats) / lanes


def main() -> None:
    """Print one line of JSON per SIMD width: tolerance for a final error of 1e-8, that error, milliseconds per trajectory with and without `fast_math`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=disc_run.LANES)
    lanes = parser.parse_args().lanes
    if heyoka is None:
        print(MISSING)
        return
    starts = disc_run.starts(lanes)
    expected = final_states(1e-15, fast_math=False)(starts)
    for width in sorted({1, heyoka.recommended_simd_size(), 8}):
        tolerance, error = disc_run.loosest(lambda tolerance, width=width: final_states(tolerance, width)(starts), expected)
        times = {f"ms_{name}": 1e3 * seconds_per_trajectory(tolerance, width, fast, lanes) for name, fast in (("fast_math", True), ("as_it_comes", False))}
        print(json.dumps({"heyoka": heyoka.__version__, "width": width, "tolerance": tolerance, "error": error, **times}))


if __name__ == "__main__":
    main()
