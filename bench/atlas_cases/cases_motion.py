"""Cases about long, stiff and singular motions: E9 to E17 of the table of hard cases."""

from functools import partial

import numpy as np
from long_runs_scenes import ChaoticOscillator, ContactOscillator, GaugeTwin, Transmission
from oracles import chaplygin_sleigh, rolling_disc, vertical_disc
from scipy.spatial.transform import Rotation

import jourdain_jax as jj
from atlas_cases import elsewhere
from atlas_cases.case import Case, required, unanswered
from atlas_cases.motions import Motion, against, drift, followed, max_error
from atlas_cases.outcomes import worst
from atlas_cases.references import ball_on_switched_turntable, celt_without_angles, linkage_angle
from atlas_cases.scenes import FourBars
from atlas_cases.scenes_motion import CeltInQuaternion, DragDisc, EccentricBall, SoftWheel, SwitchedTurntable

NO_ROWS = dict.fromkeys(("naive", "constraints"), "no rows")
TIGHT = {"rtol": 1e-8, "atol": 1e-8}
IMPLICIT = ("rollout", "Kvaerno5", "Radau IIA")
LONG_RUN = dict.fromkeys(("naive", "reductions", "constraints"), "the same in the shorter case")


def matrices(quaternions):
    """Rotation matrices (times, 3, 3) of quaternions (times, 4) of any norm."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()


def leaning_disc(lean, yaw_rate, lean_rate, spin_rate, radius):
    """A start of the disc in quaternions, yaw and spin zero."""
    c, s = np.cos(lean), np.sin(lean)
    return {
        "y": -radius * s,
        "z": radius * c,
        "attitude_w": np.cos(lean / 2),
        "attitude_x": np.sin(lean / 2),
        "attitude_omega_x": lean_rate,
        "attitude_omega_y": spin_rate + yaw_rate * s,
        "attitude_omega_z": yaw_rate * c,
    }


def disc_off_its_rows(radius):
    """Error: by how much a disc leaves the plane (m), slips (m/s), or its quaternion's norm leaves 1."""

    def error(q, u):
        turned = matrices(q[:, 3:])
        axle = turned[:, :, 1]
        flat = np.sqrt(1 - axle[:, 2] ** 2)
        arm = -radius * (np.array([0, 0, 1.0]) - axle[:, 2:] * axle) / flat[:, None]
        slip = u[:, :3] + np.cross(np.einsum("tij,tj->ti", turned, u[:, 3:]), arm)
        off = (q[:, 2] - radius * flat, slip, np.linalg.norm(q[:, 3:], axis=1) - 1)
        return max_error(worst(part, 0.0, 1.0) for part in off)

    return error


def rolled_disc() -> elsewhere.Elsewhere:
    """The disc in contact with a plane."""
    run = rolling_disc.RUN
    minimal = (0.0, 0.0, 0.0, run["lean"], 0.0, run["yaw_rate"], run["lean_rate"], run["spin_rate"])
    return elsewhere.rolling_disc(run["mass"], run["radius"], minimal)


def disc_for_long(t_end) -> Motion:
    """The disc in quaternions: what is left of its rows."""
    run, scene = rolling_disc.RUN, jj.models.TiltingDiscQuaternion()
    start = leaning_disc(run["lean"], run["yaw_rate"], run["lean_rate"], run["spin_rate"], 0.5)
    short, skip = t_end <= 20, {} if t_end <= 100 else LONG_RUN
    options = TIGHT | {"asked": ("rollout", *(["Baumgarte 1e4/s"] * short))}
    options |= {"step": 0.01, "by_mujoco": rolled_disc} if short else {}
    return Motion(scene, start, np.linspace(0.0, t_end, 21), disc_off_its_rows(0.5), skip=skip, **options)


def disc_to_its_reference() -> Motion:
    """The disc in quaternions for 2 s at the default tolerance: where it ends."""
    run, scene = rolling_disc.RUN, jj.models.TiltingDiscQuaternion()
    ts = np.linspace(0.0, 2.0, 6)
    known = rolling_disc.motion_yaw_lean_spin(ts, **run)
    start = leaning_disc(run["lean"], run["yaw_rate"], run["lean_rate"], run["spin_rate"], 0.5)
    more = TIGHT | {"asked": ("Baumgarte 1e4/s", "Kvaerno5"), "by_mujoco": rolled_disc}
    return followed(scene, start, ts, known, "x=cx y=cy z=cz", **more)


def four_bar() -> Motion:
    """A parallelogram of rods swings about its rest, here upright by gravity upwards, for 100 s: lengths of
    rods, their rates, and energy.
    """
    # of the ends P0, P1 the two cranks from (0, 0) and (1, 0), and the rod between them
    rods = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -1.0]])
    pivots = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])

    def error(q, u):
        along, rates = rods @ q.reshape(-1, 2, 2) - pivots, rods @ u.reshape(-1, 2, 2)
        off = np.linalg.norm(along, axis=2) - 1, np.sum(along * rates, axis=2)
        return max_error(worst(part, 0.0, 1.0) for part in off)

    upright = (np.pi / 2, 0.0, np.pi / 2), (-2.0, 0.0, -2.0)
    by_mujoco = lambda: elsewhere.four_bar((1.0,) * 4, (1.0,) * 3, -9.81, upright, elsewhere.ends_of_cranks)
    start = {"x0": 0.0, "x1": 1.0, "z0": 1.0, "z1": 1.0, "x0_rate": 2.0, "x1_rate": 2.0}
    scene, ts = FourBars(windows=1, gravity=-9.81), np.linspace(0.0, 100.0, 21)
    return Motion(scene, start, ts, error, asked=("rollout",), by_mujoco=by_mujoco, **TIGHT)


def linkage() -> Motion:
    """Two windows swing through the horizontal, where one freedom becomes three."""
    scene, ts = FourBars(), np.linspace(0.0, 2.0, 9)
    angle = linkage_angle(ts)
    known, start = {}, {}
    for i in range(3):
        known |= {f"x{i}": i + np.sin(angle), f"z{i}": np.cos(angle)}
        start |= {f"x{i}": float(i), f"z{i}": 1.0, f"x{i}_rate": 1.0}
    return Motion(scene, start, ts, against(scene, known, dict.fromkeys(known, 1.0)))


def _celt_error(ts, w0):
    known = celt_without_angles(ts, [0.0, 1.0, 0.0], w0)
    return lambda mu, w: max_error([worst(mu, known[:, :3], 1.0), worst(w, known[:, 3:])])


def celt_on_edge(scale=1.0, w0=(2.0, 1.0, -3.0)) -> Motion:
    """The rattleback set on its long edge, where the usual angles are singular; quaternion coordinates.
    `scale`: units of length per metre.
    """
    scene, ts = CeltInQuaternion(scale=scale), np.linspace(0.0, 0.5, 6)
    compare = _celt_error(ts, w0)
    start = {"z": 0.03 * scale, "attitude_w": np.cos(0.75 * np.pi), "attitude_x": np.sin(0.75 * np.pi)}
    start |= {f"attitude_omega_{axis}": value for axis, value in zip("xyz", w0, strict=True)}
    return Motion(scene, start, ts, lambda q, u: compare(-matrices(q[:, 3:])[:, 2], u[:, 3:]), rtol32=1e-6)


def celt_on_edge_in_angles() -> Motion:
    """The rattleback set on its long edge in the usual angles, which are singular there."""
    scene, ts = jj.models.Rattleback(), np.linspace(0.0, 0.5, 6)
    compare = _celt_error(ts, (2.0, 1.0, -3.0))

    def error(q, u):
        al, be = q[:, 2], q[:, 3]
        return compare(
            np.stack([-np.cos(al) * np.sin(be), np.sin(al), np.cos(al) * np.cos(be)], axis=1), u[:, 2:]
        )

    start = {"alpha": np.pi / 2, "beta": 0.0, "w1": 2.0, "w2": 1.0, "w3": -3.0}
    return Motion(scene, start, ts, error)


def free_top(t_end) -> Motion:
    """A free top: energy, angular momentum in space, norm of the quaternion."""
    scene, moments = jj.models.FreeRigidBody(), np.array([1.0, 2.0, 2.5])

    def energy(q, u):
        return np.sum(moments * u[:, 3:] ** 2, axis=1) / 2

    def error(q, u):
        spin = np.einsum("tij,tj->ti", matrices(q[:, 3:]), moments * u[:, 3:])
        off = [worst(spin, spin[:1]), worst(np.linalg.norm(q[:, 3:], axis=1), 1.0)]
        return max_error([*off, drift(energy)(q, u)])

    skip = NO_ROWS if t_end <= 100 else NO_ROWS | LONG_RUN
    more = {"asked": ("rollout",)} | ({"step": 0.02} if t_end <= 100 else {})
    u = [0.0, 0.0, 0.0, *(scene.example[f"attitude_omega_{axis}"] for axis in "xyz")]
    by_mujoco = lambda: elsewhere.free_body(1.0, moments, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], u)
    more |= {"rtol": 1e-11, "atol": 1e-11, "skip": skip, "by_mujoco": by_mujoco}
    return Motion(scene, scene.example, np.linspace(0.0, t_end, 21), error, **more)


def eccentric_ball() -> Motion:
    """An eccentric ball that rolls: energy, and Jellett's integral, angular momentum times contact vector."""
    scene = EccentricBall()
    moments = np.array([0.4, 0.4, 0.5])

    def energy(q, u):
        return (np.sum(u[:, :3] ** 2, axis=1) + np.sum(moments * u[:, 3:] ** 2, axis=1)) / 2 + 9.81 * q[:, 2]

    def jellett(q, u):
        turned = matrices(q[:, 3:])
        arm = -0.3 * turned[:, :, 2] - np.array([0.0, 0.0, 1.0])
        return np.sum(np.einsum("tij,tj->ti", turned, moments * u[:, 3:]) * arm, axis=1)

    start = {
        "z": 1.0 + 0.3 * np.cos(0.4),
        "attitude_w": np.cos(0.2),
        "attitude_x": np.sin(0.2),
        "attitude_omega_z": 4.0,
        "attitude_omega_x": 0.5,
    }

    def by_mujoco():
        q = np.array([0.0, 0.0, start["z"], start["attitude_w"], start["attitude_x"], 0.0, 0.0])
        omega, turned = np.array([0.5, 0.0, 4.0]), matrices(q[None, 3:])[0]
        arm = 0.3 * turned[:, 2] + np.array([0.0, 0.0, 1.0])  # from the contact to the mass centre
        shape, u = elsewhere.ball_shape(1.0, (0.0, 0.0, -0.3)), [*np.cross(turned @ omega, arm), *omega]
        return elsewhere.rolling(1.0, moments, shape, q, u)

    ts, error = np.linspace(0.0, 50.0, 26), drift(energy, jellett)
    return Motion(scene, start, ts, error, asked=("rollout",), by_mujoco=by_mujoco)


def near_fall(turn) -> Motion:
    """The disc nearly falls flat and rises again (B6): the contact races half round the rim."""
    run, theta = rolling_disc.NEAR_FALL, rolling_disc.NEAR_FALL["theta0"]
    scene, ts = (
        jj.models.TiltingDiscQuaternion(run["mass"], run["radius"], run["gravity"]),
        np.array([0.0, 0.25]),
    )
    yaw_rate = turn / np.sin(theta)
    start = leaning_disc(theta - np.pi / 2, yaw_rate, 0.0, yaw_rate * np.cos(theta), run["radius"])
    if turn >= 1e-5:
        values = {name: run[name] for name in ("mass", "radius", "gravity")}
        known = rolling_disc.motion(ts, **values, theta=theta, w1=0.0, w2=turn, w3=0.0)
        error = against(scene, {name: known[f"c{name}"] for name in "xyz"}, dict.fromkeys("xyz", 0.3))
    else:
        error = lambda q, u: np.inf
    most_steps = 20_000 if turn != 1e-4 else 100_000  # there the right answer takes more
    return Motion(scene, start, ts, error, rtol=1e-9, atol=1e-9, steps=20_000, most_steps=most_steps)


def eulers_disc() -> Motion:
    """Euler's disc: theta^2 falls to zero within the span."""
    theta = 0.1
    yaw_rate = np.sqrt(4 * 9.81 / (0.3 * np.sin(theta)))  # the centre at rest
    start = leaning_disc(theta - np.pi / 2, yaw_rate, 0.0, yaw_rate * np.cos(theta), 0.3)
    more = TIGHT | {"steps": 2000, "asked": ("rollout",)}
    return Motion(DragDisc(), start, np.linspace(0.0, 2.0, 5), lambda q, u: np.inf, **more)


LONG = {"ts": np.linspace(0.0, 100.0, 21), "rtol": 1e-11, "atol": 1e-11, "step": 0.05}  # runs, s


def contact_oscillator(twin=False) -> Motion:
    """Energy, what is left of the row and the driver's own energy. `twin`: with a gauge term, which changes
    no motion.
    """

    def energy(q, u):
        return (np.sum(u**2 + q**2, axis=1) + 0.3 * (q[:, 0] * q[:, 2]) ** 2) / 2

    def row(q, u):
        return 1 + u[:, 0] + q[:, 1] * u[:, 2]

    def driver(q, u):
        return (q[:, 1] ** 2 + u[:, 1] ** 2) / 2

    start, error = {"x": 1.0, "y": 0.6, "z_rate": 0.8}, drift(energy, row, driver)
    if twin:
        others = ("rollout", "reductions", "constraints", "naive")
        skip = dict.fromkeys(others, "equations of motion know no gauge: as E15")
        return Motion(GaugeTwin(), start, error=error, skip=skip, **LONG)
    return Motion(ContactOscillator(), start, error=error, steps=2000, asked=IMPLICIT, **LONG)


def chaotic_oscillator() -> Motion:
    """Energy, and what is left of the row."""

    def energy(q, u):
        y, z = q[:, 1:4], q[:, 4:]
        coupled = (z[:, 0] * z[:, 1]) ** 2 + np.sum((y * z) ** 2, axis=1)
        return (np.sum(u**2 + q**2, axis=1) + coupled) / 2

    def row(q, u):
        return 1 + u[:, 0] + np.sum(q[:, 1:4] * u[:, 4:], axis=1)

    scene = ChaoticOscillator()
    return Motion(scene, scene.example, error=drift(energy, row), steps=2000, asked=IMPLICIT, **LONG)


def gear() -> Motion:
    """Energy of all and of the driver, which nothing acts back on."""

    def driver(q, u):
        return u[:, 1] ** 2 / 2 + 1 - np.cos(q[:, 1]) - 0.1 * np.sin(2 * q[:, 1])

    def energy(q, u):
        return driver(q, u) + (u[:, 0] ** 2 + u[:, 2] ** 2 + q[:, 0] ** 2 + q[:, 2] ** 2) / 2

    start = {"x": 0.5, "y": 0.9, "z": 0.3, "z_rate": 0.4}
    return Motion(Transmission(), start, error=drift(energy, driver), steps=2000, **LONG)


def soft_wheel(stiffness) -> Motion:
    """A wheel on a stiff contact of springs, near the motion on rows."""
    scene, ts = SoftWheel(stiffness=stiffness), np.linspace(0.0, 1.0, 6)
    known = vertical_disc.motion(ts, **vertical_disc.RUN)
    start = {"z": 1.0, "x_rate": 1.0, "heading_rate": 2.0, "roll_rate": 1.0}
    more = {"skip": NO_ROWS | {"reductions": "no rows"}, "asked": IMPLICIT, "step": 0.005}
    return followed(scene, start, ts, known, "x y heading=phi roll=th", **TIGHT, **more)


def switched_turntable() -> Motion:
    """Rows that move in time: the table reverses its turning."""
    scene, ts = SwitchedTurntable(), np.linspace(0.0, 4.0, 9)
    known = ball_on_switched_turntable(ts, (0.2, 0.0), (0.1, 0.3))
    start = {"x": 0.2, "x_rate": 0.1, "y_rate": 0.3, "attitude_omega_z": 1.0}
    return Motion(
        scene, start, ts, against(scene, dict(zip(("x", "y", "x_rate", "y_rate"), known.T, strict=True)))
    )


def sleigh_backwards() -> Motion:
    """The sleigh from its end back to its start: the forward motion contracts, so that errors grow 700
    times.
    """
    run, scene, ts = chaplygin_sleigh.RUN, jj.models.ChaplyginSleigh(), np.linspace(12.0, 0.0, 7)
    known = {name: values[::-1] for name, values in chaplygin_sleigh.motion(ts[::-1], **run).items()}
    first = {name: values[0] for name, values in known.items()}
    start = {"x": first["x"], "y": first["y"], "heading": first["th"], "heading_rate": first["w"]}
    start["x_rate"] = first["v"] * np.cos(first["th"]) - run["a"] * first["w"] * np.sin(first["th"])
    state = jj.start(scene, t0=12.0, **start)
    return followed(scene, state, ts, known, "x y heading=th")


LONG_DRIFT = 2e-2, "rtol of every step adds up over the run (1e-11 in float64, 1e-5 in float32)"
NEAR_FLAT = "round-off of the attitude counts 1/theta^2 in the contact's motion"
DRIFTS, SOFT = "residuals", "a soft row yields by its force over k"
CASES = (
    required(
        "E9", "drift off the rows in 100 s of a disc", partial(disc_for_long, 100.0), 1e-10, 1e-4, DRIFTS,
    ),
    Case(
        "E9 short", "drift off the rows in 10 s of a disc", partial(disc_for_long, 10.0), 1e-10, 1e-4, DRIFTS,
    ),
    required(
        "E9 long", "drift off the rows in 1000 s of a disc", partial(disc_for_long, 1000.0), 1e-10, 1e-4,
        DRIFTS,
    ),
    required(
        "E9 four-bar", "drift off the rows in 100 s of a four-bar linkage", four_bar, 1e-10, 1e-4, DRIFTS,
    ),
    Case(
        "E10", "stabilisation against projection: 2 s of a disc", disc_to_its_reference, 1e-7, 1e-3,
        "a run at rtol = atol = 1e-8 (float32: 1e-5, 1e-6)",
    ),
    Case(
        "E11", "a linkage through its singular configuration", linkage, 1e-6, 1e-2,
        "rtol 1e-12; errors grow as the inverse square of the distance to it",
    ),
    required(
        "E12", "gimbal lock: a rattleback on its edge, quaternion", celt_on_edge, 1e-9, 1e-2,
        "a fall from an edge amplifies errors",
    ),
    Case(
        "E12 angles", "the same in angles, which are singular there", celt_on_edge_in_angles, 1e-9, 1e-2,
        "rates of angles are infinite at the start",
        flag_is_right=True,
    ),
    required(
        "E13", "norm of the quaternion: a free top for 100 s", partial(free_top, 100.0), 1e-9, *LONG_DRIFT,
    ),
    required(
        "E13 long", "norm of the quaternion: a free top for 10,000 s", partial(free_top, 1e4), 1e-7, 0.1,
        LONG_DRIFT[1],
    ),
    required("E13 ball", "an eccentric ball rolls for 50 s", eccentric_ball, 1e-9, *LONG_DRIFT),
    Case(
        "E14 1e-2", "near fall of a disc, 3e-4 rad from flat", partial(near_fall, 1e-2), 1e-8, 1e-2,
        NEAR_FLAT,
    ),
    Case(
        "E14 1e-4", "near fall of a disc, 3e-6 rad from flat", partial(near_fall, 1e-4), 1e-3, 1e-2,
        NEAR_FLAT,
    ),
    unanswered(
        "E14 1e-6", "near fall of a disc, 3e-8 rad from flat", partial(near_fall, 1e-6),
        "beyond double precision",
    ),
    unanswered("E14 Euler", "Euler's disc: flat in finite time", eulers_disc, "there is no motion beyond"),
    Case("E15", "contact oscillator, 100 s", contact_oscillator, 1e-8, *LONG_DRIFT),
    Case(
        "E15 gauge", "the same from a Lagrangian with a gauge term", partial(contact_oscillator, True), 1e-8,
        *LONG_DRIFT,
    ),
    Case("E15 chaotic", "chaotic contact oscillator, 100 s", chaotic_oscillator, 1e-8, *LONG_DRIFT),
    Case("E16", "pendulum-driven transmission, 100 s", gear, 1e-8, *LONG_DRIFT),
    *(
        Case(
            f"E17 {k:g}", f"a contact of springs, {k:g} N/m, for rolling", partial(soft_wheel, k), 10 / k,
            10 / k + 1e-3, SOFT,
        )
        for k in (1e3, 1e6, 1e8)
    ),
    Case("E19", "a contracting motion run backwards", sleigh_backwards, 1e-8, 2e-1, "errors grow 700 times"),
    required("E21 units", "a rattleback in centimetres", partial(celt_on_edge, 100.0), 1e-9, 1e-2, "as E12"),
    required(
        "E22 switched", "rows that move: a turntable reverses", switched_turntable, 1e-10, 1e-3, "as E22",
    ),
)  # fmt: skip
