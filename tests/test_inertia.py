"""What has no inertia has no acceleration: it is refused by name where it never has any, and a lane says so where it has none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from tolerances import tolerance

import jourdain_jax as jj


class Weightless(jj.Scene):
    """A bead at x, and a force on a coordinate y that moves nothing."""

    mass: jnp.ndarray = jj.parameter(2.0, unit="kg")
    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=3.0, y_rate=1.0),)


class Geared(Weightless):
    """A bead whose y is geared to x by a row: `y_rate = 2 x_rate`."""

    def velocity_constraints(self, motion):
        return {"gear": motion.u.y_rate - 2.0 * motion.u.x_rate}


class Twice(Weightless):
    """x and y move the same bead along the same line."""

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, jnp.stack([q.x + q.y, 0.0 * q.x, 0.0 * q.x]))}


class ThinRod(jj.Scene):
    """A rod without thickness, free in space: nothing resists its spin about its own axis."""

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        return {"rod": jj.RigidBody.rod(1.0, 0.8, axis="x", position=q.array[:3], orientation=jj.quaternion_to_matrix(q["attitude"]))}


class OnSphere(jj.Scene):
    """A particle on a sphere in spherical angles: at the pole, and only there, the azimuth has no inertia."""

    coordinates = jj.coordinates("polar azimuth")
    example = {"polar": 1.0, "azimuth_rate": 0.5}

    def bodies(self, t, q):
        s = jnp.sin(q.polar)
        return {"particle": jj.Particle(1.0, jnp.stack([s * jnp.cos(q.azimuth), s * jnp.sin(q.azimuth), jnp.cos(q.polar)]))}


class Tumbling(jj.Scene):
    """A free body whose inertia is a matrix, as a CAD program gives it."""

    inertia: jnp.ndarray = jj.parameter(np.array([[1.0, 0.1, 0.2], [0.1, 1.3, 0.05], [0.2, 0.05, 0.9]]), unit="kg m^2")
    coordinates = jj.coordinates(jj.quaternion("attitude"))

    def bodies(self, t, q):
        return {"body": jj.RigidBody(1.0, self.inertia, jnp.zeros(3), jj.quaternion_to_matrix(q.attitude))}


def test_an_inertia_that_is_a_matrix_is_lowered_and_its_symmetric_part_counts():
    scene = Tumbling()
    assert jj.lower(scene).operations < 100
    omega = np.array([1.0, -0.5, 2.0])

    def turned(inertia):
        return jj.simulate(Tumbling(inertia), {"attitude_omega": omega}, ts=[0.5], rtol=1e-11, atol=1e-11).u_end

    I, along = np.asarray(scene.inertia), np.array([[0.3, 0.7, 0.0], [0.7, 0.0, -0.4], [0.0, -0.4, 0.2]])
    for s in (0.0, 1.0):
        found = jj.accelerations(Tumbling(I + s * along), 0.0, [1.0, 0.0, 0.0, 0.0], omega).udot
        assert_allclose((I + s * along) @ found, np.cross((I + s * along) @ omega, omega), rtol=1e-12, atol=1e-12)  # Euler
    slopes = jax.jacrev(turned)(I)
    assert_allclose(slopes, np.swapaxes(slopes, 1, 2), atol=1e-14)
    differences = (turned(I + 1e-4 * along) - turned(I - 1e-4 * along)) / 2e-4
    assert_allclose(np.sum(slopes * along, axis=(1, 2)), differences, rtol=1e-6)


@pytest.mark.parametrize(
    ("scene", "names"),
    [
        (Weightless(), "`y_rate`"),
        (Weightless(mass=0.0), "`x_rate`"),  # one of the two that have none
        (Twice(), "`x_rate`, `y_rate` together"),
        (ThinRod(), "`attitude_omega_x`"),
    ],
)
@pytest.mark.parametrize("ask", [jj.structure_of, jj.report, lambda scene: jj.simulate(scene, {}, t1=1.0)], ids=["structure", "report", "simulate"])
def test_speeds_that_move_no_mass_are_refused_by_name(scene, names, ask):
    with pytest.raises(ValueError, match=f"has inertia along .*{names}.*: no mass moves with it"):
        ask(scene)


def test_a_coordinate_without_inertia_that_a_row_holds_is_no_fault():
    # virtual power of both forces: m x'' = 3 + 2 * 1
    motion = jj.simulate(Geared(), {}, t1=2.0, rtol=1e-12, atol=1e-12).raise_if_failed()
    assert_allclose(motion.q_end, np.array([1.0, 2.0]) * 0.5 * 2.5 * 4.0, rtol=tolerance("closed_form"))


def test_an_isolated_loss_of_inertia_is_no_fault_of_the_scene():
    scene = OnSphere()
    assert jj.structure_of(scene).degrees_of_freedom == 2
    q, u, _ = scene.named(azimuth_rate=0.5)  # at the pole
    for name, found in ((name, jj.accelerations(scene, 0.0, q, u, reduction=name)) for name in jj.reductions(scene)):
        assert not found.applicable, name
    assert np.all(np.isnan(jj.accelerations(scene, 0.0, q, u).udot))


def test_a_motion_that_starts_without_inertia_says_so_instead_of_inventing_an_acceleration():
    q, u, _ = OnSphere().named(azimuth_rate=0.5)
    stuck = jj.simulate(OnSphere(), jj.consistent(OnSphere(), 0.0, q, u), t1=1.0)
    assert int(stuck.result) == results.NOT_FINITE
    assert "no inertia along a free direction" in stuck.message


def test_a_lane_without_mass_says_so_and_harms_no_other():
    lanes = jj.rollout(Geared(), {}, parameters={"mass": np.array([2.0, 0.0])}, t1=2.0, progress=False)
    assert lanes.result.tolist() == [results.SUCCESS, results.NOT_FINITE]
    assert_allclose(lanes.lane(0).q_end[0], 5.0, rtol=1e-7)


def test_derivatives_at_a_state_with_inertia_are_finite_beside_the_guard():
    def azimuth(polar):
        q, u, _ = OnSphere().named(polar=polar, polar_rate=0.3, azimuth_rate=0.5)
        return jj.accelerations(OnSphere(), 0.0, q, u).udot[1]

    # azimuth'' = -2 polar' azimuth' cot(polar)
    assert_allclose(jax.grad(azimuth)(0.7), 0.3 / np.sin(0.7) ** 2, rtol=1e-12)


def test_verification_fails_where_no_acceleration_is_determined_and_says_so():
    q, u, _ = OnSphere().named(azimuth_rate=0.5)
    found = jj.verify(OnSphere(), jj.consistent(OnSphere(), 0.0, q, u))
    assert not found.passed
    assert "no reduction applies" in str(found)
    assert set(found.not_applicable) == set(jj.reductions(OnSphere()))


class BurningRocket(jj.Scene):
    """Fuel leaves with the speed that the rocket has; a force pushes along x."""

    coordinates = jj.coordinates("x angle")

    def bodies(self, t, q):
        left = 2.0 - 0.5 * t
        return {"rocket": jj.RigidBody(left, left * jnp.ones(3), jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]), jj.rot_z(q.angle))}

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=3.0),)


def test_mass_that_leaves_takes_its_momentum_with_it():
    motion = jj.simulate(BurningRocket(), {"x_rate": 1.0, "angle_rate": 2.0}, t1=2.0, rtol=1e-10, atol=1e-10)
    assert_allclose(motion.u_end, [1.0 + 6.0 * np.log(2.0), 2.0], atol=1e-9)  # m x'' = F, I angle'' = 0
