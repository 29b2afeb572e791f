"""Ready-made rows in motion: welds, driven coordinates, and Baumgarte's terms."""

import jax.numpy as jnp
import numpy as np
from tolerances import CLOSED_FORM, DRIFT, RESIDUAL, relative_error

import jourdain_jax as jj

GRAVITY = 9.81
TIGHT = {"rtol": 1e-12, "atol": 1e-12}


def upright(angle):
    """Orientation of a body that swings in the x-z plane: its axis x points down at angle zero."""
    return jj.rot_y(jnp.pi / 2 - angle)


class BodyPendulum(jj.Scene):
    """A rod in the plane, free in its coordinates and pinned at one end."""

    mass: float = jj.parameter(1.2, unit="kg", positive=True)
    length: float = jj.parameter(0.8, unit="m", positive=True)
    coordinates = jj.coordinates("x z angle")
    domain = {"x": (-0.4, 0.4), "z": (-0.4, 0.4), "angle": (-1.2, 1.2)}

    def bodies(self, t, q):
        place = jnp.stack([q.x, 0.0, q.z])
        return {
            "rod": jj.RigidBody.rod(
                self.mass, self.length, axis="x", position=place, orientation=upright(q.angle)
            )
        }

    def geometric_constraints(self, pose):
        end = pose["rod"].place([-0.5 * self.length, 0.0, 0.0])
        return {"hinge": jj.pin(jnp.zeros(3), end, axes="xz")}

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)


class Welded(jj.Scene):
    """Two half rods in space, welded end to end at a right angle, free in space as one."""

    mass: float = jj.parameter(0.7, unit="kg", positive=True)
    length: float = jj.parameter(0.5, unit="m", positive=True)
    coordinates = jj.coordinates("x1 y1 z1", jj.quaternion("a1"), "x2 y2 z2", jj.quaternion("a2"))
    domain = dict.fromkeys(("x1", "y1", "z1", "x2", "y2", "z2"), (-0.3, 0.3))

    def bodies(self, t, q):
        def half(place, attitude):
            orientation = jj.quaternion_to_matrix(attitude)
            moments = self.mass * self.length**2 / 12 * jnp.array([0.01, 1.0, 1.0])
            return jj.RigidBody(self.mass, moments, place, orientation)

        return {"first": half(q.array[:3], q["a1"]), "second": half(q.array[7:10], q["a2"])}

    def geometric_constraints(self, pose):
        joint = {
            "at_first": jnp.stack([0.5 * self.length, 0.0, 0.0]),
            "at_second": jnp.stack([-0.5 * self.length, 0.0, 0.0]),
        }
        return {
            "weld": jj.weld(pose["first"], pose["second"], **joint, turn=jj.rot_z(jnp.asarray(jnp.pi / 2)))
        }


def test_a_weld_of_two_bodies_keeps_them_together_and_their_momentum():
    scene = Welded()
    structure = jj.structure_of(scene)
    assert structure.rank == 6
    assert structure.degrees_of_freedom == 6
    quarter = jj.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.asarray(jnp.pi / 2))
    start = jj.start(
        scene,
        x1=0.0,
        y1=0.0,
        z1=0.0,
        a1=jnp.array([1.0, 0, 0, 0]),
        x2=0.25,
        y2=0.25,
        z2=0.0,
        a2=quarter,
        a1_omega=jnp.array([0.6, -1.1, 2.0]),
    )
    motion = jj.simulate(scene, start, t1=3.0, ts=jnp.linspace(0.0, 3.0, 4), **TIGHT)
    motion.raise_if_failed()
    positions, velocities = motion.residuals()
    assert np.max(np.abs(positions)) <= RESIDUAL
    assert np.max(np.abs(velocities)) <= RESIDUAL
    moving = motion.motions()
    momentum = sum(body.mass[:, None] * body.velocity for body in moving.bodies.values())
    spin = sum(
        body.mass[:, None] * jnp.cross(body.position, body.velocity)
        + jnp.einsum(
            "tij,tjk,tlk,tl->ti", body.orientation, body.body.inertia, body.orientation, body.angular_velocity
        )
        for body in moving.bodies.values()
    )
    assert relative_error(momentum, jnp.broadcast_to(momentum[0], momentum.shape), 1.0) <= DRIFT
    assert relative_error(spin, jnp.broadcast_to(spin[0], spin.shape)) <= DRIFT


class Driven(jj.Scene):
    """A mass on a spring whose other end is driven as a given function of time."""

    mass: float = jj.parameter(2.0, unit="kg", positive=True)
    stiffness: float = jj.parameter(18.0, unit="N/m", positive=True)
    amplitude: float = jj.parameter(0.1, unit="m")
    rate: float = jj.parameter(2.0, unit="rad/s")
    coordinates = jj.coordinates("end place")

    def bodies(self, t, q):
        o = 0.0 * q.place
        return {"end": jj.Particle(0.5, [q.end, o, o]), "mass": jj.Particle(self.mass, [1.0 + q.place, o, o])}

    def loads(self, motion):
        return jj.spring(motion["end"].point(), motion["mass"].point(), self.stiffness, 1.0)

    def prescribed(self, t):
        return {"end": self.amplitude * jnp.sin(self.rate * t)}


def test_a_driven_coordinate_needs_the_force_of_the_closed_form_and_does_its_work():
    scene = Driven()
    w, W, a = 3.0, 2.0, 0.1  # sqrt(k/m), drive, amplitude
    ts = jnp.linspace(0.0, 4.0, 9)
    motion = jj.simulate(scene, {"place": 0.0, "place_rate": 0.0}, ts=ts, **TIGHT)
    # m x'' = -k (x - a sin W t), x(0) = x'(0) = 0
    b = a * w**2 / (w**2 - W**2)
    x = b * (jnp.sin(W * ts) - W / w * jnp.sin(w * ts))
    assert relative_error(motion["place"], x) <= CLOSED_FORM
    drive = a * jnp.sin(W * ts)
    force = -0.5 * W**2 * drive + 18.0 * (drive - x)  # of the actuator: m_end end'' = F + k (x - end)
    assert relative_error(motion.constraint_forces().multipliers[:, 0], force) <= CLOSED_FORM
    balance = motion.energies().balance  # T + V less the work of the actuator
    assert relative_error(balance, jnp.broadcast_to(balance[0], ts.shape), 0.1) <= DRIFT


def test_baumgartes_terms_pull_a_start_off_the_constraints_back_as_their_own_oscillator():
    """`gddot + 2 a gdot + b^2 g = 0` on the hinge: off by g0 at rest, critically damped
    `g = g0 (1 + a t) exp(-a t)`.
    """
    scene = BodyPendulum()
    q, u, _ = scene.named(x=0.4 * np.sin(0.9) + 1e-3, z=-0.4 * np.cos(0.9), angle=0.9)
    off = jj.State(
        jnp.asarray(0.0), q, u, *(jnp.asarray(0.0),) * 3, (scene.coordinate_names, scene.speed_names)
    )
    ts = jnp.linspace(0.0, 1.0, 6)
    terms = jj.Baumgarte(alpha=4.0, beta=4.0)
    motion = jj.simulate(scene, off, ts=ts, formulation=jj.Formulation("full", stabilisation=terms), **TIGHT)
    positions, _ = motion.residuals()
    assert relative_error(positions[:, 0], 1e-3 * (1 + 4 * ts) * jnp.exp(-4 * ts)) <= 1e-8
    without = jj.simulate(scene, off, ts=ts, formulation=jj.Formulation("full", stabilisation=None), **TIGHT)
    assert relative_error(without.residuals()[0][:, 0], jnp.full(6, 1e-3)) <= 1e-8
