"""Rolling disc and nonlinear Whipple bicycle as a JAX user would write them: dense matrices by autodiff, one
linear solve, diffrax, vmap.

    [M A'] [qddot ]   [Q - h ]      M = sum m Jv' Jv + Jw' I Jw
    [A 0 ] [lambda] = [-drift]      h = sum m Jv' a0 + Jw' (I alpha0 + omega x I omega)

v = Jv qdot, omega = Jw qdot, A qdot = 0; a0, alpha0, drift: their rates at qddot = 0.
Poses are written by hand, everything else is differentiated. The state of one lane is the flat array y = (q,
qdot). Frozen: this file is the mark to beat, so it stays as it is; it imports nothing of the package. Double
precision is switched on by whoever imports it (`JAX_ENABLE_X64=1`, or `import jourdain_jax` first).
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp

DISC_PARAMETERS = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}
# Meijaard et al. (2007), table 1, with their names and their frame (z down).
BICYCLE_PARAMETERS = {
    **{"w": 1.02, "c": 0.08, "lam": 0.3141592653589793, "g": 9.81},
    **{"rR": 0.3, "mR": 2.0, "IRxx": 0.0603, "IRyy": 0.12},
    **{"xB": 0.3, "zB": -0.9, "mB": 85.0, "IBxx": 9.2, "IByy": 11.0, "IBzz": 2.8, "IBxz": 2.4},
    **{"xH": 0.9, "zH": -0.7, "mH": 4.0, "IHxx": 0.05892, "IHyy": 0.06, "IHzz": 0.00708, "IHxz": -0.00756},
    **{"rF": 0.35, "mF": 3.0, "IFxx": 0.1405, "IFyy": 0.28},
}
SOLVERS = {"Tsit5": diffrax.Tsit5, "Dopri5": diffrax.Dopri5, "Dopri8": diffrax.Dopri8}


class Bodies(NamedTuple):
    """Mass centres and orientations of all bodies."""

    position: jax.Array  # (bodies, 3), m
    orientation: jax.Array  # (bodies, 3, 3), body to space


def rot_x(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_y(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rot_z(angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def slip(axle, radius, velocity, angular_velocity):
    """Velocity of the material point of a wheel at its lowest point; its third entry is also the rate of that
    point's height.
    """
    up = jnp.array([0.0, 0.0, 1.0]) - axle[2] * axle
    return velocity - jnp.cross(angular_velocity, radius * up / jnp.sqrt(up @ up))


def accelerations(poses, rows, mass, inertia, force, q, qdot):
    """Accelerations of all coordinates, from one saddle-point system.

    **Arguments:** `poses(q)`; `rows(poses, velocity, angular_velocity)`; `mass` (bodies,); `inertia` (bodies,
    3, 3) in body axes; `force` (bodies, 3), impressed at the mass centres.
    """

    def kinematics(here, rate):
        W = jnp.einsum(
            "bij...,bkj->bik...", rate.orientation, here.orientation
        )  # Rdot R', the matrix of omega x
        omega = jnp.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], axis=1)
        return rate.position, omega

    def velocities_and_rows(q):
        here, rate = jax.jvp(poses, (q,), (qdot,))
        v, omega = kinematics(here, rate)
        return v, omega, rows(here, v, omega)

    here, (Jv, Jw) = poses(q), kinematics(poses(q), jax.jacfwd(poses)(q))
    A = jax.vmap(lambda v, omega: rows(here, v, omega), in_axes=-1, out_axes=-1)(Jv, Jw)
    (_, omega, _), (a0, alpha0, drift) = jax.jvp(velocities_and_rows, (q,), (qdot,))
    I = here.orientation @ inertia @ here.orientation.mT  # in space axes
    M = jnp.einsum("bik,b,bil->kl", Jv, mass, Jv) + jnp.einsum("bik,bij,bjl->kl", Jw, I, Jw)
    moment = jnp.einsum("bij,bj->bi", I, alpha0) + jnp.cross(omega, jnp.einsum("bij,bj->bi", I, omega))
    f = jnp.einsum("bik,bi->k", Jv, force - mass[:, None] * a0) - jnp.einsum("bik,bi->k", Jw, moment)
    saddle = jnp.block([[M, A.T], [A, jnp.zeros((len(A), len(A)))]])
    return jnp.linalg.solve(saddle, jnp.concatenate([f, -drift]))[: len(q)]


def weights(mass, gravity):
    """Weights of all bodies, (bodies, 3)."""
    return jnp.outer(mass, jnp.array([0.0, 0.0, -1.0])) * gravity


# The disc: q = (x, y, yaw, lean, spin), x, y of the contact point.


def disc_poses(p, q):
    """Yaw about z, lean about the heading, spin about the axle (body y)."""
    x, y, yaw, lean, spin = q
    frame = rot_z(yaw) @ rot_x(lean)
    centre = jnp.stack([x, y, 0.0]) + p["radius"] * frame[:, 2]
    return Bodies(centre[None], (frame @ rot_y(spin))[None])


def disc_rows(p, here, v, omega):
    """No slip in the plane; the height is in the coordinates."""
    return slip(here.orientation[0, :, 1], p["radius"], v[0], omega[0])[:2]


def disc_rates(p, t, y):
    """`d (q, qdot) / dt` of the disc, y of 10 numbers."""
    q, qdot = y[:5], y[5:]
    mass = jnp.array([p["mass"]])
    inertia = p["mass"] * p["radius"] ** 2 * jnp.diag(jnp.array([0.25, 0.5, 0.25]))[None]
    qddot = accelerations(
        lambda q: disc_poses(p, q),
        lambda *at: disc_rows(p, *at),
        mass,
        inertia,
        weights(mass, p["gravity"]),
        q,
        qdot,
    )
    return jnp.concatenate([qdot, qddot])


# The bicycle: q = (x, y, yaw, lean, pitch, steer, rear_spin, front_spin), x, y of the rear contact; bodies R,
# B, H, F.


def bicycle_poses(p, q):
    """The rear frame in yaw, lean, pitch; the front frame turned about the steer axis, which is tilted back
    by lam.
    """
    x, y, yaw, lean, pitch, steer, rear_spin, front_spin = q
    wheel_plane = rot_z(yaw) @ rot_x(lean)
    rear = wheel_plane @ rot_y(pitch)
    front = rear @ rot_y(-p["lam"]) @ rot_z(-steer) @ rot_y(p["lam"])
    rear_hub = jnp.stack([x, y, 0.0]) + p["rR"] * wheel_plane[:, 2]
    steer_axis = rear_hub + rear @ jnp.array(
        [p["w"] + p["c"], 0.0, -p["rR"]]
    )  # where it meets the ground when upright
    positions = [
        rear_hub,
        rear_hub + rear @ jnp.array([p["xB"], 0.0, -p["zB"] - p["rR"]]),
        steer_axis + front @ jnp.array([p["xH"] - p["w"] - p["c"], 0.0, -p["zH"]]),
        steer_axis + front @ jnp.array([-p["c"], 0.0, p["rF"]]),
    ]
    return Bodies(
        jnp.stack(positions), jnp.stack([rear @ rot_y(rear_spin), rear, front, front @ rot_y(front_spin)])
    )


def bicycle_rows(p, here, v, omega):
    """Neither wheel slips; the front contact stays at its height."""
    rear, front = (
        slip(here.orientation[b, :, 1], radius, v[b], omega[b]) for b, radius in ((0, p["rR"]), (3, p["rF"]))
    )
    return jnp.concatenate([rear[:2], front])


def bicycle_inertia(p):
    """Inertias in body axes with z up, where products of inertia have the other sign."""

    def frame(xx, yy, zz, xz):
        return jnp.array([[xx, 0.0, -xz], [0.0, yy, 0.0], [-xz, 0.0, zz]])

    rear_wheel, front_wheel = (frame(p[f"I{b}xx"], p[f"I{b}yy"], p[f"I{b}xx"], 0.0) for b in "RF")
    rear_frame, front_frame = (frame(*(p[f"I{b}{axes}"] for axes in ("xx", "yy", "zz", "xz"))) for b in "BH")
    return jnp.stack([rear_wheel, rear_frame, front_frame, front_wheel])


def bicycle_rates(p, t, y):
    """`d (q, qdot) / dt` of the bicycle, y of 16 numbers."""
    q, qdot = y[:8], y[8:]
    mass = jnp.array([p["mR"], p["mB"], p["mH"], p["mF"]])
    qddot = accelerations(
        lambda q: bicycle_poses(p, q),
        lambda *at: bicycle_rows(p, *at),
        mass,
        bicycle_inertia(p),
        weights(mass, p["g"]),
        q,
        qdot,
    )
    return jnp.concatenate([qdot, qddot])


def integrate(rates, p, starts, end, solver="Dopri8", tolerance=1e-8):
    """Final states (lanes, states) at time `end` of a batch of starts at t = 0.

    **Arguments:** `rates(p, t, y)` of one lane; `solver`, a name in `SOLVERS`; `tolerance`, both absolute and
    relative.
    """

    def one(y):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, p: rates(p, t, y)),
            SOLVERS[solver](),
            0.0,
            end,
            None,
            y,
            args=p,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            saveat=diffrax.SaveAt(t1=True),
            max_steps=100_000,
        ).ys[0]

    return jax.vmap(one)(starts)
