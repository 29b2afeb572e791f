"""Families of steady motions of the benchmark bicycle: how long they take, cold in fresh processes and warm,
and how exact they are.

    python bench/families.py [--quick] [--json FILE]

Processor time in seconds. Digits: Meijaard et al. (2007), and Newton-Euler equations in the turning frame for
the turns without hands; an independent integration of the sleigh. Special points of random scenes: closed
forms. 100,000 bicycles are calculated from 5,000, with --quick from 2,000 (compilation left out). `--quick`:
also without derivatives of eigenvalues and of critical speeds, without the chart, and with 30 random scenes
in place of 300. The JSON is a list of {"figure", "model", "value", "required", "met"}.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from figures import compiled, figure, fresh, main, seconds_of
from small_scenes import DrivenSleigh, HoopBead, Twice

import jourdain_jax as jj

SPEEDS = {"weave": 4.292382536341, "capsize": 6.024262015388, "double root": 0.684283078892}  # m/s
TURN = {
    "steer": 0.162268296301,
    "pitch": 0.004456954662,
    "yaw_rate": 0.854379503493,
    "rear_spin_rate": 17.191526326526,
}  # at a lean of 0.4 rad
COLD = {  # a call, the most that it may take, s, and what it is called on
    "closed curve of turns, cold": (
        'jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})', 3.0, "",
    ),
    "linearize, first call after the start": ('jj.linearize(bicycle, start, ("lean", "steer"))', 1.5, ""),
    "derivatives of eigenvalues by all parameters, first call": (
        'small.sensitivities("weave")', 1.5, 'small = jj.linearize(bicycle, start, ("lean", "steer"))',
    ),
    "derivative of the weave speed by the trail, first call": (
        'jax.grad(lambda c: jj.critical(bicycle.replace(c=c), straight, "weave").speed)(bicycle.c)', 3.0,
        'rates = {"x_rate": 5.0, "rear_spin_rate": 16.7, "front_spin_rate": 14.3}\n'
        'straight = jj.family(bicycle, rates, until={"x_rate": 1.0})',
    ),
    "chart of 101 trails against the speed, cold": (
        'jj.stability_chart(bicycle, {"c": (0.02, 0.12), "rear_spin_rate": (5.0, 35.0)})', 5.0, "",
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


def cold(quick):
    """Processor time of calls in fresh processes, without imports, a start and earlier calls."""
    for name, (code, required, first) in list(COLD.items())[: 2 if quick else 5]:
        yield figure(name, NAME, fresh(PROGRAM.format(first, code)), required)


def warm(quick):
    """Processor time of a further point with its eigenvalues, the largest error of a turn, and of the speeds
    of the modes.
    """
    bicycle = jj.models.WhippleBicycle()
    for _ in range(2):  # the first one compiles
        begin = time.process_time()
        turns = jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})
        seconds = (time.process_time() - begin) / len(turns)
    point = max(turns.at(lean=0.4), key=lambda point: point["rear_spin_rate"])
    straight = jj.family(bicycle, turns.branches[-1])
    of_kind = lambda kind: [p for p in straight.changes if p.kind == kind]
    weave, double = of_kind("pair on the imaginary axis"), of_kind("double root")
    found = {"weave": weave, "capsize": straight.branches, "double root": double}
    off = [min(abs(p["x_rate"] - speed) for p in found[name]) for name, speed in SPEEDS.items()]
    of_turn = max(abs(abs(point[name]) - value) for name, value in TURN.items())
    yield figure("a further point with its eigenvalues, warm", NAME, seconds, 3e-3)
    yield figure("error of a turn at 0.4 rad", NAME, of_turn, 1e-10)
    yield figure("error of speeds of modes", NAME, float(max(off)), 1e-9)


def orbits(quick):
    """Errors of the multipliers of a sleigh, and of their derivatives by its torque."""

    def multipliers(torque):
        start = {"x_rate": 0.4, "heading_rate": -0.6}
        found = jj.periodic(DrivenSleigh(torque=torque), start, jnp.pi, held="heading")
        return jnp.real(found.multipliers[1:])

    off = multipliers(0.6) - np.array([0.687051124959, 0.307594179012])
    yield figure("error of multipliers", "driven sleigh", np.max(np.abs(off)), 1e-10)
    off = jax.jacrev(multipliers)(0.6) - np.array([-0.056298649, -0.822442543])
    yield figure("error of their derivatives by the torque", "driven sleigh", np.max(np.abs(off)), 1e-8)


def known_points(kind, draw: np.random.Generator):
    """A random scene with special points of a kind, what `jj.family` takes for it, the name that tells them
    apart, and its values there.
    """
    size, place, width = draw.uniform(0.2, 2.0), draw.uniform(-0.2, 0.2), 10 ** draw.uniform(-3.0, -0.5)
    if kind == "branch point":
        critical = np.sqrt(9.81 / size)
        bead, asked = HoopBead(radius=size, turning=critical / 2), {"until": {"turning": 2 * critical}}
        return bead, {"angle": 0.0}, asked | {"vary": "turning"}, "turning", [critical]
    if kind == "double root":
        critical = -np.sqrt(9.81 / (3 * size))
        start, asked = {"spin_rate": 2 * critical}, {"held": "lean", "until": {"spin_rate": critical / 5}}
        return jj.models.TiltingDisc(radius=size), start, asked, "spin_rate", [critical]
    scene = Twice(push=-1.0, place=place, apart=4 * width**2, damped=float(not kind.startswith("pair")))
    asked, at = {"vary": "push", "until": {"push": 1.0}}, [place - width, place + width]
    return scene, {"x": place - 1.0}, asked, "x", at


def random_scenes(quick):
    """Special points of random scenes that closed forms know: how many are found elsewhere, and the share of
    those that are found.
    """
    kinds = ("fold in push", "zero eigenvalue", "pair on the imaginary axis", "branch point", "double root")
    draw, wrong, found, scenes = np.random.default_rng(48), 0, [], 30 if quick else 300
    for k in range(scenes):
        scene, start, asked, name, at = known_points(kind := kinds[k % 5], draw)
        special = jj.family(scene, start, **asked).special
        points = np.array([point[name] for point in special if point.kind == kind])
        near = np.abs(points[:, None] - at) < 1e-6
        wrong += int(np.sum(~near.any(axis=1)))
        found += [*near.any(axis=0)]
    model = f"{scenes} random scenes"
    yield figure("special points where there are none", model, wrong, 0)
    yield figure("share of special points that are found", model, np.mean(found), least=0.95)


def many(quick):
    """Processor time of weave and capsize speeds of 100,000 bicycles, parameters within 5 %, with derivatives
    by all parameters.
    """
    bicycle, count = jj.models.WhippleBicycle(), 2_000 if quick else 5_000
    straight = jj.family(bicycle, {"rear_spin_rate": 10.0}, until={"rear_spin_rate": 25.0})
    draw, seconds = np.random.default_rng(48), 0.0
    bicycles = jax.tree.map(lambda x: x * draw.uniform(0.95, 1.05, count), bicycle)
    for mode in ("weave", "capsize"):
        speed = lambda scene, mode=mode: jj.critical(scene, straight, mode).speed
        run, _ = compiled(jax.vmap(jax.value_and_grad(speed)), bicycles)
        (speeds, _), of_mode = seconds_of(run)
        seconds += of_mode * 1e5 / count
        yield figure(f"bicycles without a {mode} speed", NAME, int(np.sum(~np.isfinite(speeds))))
    what = f"critical speeds of 100,000 bicycles with derivatives (from {count:,})"
    yield figure(what, NAME, seconds, 60.0)


if __name__ == "__main__":
    main(__doc__, (cold, warm, orbits, random_scenes, many))
