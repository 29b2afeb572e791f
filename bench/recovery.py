"""What recovering coordinates by quadrature does: error of the recovered coordinates against closed forms, steps and time, with and without.

    taskset -c 0 python bench/recovery.py [--quick] [--json FILE]

Seen: as many steps as without (the speeds of both scenes decide them anyway), and errors alike; where no speed changes, steps grow beyond what the
recovered coordinates bear, and `quadrature_error` says so. Writes a list of {"model", "recover", "tolerance", "error", "steps", "rejected",
"microseconds", "quadrature_error"}: 10 s of the tilting disc, of the Chaplygin sleigh, and of the upright disc on a circle, with one time saved; one
motion inside the user's `jit`, fastest of some warm runs.
"""

import argparse
import json
import os
import sys

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "tests"))

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines.timing import fastest
from oracles import chaplygin_sleigh, rolling_disc

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, TiltingDisc, VerticalDisc

SPAN = 10.0  # s
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


def tilting_disc():
    """Scene, start, and the recovered coordinates at the end."""
    run = {name: value for name, value in rolling_disc.RUN.items() if name != "t_end"}
    end = rolling_disc.motion_yaw_lean_spin(np.array([0.0, SPAN]), **run)
    scene = TiltingDisc(**{name: run.pop(name) for name in ("mass", "radius", "gravity")})
    return scene, run, {name: float(end[name][-1]) for name in ("x", "y", "yaw", "spin")}


def sleigh():
    """The same."""
    run = {name: value for name, value in chaplygin_sleigh.RUN.items() if name != "t_end"}
    end = chaplygin_sleigh.motion(np.array([0.0, SPAN]), **run)
    start = {"x": 0.0, "y": 0.0, "heading": 0.0, "x_rate": run["v0"], "y_rate": run["a"] * run["w0"], "heading_rate": run["w0"]}
    return ChaplyginSleigh(mass=run["mass"], inertia=run["inertia"], offset=run["a"]), start, {name: float(end[name][-1]) for name in ("x", "y")}


def upright_disc():
    """The same: on a circle, where no speed changes."""
    turn, roll = 5.0, 4.0
    end = {"x": roll / turn * np.sin(turn * SPAN), "y": roll / turn * (1 - np.cos(turn * SPAN)), "heading": turn * SPAN, "roll": roll * SPAN}
    return VerticalDisc(radius=1.0), {"heading_rate": turn, "roll_rate": roll}, end


def entries(make, tolerances, repeats: int):
    """One entry per tolerance and way."""
    scene, start, end = make()
    start = jj.start(scene, **start)
    for tolerance in tolerances:
        for way in (None, "quadrature"):

            @jax.jit
            def motion(start, tolerance=tolerance, way=way):
                options = {"rtol": tolerance, "atol": tolerance, "recover": way, "projection": False, "adjoint": diffrax.ForwardMode()}
                return jj.simulate(scene, start, ts=jnp.array([SPAN]), **options)

            found = motion(start)
            yield {
                "model": type(scene).__name__,
                "recover": way,
                "tolerance": tolerance,
                "error": max(abs(float(found[name][-1]) - value) for name, value in end.items()),
                "steps": int(found.accepted),
                "rejected": int(found.rejected),
                "microseconds": 1e6 * fastest(lambda motion=motion: jax.block_until_ready(motion(start).q_end), repeats),
                "quadrature_error": float(found.quadrature_error),
            }


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two tolerances, few repeats")
    parser.add_argument("--json", help="file to write")
    options = parser.parse_args()
    found = []
    for make in (tilting_disc, sleigh, upright_disc):
        for entry in entries(make, TOLERANCES[::2] if options.quick else TOLERANCES, 20 if options.quick else 200):
            found.append(entry)
            print("  ".join(f"{value:.3g}" if isinstance(value, float) else f"{value!s:>12}" for value in entry.values()), flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(found, file, indent=1)


if __name__ == "__main__":
    main()
