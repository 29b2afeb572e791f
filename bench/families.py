"""Families of steady motions of the benchmark bicycle: how long they take, cold in fresh processes and warm, and how exact they are.

    python bench/families.py [--quick] [--json FILE]

Processor time in seconds. Digits: Meijaard et al. (2007), and Newton-Euler equations in the turning frame for the turns without hands. `--quick`: without
derivatives of eigenvalues and of critical speeds. The JSON is a list of {"figure", "model", "value", "required", "met"}.
"""

import time

import jax
import numpy as np
from figures import Figures, figure, fresh, main

import jourdain_jax as jj

jax.config.update("jax_enable_x64", True)
SPEEDS = {"weave": 4.292382536341, "capsize": 6.024262015388, "double root": 0.684283078892}  # m/s
TURN = {"steer": 0.162268296301, "pitch": 0.004456954662, "yaw_rate": 0.854379503493, "rear_spin_rate": 17.191526326526}  # at a lean of 0.4 rad
COLD = {  # a call, the most that it may take, s, and what it is called on
    "closed curve of turns, cold": ('jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})', 3.0, ""),
    "linearize, first call after the start": ('jj.linearize(bicycle, start, ("lean", "steer"))', 1.5, ""),
    "derivatives of eigenvalues by all parameters, first call": (
        'small.sensitivities("weave")', 1.5, 'small = jj.linearize(bicycle, start, ("lean", "steer"))',
    ),
    "derivative of the weave speed by the trail, first call": (
        'jax.grad(lambda c: jj.critical(bicycle.replace(c=c), straight, "weave").speed)(bicycle.c)', 3.0,
        'straight = jj.family(bicycle, {"x_rate": 5.0, "rear_spin_rate": 16.7, "front_spin_rate": 14.3}, until={"x_rate": 1.0})',
    ),
}  # fmt: skip
PROGRAM = """
import time, jax, jourdain_jax as jj
bicycle = jj.models.WhippleBicycle()
start = jj.start(bicycle, **bicycle.upright(5.0))
{}
begin = time.process_time()
{}
print(time.process_time() - begin)
"""
NAME = "whipple-bicycle"


def cold(quick: bool) -> Figures:
    """Processor time of calls in fresh processes; imports, a start, and what they are called on are left out."""
    for name, (code, required, first) in list(COLD.items())[: 2 if quick else 4]:
        yield figure(name, NAME, fresh(PROGRAM.format(first, code)), required)


def warm(quick: bool) -> Figures:
    """Processor time of a further point with its eigenvalues, the largest error of a turn, and of the speeds of the modes."""
    bicycle = jj.models.WhippleBicycle()
    for _ in range(2):  # the first one compiles
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
    yield figure("a further point with its eigenvalues, warm", NAME, seconds, 3e-3)
    yield figure("error of a turn at 0.4 rad", NAME, max(abs(abs(point[name]) - value) for name, value in TURN.items()), 1e-10)
    yield figure("error of speeds of modes", NAME, float(np.max(off)), 1e-9)


if __name__ == "__main__":
    main(__doc__, (cold, warm))
