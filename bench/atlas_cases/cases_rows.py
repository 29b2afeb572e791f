"""Cases about rows and bases: E1, E2, E5 to E8, E18, E21 to E24 of the table of hard cases."""

from dataclasses import replace
from functools import partial

import disc_body
import jax.numpy as jnp
import numpy as np
from oracles import ball_on_turntable, rolling_disc, skate, snakeboard, two_wheel_axle, vertical_disc

import jourdain_jax as jj
from atlas_cases import elsewhere
from atlas_cases.case import Case, required, unanswered
from atlas_cases.cases_motion import rolled_disc
from atlas_cases.instants import Instant
from atlas_cases.motions import Motion, against, followed
from atlas_cases.references import bricard_accelerations, octahedron_rods
from atlas_cases.scenes import AppellHamel, Bricard, Edges, HeavyAxle

CLOSED_REASON = (
    "a run at rtol = atol = 1e-12 (float32: 1e-5, 1e-6) against an exact solution, relative to the largest"
    " value"
)


def turning_skate() -> Motion:
    """The skate turns through 90 degrees twice a turn (B2)."""
    ts = np.linspace(0.0, 10.0, 11)
    known = skate.motion(ts, **skate.RUN)
    return followed(jj.models.Skate(), {"heading_rate": 1.3}, ts, known, "x y heading=th", step=0.005)


def vertical_disc_by_heading_and_x() -> Motion:
    """The vertical disc (B4); the fixed partition keeps heading and x, which turning makes singular."""
    ts = np.linspace(0.0, 5.0, 11)
    start, known = {"heading_rate": 2.0, "roll_rate": 1.0}, vertical_disc.motion(ts, **vertical_disc.RUN)
    names, kept = "x y heading=phi roll=th", ("x_rate", "heading_rate")
    return followed(jj.models.VerticalDisc(), start, ts, known, names, independent=kept)


def tilting_disc() -> Motion:
    """The wobbling disc (B6) for 10 s: three null-space columns of one singular value."""
    run = rolling_disc.RUN
    ts = np.linspace(0.0, 10.0, 11)
    known = rolling_disc.motion_yaw_lean_spin(ts, **run)
    start = {name: run[name] for name in ("lean", "yaw_rate", "lean_rate", "spin_rate")}
    by_mujoco = lambda: _disc_elsewhere(known)
    return followed(jj.models.TiltingDisc(), start, ts, known, "x y yaw lean spin", by_mujoco=by_mujoco)


def _disc_elsewhere(expected) -> elsewhere.Elsewhere:
    """The disc in contact with a plane; yaw and spin, known up to whole turns, next to the expected ones."""
    saved = iter(range(len(expected["x"])))

    def read(data):
        k, body = next(saved), elsewhere.body_of(data.qpos, data.qvel)
        near = {name: expected[name][k] for name in ("yaw", "spin")}
        return disc_body.state(rolling_disc.RUN["radius"], body, near)

    return replace(rolled_disc(), read=read)


SNAKE_START = {"steer": 0.3, "steer_rate": 0.5, "x_rate": 1.0, "rotor_rate": 0.4}


def snakeboard_through_loss_of_rank() -> Motion:
    """Across parallel rows (B14), with a step that ends exactly there."""
    ts = np.linspace(0.0, snakeboard.RUN["t_end"], 9)  # steer is 90 degrees at the fifth
    known = snakeboard.motion(ts, **snakeboard.RUN)
    speeds = snakeboard.velocities(np.linspace(0.0, ts[-1], 101), **snakeboard.RUN)["u"]
    travelled = ts[-1] * np.mean(np.abs(speeds))  # m, on curls
    names, scales = "x y heading=th rotor=psi heading_rate=th_rate", {"x": travelled, "y": travelled}
    return followed(jj.models.Snakeboard(), SNAKE_START, ts, known, names, scales, asked=("rollout",))


def snakeboard_at_loss_of_rank() -> Instant:
    """Accelerations exactly at parallel rows, turning freely about the middle: none, for the free rows bear
    nothing there.
    """
    scene = jj.models.Snakeboard()
    q, u, _ = scene.named(steer=np.pi / 2, heading_rate=1.0)
    return Instant(scene, q, u, np.zeros(5), scale=1.0)


def snakeboard_without_continuation() -> Motion:
    """At parallel rows with a sideways velocity, while steering on: no motion continues it."""
    scene = jj.models.Snakeboard()
    start = {"steer": np.pi / 2, "steer_rate": 0.5, "y_rate": 0.5, "heading_rate": 0.3}
    return Motion(scene, start, np.linspace(0.0, 1.0, 3), lambda q, u: np.inf)


def heavy_axle(**masses) -> Motion:
    """The axle with two equal lateral rows (B1)."""
    run = two_wheel_axle.RUN_HEAVY_AXLE | masses
    ts = np.linspace(0.0, run["t_end"], 11)
    start, scene = {"x_rate": run["u0"], "th_rate": run["th_rate"]}, HeavyAxle(**masses)
    return followed(scene, start, ts, two_wheel_axle.motion_heavy_axle(ts, **run), "x y th p1 p2")


def three_edges() -> Motion:
    """The skate with its row three times, once seven times as long."""
    ts = np.linspace(0.0, 10.0, 11)
    return followed(Edges(), {"heading_rate": 1.3}, ts, skate.motion(ts, **skate.RUN), "x y heading=th")


def bricard() -> Instant:
    """Bricard's octahedron of twelve rods, rank eleven, while it bends: accelerations against those of its
    half, six rods of full rank.
    """
    points = np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, -0.4], [0.4, -0.5, 1.1]])
    edges = ((0, 1, False), (1, 2, False), (0, 2, False), (0, 1, True), (1, 2, True), (0, 2, True))
    turned, (rods, rows) = np.diag([-1.0, -1.0, 1.0]), octahedron_rods(points, edges)
    free = np.linalg.svd(rows)[2][6:]  # two rigid motions that keep the axis, and the bending
    velocities = ((0.4, -0.7, 0.9) @ free).reshape(3, 3)
    known = np.asarray(bricard_accelerations(points, velocities, (1.0, 1.5, 0.7), edges), float)

    def whole(half):
        return np.concatenate([half, half @ turned]).ravel()

    scene = Bricard(lengths=np.linalg.norm(rods, axis=1), domain_near=tuple(whole(points).tolist()))
    return Instant(scene, whole(points), whole(velocities), whole(known))


def two_edges(angle) -> Instant:
    """Two edges on one spot, turned by an angle: the body can only turn, however small the angle; the edges
    bear g sin(slope).
    """
    scene = Edges(angle=angle, copies=False)
    q, u, _ = scene.named(heading=0.4)
    pull = 9.81 * np.sin(0.3)
    return Instant(scene, q, u, np.zeros(3), scale=pull, force=np.array([-pull, 0.0, 0.0]))


def off_the_rows() -> Motion:
    """A start 1e-3 m/s off the row: the skate moves as from its M-orthogonal projection, and the trajectory
    says by how much it was moved.
    """
    scene = jj.models.Skate()
    q, u, _ = scene.named(heading=0.4, heading_rate=1.3)
    along, across = np.array([np.cos(0.4), np.sin(0.4)]), np.array([-np.sin(0.4), np.cos(0.4)])
    given = np.array(u) + np.append(0.7 * along + 1e-3 * across, 0.0)
    unmoved = dict.fromkeys(("t", "moved_q", "moved_u", "residual"), jnp.zeros((), q.dtype))
    state = jj.State(
        q=q, u=jnp.asarray(given, q.dtype), **unmoved, names=(scene.coordinate_names, scene.speed_names)
    )
    ts = np.linspace(0.0, 5.0, 6)
    known = skate.motion(ts, **(skate.RUN | {"u0": 0.7, "th0": 0.4}))
    return followed(scene, state, ts, known, "x y heading=th", naive_start=(q, jnp.asarray(given, q.dtype)))


def ball_on_tilted_turntable() -> Motion:
    """Rows that depend on place and time through the table's turning (B8)."""
    run = ball_on_turntable.RUN
    ts = np.linspace(0.0, 10.0, 11)
    known = ball_on_turntable.motion(ts, **run)
    start = {"x": run["x0"], "x_rate": run["vx0"], "y_rate": run["vy0"], "spin": run["wz"]}
    return followed(jj.models.BallOnTurntable(tilt=run["tilt"]), start, ts, known, "x y roll_x=wx roll_y=wy")


def cone_from_rest() -> Motion:
    """Appell and Hamel's row at rest, where it has no slope: many motions meet it."""
    return Motion(AppellHamel(), {}, np.linspace(0.0, 1.0, 3), lambda q, u: np.inf)


def cone_in_motion() -> Motion:
    """Appell and Hamel's row, falling: a straight line with `sdotdot = g k/(1 + k^2)`, for Chetaev's rule
    gives the row the force 2 lambda (v, -k^2 zdot).
    """
    scene, k, s0 = AppellHamel(), 0.8, 0.5
    ts = np.linspace(0.0, 2.0, 6)
    path = s0 * ts + 9.81 * k / (1 + k**2) * ts**2 / 2
    c, s = np.cos(0.6), np.sin(0.6)
    start = {"x_rate": s0 * c, "y_rate": s0 * s, "z_rate": -s0 / k}
    return Motion(scene, start, ts, against(scene, {"x": c * path, "y": s * path, "z": -path / k}))


CLOSED = 1e-10, 1e-3, CLOSED_REASON
CASES = (
    required(
        "E1", "coordinate partitioning: a skate turns through 90 degrees", turning_skate, *CLOSED, quick=True
    ),
    required(
        "E1 disc",
        "coordinate partitioning: a vertical disc by heading and x",
        vertical_disc_by_heading_and_x,
        *CLOSED,
    ),
    required(
        "E2",
        "bases that jump: a disc through several turns",
        tilting_disc,
        1e-9,
        3e-3,
        CLOSED_REASON + "; the motion amplifies errors 66 times",
    ),
    required(
        "E5",
        "loss of rank: a snakeboard, a step ends on parallel rows",
        snakeboard_through_loss_of_rank,
        *CLOSED,
        quick=True,
    ),
    Case(
        "E5 point",
        "accelerations exactly at the loss of rank",
        snakeboard_at_loss_of_rank,
        1e-12,
        1e-5,
        "round-off",
        quick=True,
    ),
    unanswered(
        "E6",
        "no motion continues the start at the loss of rank",
        snakeboard_without_continuation,
        "there is no right number",
    ),
    required("E7", "dependent rows: an axle with four rows of rank three", heavy_axle, *CLOSED),
    required("E7 copies", "dependent rows: one edge three times", three_edges, *CLOSED),
    Case(
        "E7 Bricard",
        "dependent rows: an octahedron of twelve rods, rank eleven, that bends",
        bricard,
        1e-11,
        1e-3,
        "round-off, over angles of rods",
    ),
    *(
        Case(
            f"E8 {angle:g}",
            f"nearly dependent rows: a second edge turned by {angle:g} rad",
            partial(two_edges, angle),
            1e-12 + 1e-15 / angle,
            min(1e-6 + 3e-7 / angle, 0.5),
            "round-off over the angle: the rows themselves are no better known",
            quick=angle == 1e-6,
        )
        for angle in (1e-2, 1e-6, 1e-10, 1e-13)
    ),
    required("E18", "an initial velocity 1e-3 m/s off the row", off_the_rows, *CLOSED),
    required("E22", "rows that move: a ball on a tilted turntable", ball_on_tilted_turntable, *CLOSED),
    unanswered("E24", "a row without slope at rest", cone_from_rest, "there is no right number"),
    Case("E24 moving", "the same row in motion", cone_in_motion, *CLOSED),
)
