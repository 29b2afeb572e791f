"""Families of steady motions of the benchmark bicycle: how long they take, cold in fresh processes and warm,
and how exact they are.

    python bench/families.py [--quick] [--json FILE]

Processor time in seconds. Digits: Meijaard et al. (2007), and Newton-Euler equations in the turning frame for
the turns without hands; an independent integration of the sleigh. Special points of random scenes: closed
forms. 100,000 bicycles are calculated from 5,000, with --quick from 2,000 (compilation left out). `--quick`:
also without derivatives of eigenvalues and of critical speeds, without the chart, and with 30 random scenes
in place of 300. The JSON is a list of {"figure", "model", "value", "required", "met"}.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from figures import HERE, Figures, compiled, figure, fresh, main, seconds_of

sys.path.insert(0, str(HERE.parent / "tests"))  # small scenes that tests use, too
from small_scenes import DrivenSleigh, HoopBead, Twice

import jourdain_jax as jj

jax.config.update("jax_enable_x64", True)
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


def cold(quick: bool) -> Figures:
    """Processor time of calls in fresh processes, without imports, a start and earlier calls."""
    for name, (code, required, first) in list(COLD.items())[: 2 if quick else 5]:
        yield figure(name, NAME, fresh(PROGRAM.format(first, code)), required)


def warm(quick: bool) -> Figures:
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
    found = {
        "weave": [p["x_rate"] for p in straight.changes if p.kind == "pair on the imaginary axis"],
        "capsize": [p["x_rate"] for p in straight.branches],
        "double root": [p["x_rate"] for p in straight.changes if p.kind == "double root"],
    }
    off = [np.min(np.abs(np.asarray(found[name]) - speed)) for name, speed in SPEEDS.items()]
    yield figure("a further point with its eigenvalues, warm", NAME, seconds, 3e-3)
    yield figure(
        "error of a turn at 0.4 rad",
        NAME,
        max(abs(abs(point[name]) - value) for name, value in TURN.items()),
        1e-10,
    )
    yield figure("error of speeds of modes", NAME, float(np.max(off)), 1e-9)


def orbits(quick: bool) -> Figures:
    """Errors of the multipliers of a sleigh, and of their derivatives by its torque."""

    def multipliers(torque):
        start = {"x_rate": 0.4, "heading_rate": -0.6}
        return jnp.real(
            jj.periodic(DrivenSleigh(torque=torque), start, jnp.pi, held="heading").multipliers[1:]
        )

    off = [
        multipliers(0.6) - np.array([0.687051124959, 0.307594179012]),
        jax.jacrev(multipliers)(0.6) - np.array([-0.056298649, -0.822442543]),
    ]
    for name, error, most in zip(
        ("multipliers", "their derivatives by the torque"), off, (1e-10, 1e-8), strict=True
    ):
        yield figure(f"error of {name}", "driven sleigh", float(np.max(np.abs(error))), most)


def known_points(kind: str, draw: np.random.Generator) -> tuple:
    """A random scene with special points of a kind, what `jj.family` takes for it, the name that tells them
    apart, and its values there.
    """
    size, place, width = draw.uniform(0.2, 2.0), draw.uniform(-0.2, 0.2), 10 ** draw.uniform(-3.0, -0.5)
    if kind == "branch point":
        critical = np.sqrt(9.81 / size)
        return (
            HoopBead(radius=size, turning=critical / 2),
            {"angle": 0.0},
            {"vary": "turning", "until": {"turning": 2 * critical}},
            "turning",
            [critical],
        )
    if kind == "double root":
        critical = -np.sqrt(9.81 / (3 * size))
        start, asked = {"spin_rate": 2 * critical}, {"held": "lean", "until": {"spin_rate": critical / 5}}
        return jj.models.TiltingDisc(radius=size), start, asked, "spin_rate", [critical]
    scene = Twice(push=-1.0, place=place, apart=4 * width**2, damped=float(not kind.startswith("pair")))
    return (
        scene,
        {"x": place - 1.0},
        {"vary": "push", "until": {"push": 1.0}},
        "x",
        [place - width, place + width],
    )


def random_scenes(quick: bool) -> Figures:
    """Special points of random scenes that closed forms know: how many are found elsewhere, and the share of
    those that are found.
    """
    draw, kinds = (
        np.random.default_rng(48),
        ("fold in push", "zero eigenvalue", "pair on the imaginary axis", "branch point", "double root"),
    )
    wrong, found, scenes = 0, [], 30 if quick else 300
    for k in range(scenes):
        scene, start, asked, name, at = known_points(kind := kinds[k % 5], draw)
        points = np.array(
            [point[name] for point in jj.family(scene, start, **asked).special if point.kind == kind]
        )
        off = np.abs(points[:, None] - at) < 1e-6
        wrong += int(np.sum(~off.any(axis=1)))
        found += [*off.any(axis=0)]
    yield figure("special points where there are none", f"{scenes} random scenes", wrong, 0)
    yield figure(
        "share of special points that are found", f"{scenes} random scenes", float(np.mean(found)), least=0.95
    )


def many(quick: bool) -> Figures:
    """Processor time of weave and capsize speeds of 100,000 bicycles, parameters within 5 %, with derivatives
    by all parameters.
    """
    bicycle, count = jj.models.WhippleBicycle(), 2_000 if quick else 5_000
    straight = jj.family(bicycle, {"rear_spin_rate": 10.0}, until={"rear_spin_rate": 25.0})
    draw, seconds = np.random.default_rng(48), 0.0
    bicycles = jax.tree.map(lambda x: x * draw.uniform(0.95, 1.05, count), bicycle)
    for mode in ("weave", "capsize"):
        run = compiled(
            jax.vmap(jax.value_and_grad(lambda scene, mode=mode: jj.critical(scene, straight, mode).speed)),
            bicycles,
        )[0]
        (speeds, _), of_mode = seconds_of(run)
        seconds += of_mode * 1e5 / count
        yield figure(f"bicycles without a {mode} speed", NAME, int(np.sum(~np.isfinite(speeds))))
    yield figure(
        f"critical speeds of 100,000 bicycles with derivatives (from {count:,})", NAME, seconds, 60.0
    )


if __name__ == "__main__":
    main(__doc__, (cold, warm, orbits, random_scenes, many))
