"""10,000 rolling discs with random starts: quantile bands against time, and what became of every lane.

    python bench/monte_carlo_discs.py [--lanes 10000] [--span 2] [--out bench/results]

Discs of 1 kg and 0.5 m radius start leant, turning and rolling at random; those that lean past 1.5 rad have fallen and stop there. Prints the
count of each outcome, names failed lanes, gives wall time cold (with compilation) and warm, and draws `discs.png`.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj


def random_starts(lanes: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Lean in rad, rates in rad/s."""
    generator = np.random.default_rng(seed)
    return {
        "lean": generator.uniform(-0.6, 0.6, lanes),
        "yaw_rate": generator.normal(0.0, 0.5, lanes),
        "lean_rate": generator.normal(0.0, 0.3, lanes),
        "spin_rate": generator.uniform(-9.0, 0.0, lanes),
    }


def main() -> None:
    """Run, print, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=10_000)
    parser.add_argument("--span", type=float, default=2.0, help="s")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    options = parser.parse_args()
    disc = jj.models.TiltingDisc()
    starts = random_starts(options.lanes)
    settings = {"ts": jnp.linspace(0.0, options.span, 41), "rtol": 1e-6, "atol": 1e-6}
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        rolled = jj.rollout(disc, starts, **settings)
        jax.block_until_ready(rolled.lanes.q)
        seconds.append(time.perf_counter() - begin)
    print(rolled)
    print(f"cold {seconds[0]:.1f} s, warm {seconds[1]:.1f} s ({1e3 * seconds[1] / options.lanes:.2f} ms a lane); jax {jax.__version__}, {jax.devices()[0]}")
    options.out.mkdir(parents=True, exist_ok=True)
    jj.plot(rolled, "lean", "yaw_rate", "x", "y", path=options.out / "discs.png")
    outcome = {"lanes": options.lanes, "failed": rolled.failed.tolist(), "cold_s": seconds[0], "warm_s": seconds[1], "jax": jax.__version__}
    (options.out / "discs.json").write_text(json.dumps(outcome, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
