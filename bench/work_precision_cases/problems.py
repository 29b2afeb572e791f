"""The four problems, with the data of `tests/oracles`."""

from oracles import chaplygin_sleigh, rattleback, rolling_disc

import jourdain_jax as jj
from work_precision_cases import references
from work_precision_cases.problem import Problem


def _of(run, *names):
    return {name: run[name] for name in names}


_SLEIGH = chaplygin_sleigh.RUN

PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem(
            "tilting-disc",
            "Tilting disc, 10 s",
            lambda: jj.models.TiltingDisc(**_of(rolling_disc.RUN, "mass", "radius", "gravity")),
            _of(rolling_disc.RUN, "lean", "yaw_rate", "lean_rate", "spin_rate"),
            rolling_disc.RUN["t_end"],
            references.disc,
            "x y yaw lean spin yaw_rate lean_rate spin_rate",
        ),
        Problem(
            "chaplygin-sleigh",
            "Chaplygin sleigh, 12 s",
            lambda: jj.models.ChaplyginSleigh(
                mass=_SLEIGH["mass"], inertia=_SLEIGH["inertia"], offset=_SLEIGH["a"]
            ),
            {"x_rate": _SLEIGH["v0"], "y_rate": _SLEIGH["a"] * _SLEIGH["w0"], "heading_rate": _SLEIGH["w0"]},
            _SLEIGH["t_end"],
            references.sleigh,
            "x y heading x_rate y_rate heading_rate",
        ),
        Problem(
            "rattleback",
            "Rattleback, 20 s",
            lambda: jj.models.Rattleback(
                **_of(rattleback.RUN, "a", "b", "c", "h", "A", "B", "C", "D", "gravity")
            ),
            _of(rattleback.RUN, *rattleback.NAMES),
            rattleback.RUN["t_end"],
            references.celt,
            " ".join(rattleback.NAMES),
        ),
        Problem(
            "whipple-bicycle",
            "Whipple bicycle, 5 s",
            jj.models.WhippleBicycle,
            dict(jj.models.WhippleBicycle.example),
            5.0,
            references.bicycle,
            "x y yaw lean pitch steer rear_spin front_spin lean_rate steer_rate rear_spin_rate",
        ),
    )
}
QUICK = ("tilting-disc", "chaplygin-sleigh")
