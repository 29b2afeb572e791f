"""The eight problems, with the data of `tests/oracles`."""

from oracles import ball_on_turntable, chaplygin_sleigh, rattleback, rolling_disc, snakeboard, two_wheel_axle

import jourdain_jax as jj
from jourdain_jax.models import TrailerChain
from work_precision_cases import references
from work_precision_cases.problem import Problem


def _of(run: dict, *names: str) -> dict:
    return {name: run[name] for name in names}


_SLEIGH, _AXLE, _BALL, _BOARD = chaplygin_sleigh.RUN, two_wheel_axle.RUN, ball_on_turntable.RUN, snakeboard.RUN
_CHAIN = 16

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
            ("x", "y", "yaw", "lean", "spin", "yaw_rate", "lean_rate", "spin_rate"),
            structure_preserving=True,
        ),
        Problem(
            "chaplygin-sleigh",
            "Chaplygin sleigh, 12 s",
            lambda: jj.models.ChaplyginSleigh(mass=_SLEIGH["mass"], inertia=_SLEIGH["inertia"], offset=_SLEIGH["a"]),
            {"x_rate": _SLEIGH["v0"], "y_rate": _SLEIGH["a"] * _SLEIGH["w0"], "heading_rate": _SLEIGH["w0"]},
            _SLEIGH["t_end"],
            references.sleigh,
            ("x", "y", "heading", "x_rate", "y_rate", "heading_rate"),
            structure_preserving=True,
        ),
        Problem(
            "rattleback",
            "Rattleback, 20 s",
            lambda: jj.models.Rattleback(**_of(rattleback.RUN, "a", "b", "c", "h", "A", "B", "C", "D", "gravity")),
            _of(rattleback.RUN, *rattleback.NAMES),
            rattleback.RUN["t_end"],
            references.celt,
            rattleback.NAMES,
            steps=(0.01, 0.003, 0.001, 0.0003),
        ),
        Problem(
            "whipple-bicycle",
            "Whipple bicycle, 5 s",
            jj.models.WhippleBicycle,
            dict(jj.models.WhippleBicycle.example),
            5.0,
            references.bicycle,
            ("x", "y", "yaw", "lean", "pitch", "steer", "rear_spin", "front_spin", "lean_rate", "steer_rate", "rear_spin_rate"),
            steps=(0.03, 0.01, 0.003, 0.001),
            large=True,
        ),
        Problem(
            "two-wheel-axle",
            "Two-wheel axle, 10 s",
            lambda: jj.models.TwoWheelAxleCoordinates(**_of(_AXLE, "radius", "length", "mass", "rim_mass", "slope", "gravity")),
            {"y2": _AXLE["length"], "psi1_rate": _AXLE["psi1_rate"], "phi_rate": _AXLE["phi_rate"]},
            _AXLE["t_end"],
            references.axle,
            ("x1", "y1", "psi1", "x2", "y2", "psi2", "phi", "psi1_rate", "phi_rate"),
            structure_preserving=True,
        ),
        Problem(
            "ball-on-turntable",
            "Ball on a tilted turntable, 10 s",
            lambda: jj.models.BallOnTurntable(**_of(_BALL, "radius", "inertia_ratio", "turn_rate", "tilt", "gravity")),
            {"x": _BALL["x0"], "y": _BALL["y0"], "x_rate": _BALL["vx0"], "y_rate": _BALL["vy0"], "spin": _BALL["wz"]},
            _BALL["t_end"],
            references.ball,
            ("x", "y", "attitude_w", "attitude_x", "attitude_y", "attitude_z", "x_rate", "y_rate", "roll_x", "roll_y", "spin"),
            conserves_energy=False,
        ),
        Problem(
            "snakeboard",
            "Snakeboard through 90°, 5.1 s",
            lambda: jj.models.Snakeboard(**_of(_BOARD, "mass", "half_length", "board_inertia", "rotor_inertia", "wheel_inertia")),
            {"steer": _BOARD["phi0"], "steer_rate": _BOARD["phi_rate"], "x_rate": _BOARD["u0"], "rotor_rate": _BOARD["psi_rate"]},
            _BOARD["t_end"],
            references.board,
            ("x", "y", "heading", "rotor", "steer", "heading_rate", "rotor_rate", "steer_rate"),
            structure_preserving=True,
        ),
        Problem(
            "trailer-chain",
            f"{_CHAIN} trailers, 5 s",
            lambda: TrailerChain(trailers=_CHAIN),
            {name: float(value) for name, value in TrailerChain(trailers=_CHAIN).example.items()},
            5.0,
            references.trailers,
            tuple(f"{name}{i}" for i in range(_CHAIN + 1) for name in ("x", "y", "heading", "forward", "turn")),
            large=True,
        ),
    )
}
QUICK = ("tilting-disc", "chaplygin-sleigh")
