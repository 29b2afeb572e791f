"""Families of steady motions of the benchmark bicycle: how long they take, cold in fresh processes and warm, and how exact they are.

    python bench/families.py [--quick] [--json FILE]

Processor time in seconds. Digits: Meijaard et al. (2007), and Newton-Euler equations in the turning frame for the turns without hands. `--quick`: without
derivatives of eigenvalues and of critical speeds. The JSON is a list of {"figure", "model", "value", "required", "met"}.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

import jourdain_jax as jj

jax.config.update("jax_enable_x64", True)
SPEEDS = {"weave": 4.292382536341, "capsize": 6.024262015388, "double root": 0.684283078892}  # m/s
TURN = {"steer": 0.162268296301, "pitch": 0.004456954662, "yaw_rate": 0.854379503493, "rear_spin_rate": 17.191526326526}  # at a lean of 0.4 rad
COLD = {
    "closed curve of turns, cold": 'jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})',
    "linearize, first call after the start": 'jj.linearize(bicycle, start, ("lean", "steer"))',
    "derivatives of eigenvalues by all parameters, first call": 'small.sensitivities("weave")',
    "derivative of the weave speed by the trail, first call": 'jax.grad(lambda c: jj.critical(bicycle.replace(c=c), straight, "weave").speed)(bicycle.c)',
}
BEGUN = {
    "sensitivities": 'small = jj.linearize(bicycle, start, ("lean", "steer"))',
    "critical": 'straight = jj.family(bicycle, {"x_rate": 5.0, "rear_spin_rate": 16.7, "front_spin_rate": 14.3}, until={"x_rate": 1.0})',
}


def cold(code: str) -> float:
    """Processor time of a call in a fresh process; imports, a start, and what it is called on are left out."""
    first = next((begun for name, begun in BEGUN.items() if f".{name}(" in code), "pass")
    bicycle = "bicycle = jj.models.WhippleBicycle(); start = jj.start(bicycle, **bicycle.upright(5.0))"
    script = f"import time, jax, jourdain_jax as jj; {bicycle}; {first}; begin = time.process_time(); {code}; print(time.process_time() - begin)"
    return float(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout)


def warm(bicycle: jj.Scene) -> tuple[float, float, float]:
    """Processor time of a further point with its eigenvalues, the largest error of a turn, and of the speeds of the modes."""
    turns = jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})
    begin = time.process_time()
    turns = jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})
    seconds = (time.process_time() - begin) / len(turns)
    point = max(turns.at(lean=0.4), key=lambda point: point["rear_spin_rate"])
    straight = jj.family(bicycle, turns.branches[-1])
    found = {
        "weave": [p["x_rate"] for p in straight.changes if p.kind == "pair on the imaginary axis"],
        "capsize": [p["x_rate"] for p in straight.branches],
        "double root": [p["x_rate"] for p in straight.changes if p.kind == "double root"],
    }
    off = [np.min(np.abs(np.asarray(found[name]) - speed)) for name, speed in SPEEDS.items()]
    return seconds, max(abs(abs(point[name]) - value) for name, value in TURN.items()), float(np.max(off))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="without derivatives")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    required = dict(zip(COLD, (3.0, 1.5, 1.5, 3.0), strict=True))
    figures = [(name, cold(code), required[name]) for name, code in list(COLD.items())[: 2 if arguments.quick else 4]]
    seconds, turn, speeds = warm(jj.models.WhippleBicycle())
    figures += [
        ("a further point with its eigenvalues, warm", seconds, 3e-3),
        ("error of a turn at 0.4 rad", turn, 1e-10),
        ("error of speeds of modes", speeds, 1e-9),
    ]
    found = [{"figure": name, "model": "whipple-bicycle", "value": value, "required": limit, "met": value <= limit} for name, value, limit in figures]
    for entry in found:
        print(f"{entry['value']:10.3g}  {entry['figure']} (required {entry['required']:g}){'' if entry['met'] else '  MISS'}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
