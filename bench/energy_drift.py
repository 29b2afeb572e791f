"""How far the energy of right motions drifts, over what errors of their steps explain: the ground on which `ENERGY_LOST` stands.

    python bench/energy_drift.py [--quick] [--json FILE]

Every model runs three times its example's span at tolerances of 1e-4, 1e-8 and 1e-11, with 2 and with 201 saved times. With dE the change of T + V by errors
of `atol + rtol |y|` in all numbers of the state, N steps may change T + V - W by some N dE. The engine calls a motion lost from ten times of it on, where
that is more than 1 % of the energy that moves.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from jourdain_jax.motion.energy_check import DRIFTED, MOST_STEP_ERRORS
from jourdain_jax.motion.trajectories.results import ENERGY_LOST

jax.config.update("jax_enable_x64", True)
TOLERANCES = (1e-4, 1e-8, 1e-11)
SAVED = (2, 201)


@jax.jit
def _energies(motion, tolerance):
    """T + V along a motion, and dE."""

    def near(t, q, u):
        off = [x + jnp.where(x < 0, -1.0, 1.0) * tolerance * (1 + jnp.abs(x)) for x in (q, u)]
        here, there = jj.energy(motion.scene, t, q, u, motion.inputs(t)), jj.energy(motion.scene, t, *off, motion.inputs(t))
        return here.kinetic, here.potential, jnp.abs(there.kinetic - here.kinetic) + jnp.abs(there.potential - here.potential)

    return jax.vmap(near)(motion.ts, motion.q, motion.u)


def drift(scene, tolerance: float, saved: int) -> tuple[float, float, bool]:
    """Drift over N dE, drift over the energy that moves, and whether the engine calls the motion lost."""
    ts = np.linspace(0.0, 3 * float(scene.example_span), saved)
    motion = jj.simulate(scene, scene.example, ts=ts, rtol=tolerance, atol=tolerance)
    T, V, error = (np.asarray(x) for x in _energies(motion, tolerance))
    balance = T + V - (0.0 if motion.work is None else np.asarray(motion.work))
    size, changed = np.nanmax(T) + np.ptp(V[np.isfinite(V)]), np.nanmax(balance) - np.nanmin(balance)
    explained = int(motion.accepted) * (np.nanmax(error) + np.finfo(float).eps * np.nanmax(np.abs(T) + np.abs(V)))
    return changed / explained, changed / size, int(motion.result) == ENERGY_LOST


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="three models")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    names = ("tilting-disc", "chaplygin-sleigh", "skate") if arguments.quick else tuple(jj.models.MODELS)
    found = []
    for name in names:
        scene = jj.models.MODELS[name]()
        cells = {(tolerance, saved): drift(scene, tolerance, saved) for tolerance in TOLERANCES for saved in SAVED}
        worst = max(cells.values())
        lost = any(cell[2] for cell in cells.values())
        print(f"{name:28s} drift / (N dE) at most {worst[0]:.1e}, drift / energy that moves at most {max(cell[1] for cell in cells.values()):.1e}", flush=True)
        figure = f"energy drift over N dE at most; lost from {MOST_STEP_ERRORS} and {DRIFTED:.0%} of the energy on"
        found.append({"figure": figure, "model": name, "value": worst[0], "required": MOST_STEP_ERRORS, "met": bool(worst[0] < MOST_STEP_ERRORS and not lost)})
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
