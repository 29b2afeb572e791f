"""Linearisation on the constraint manifold, against published bicycles, closed forms, and what a state that is not steady must show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import rolling_disc, whipple_bicycle
from small_scenes import DrivenPendulum
from tolerances import relative_error, tolerance

import jourdain_jax as jj
from jourdain_jax import linearize
from jourdain_jax.models import DoublePendulumAngles, FreeRigidBody, TiltingDisc, WhippleBicycle

SPEEDS = np.arange(11.0)
DISC = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}


def _running(bicycle, speed, **values):
    return jj.consistent(bicycle, 0.0, *bicycle.named(**{**bicycle.upright(speed), **values})[:2])


@pytest.fixture(scope="module")
def bicycles():
    """The benchmark bicycle linearised at v = 0, 1 ... 10 m/s, one after the other: a batch of them would be compiled for one use."""
    bicycle = WhippleBicycle()
    found = [linearize(bicycle, _running(bicycle, v), ("lean", "steer"), dependent=("pitch",)) for v in SPEEDS]
    return jax.tree.map(lambda *x: np.stack(x), *found)


def _lane(batch, i):
    return jax.tree.map(lambda x: x[i], batch)


def test_the_nonlinear_bicycle_has_the_published_matrices(bicycles):
    limit = tolerance("linearization")
    v = SPEEDS[:, None, None]
    assert relative_error(bicycles.M, np.broadcast_to(whipple_bicycle.M, (11, 2, 2))) < limit
    assert relative_error(bicycles.C, v * whipple_bicycle.C1) < limit
    assert relative_error(bicycles.K, 9.81 * whipple_bicycle.K0 + v**2 * whipple_bicycle.K2) < limit
    assert relative_error(bicycles.C[1], whipple_bicycle.C1) < limit
    assert relative_error(bicycles.K[0] / 9.81, whipple_bicycle.K0) < limit
    assert relative_error((bicycles.K[10] - bicycles.K[0]) / 100, whipple_bicycle.K2) < limit


@pytest.mark.parametrize("v", range(11))
def test_the_nonlinear_bicycle_has_the_published_eigenvalues(bicycles, v):
    expected = whipple_bicycle.EIGENVALUES[v]
    expected = expected[np.lexsort((expected.imag, expected.real))]
    assert np.max(np.abs(np.asarray(_lane(bicycles, v).eigenvalues()) - expected)) < tolerance("linearization")


def test_the_bicycle_is_steady_and_lean_and_steer_are_a_system_of_their_own(bicycles):
    assert float(jnp.max(bicycles.residual)) < tolerance("round_off")
    assert float(jnp.max(bicycles.coupling)) < tolerance("round_off")
    assert float(jnp.min(bicycles.pivot)) > 0.1


def test_lean_and_steer_torque_act_on_lean_and_steer(bicycles):
    assert bicycles.inputs == ("lean_torque", "steer_torque")
    assert relative_error(bicycles.F, np.broadcast_to(np.eye(2), (11, 2, 2))) < tolerance("round_off")


def test_the_first_order_form_has_the_same_motion(bicycles):
    """A and B in the lean and steer rows are the published state matrix; the dependent yaw rate is the published one."""
    five = _lane(bicycles, 5)
    rows = [five.states.index(name) for name in ("lean", "steer", "lean_rate", "steer_rate")]
    A = np.asarray(five.A)
    assert relative_error(A[np.ix_(rows, rows)], whipple_bicycle.state_matrix(5.0)) < tolerance("linearization")
    assert relative_error(np.asarray(five.B)[rows[2:]], np.linalg.inv(whipple_bicycle.M)) < tolerance("linearization")
    # yaw to the left is positive here: yaw_rate = -(v steer + c steer_rate) cos(lam)/w
    expected = -np.cos(np.pi / 10) / 1.02 * np.array([5.0, 0.08])
    yaw = A[five.states.index("yaw")]
    assert relative_error([yaw[five.states.index("steer")], yaw[five.states.index("steer_rate")]], expected) < tolerance("round_off")


def test_the_dependent_pitch_is_found_without_being_named():
    bicycle = WhippleBicycle()
    small = linearize(bicycle, _running(bicycle, 5.0), ("lean", "steer"))
    assert "pitch" not in small.states
    assert len(small.states) == 7 + 3


def test_modes_solve_the_second_order_form(bicycles):
    five = _lane(bicycles, 5)
    modes = five.modes()
    for s, shape in zip(modes.eigenvalues, modes.shapes.T, strict=True):
        assert np.max(np.abs((five.M * s**2 + five.C * s + five.K) @ shape)) < 1e-9 * np.max(np.abs(five.K))
        assert np.max(np.abs(shape)) == pytest.approx(1.0, abs=1e-12)


def test_a_bicycle_that_leans_is_not_steady_and_says_so():
    bicycle = WhippleBicycle()
    small = linearize(bicycle, _running(bicycle, 5.0, lean=0.2), ("lean", "steer"), dependent=("pitch",))
    leant = _running(bicycle, 5.0, lean=0.2)
    udot = jj.accelerations(bicycle, 0.0, leant.q, leant.u).udot
    y = [bicycle.speed_names.index(name, "speed") for name in bicycle.privileged]
    assert float(small.acceleration) == pytest.approx(float(jnp.max(jnp.abs(udot[np.array(y)]))), rel=1e-12)
    assert float(small.acceleration) > 1.0
    assert float(small.residual) >= float(small.acceleration)


def test_a_passage_through_equilibrium_is_not_steady():
    """A pendulum that swings through the vertical has no acceleration there, but its change."""
    pendulum = DoublePendulumAngles()
    names = pendulum.coordinate_names.entries
    swinging = jj.start(pendulum, **{f"{names[0]}_rate": 1.0})
    small = linearize(pendulum, swinging)
    assert float(small.acceleration) < 1e-12
    assert float(small.residual) > 1.0
    assert float(linearize(pendulum, jj.start(pendulum)).residual) < 1e-12


def test_a_double_pendulum_has_its_normal_frequencies():
    pendulum = DoublePendulumAngles()
    small = linearize(pendulum, jj.start(pendulum))
    q, u, _ = pendulum.named()
    M = jj.unconstrained_equations(pendulum, 0.0, q, u).M
    K = jax.hessian(lambda q: jj.potential_energy(pendulum, jj.motion_at(pendulum, 0.0, q, u)))(q)
    squared = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)
    found = np.sort(np.asarray(small.eigenvalues().imag) ** 2)
    assert relative_error(found, np.repeat(squared, 2)) < tolerance("round_off")
    assert relative_error(small.M, M) < tolerance("round_off")
    assert relative_error(small.K, K) < tolerance("round_off")
    assert relative_error(small.C, np.zeros((2, 2)), size=1.0) < tolerance("round_off")


@pytest.mark.parametrize("spin", [4.0, 2.0, 6.0])
def test_upright_rolling_has_the_classical_frequency(spin):
    disc = TiltingDisc(**DISC)
    squared = rolling_disc.upright_rolling_frequency_squared(spin, **DISC)
    values = linearize(disc, jj.start(disc, spin_rate=spin)).eigenvalues()
    fastest = values[jnp.argmax(jnp.abs(values))]
    assert complex(fastest**2).real == pytest.approx(-squared, rel=1e-9)
    assert (squared > 0) == (spin > rolling_disc.rolling_threshold(**DISC))


def test_upright_spinning_is_stable_beyond_the_classical_threshold():
    disc, threshold = TiltingDisc(**DISC), rolling_disc.spinning_threshold(**DISC)
    for factor, grows in ((0.99, True), (1.01, False)):
        values = linearize(disc, jj.start(disc, yaw_rate=factor * threshold)).state_eigenvalues()
        assert (float(jnp.max(values.real)) > 0.1) == grows


def test_what_couples_the_named_coordinate_to_the_rest_is_reported():
    """Lean alone is no system of its own: the gyroscopic torque of yaw is left out."""
    disc = TiltingDisc(**DISC)
    alone = linearize(disc, jj.start(disc, spin_rate=4.0), ("lean",))
    together = linearize(disc, jj.start(disc, spin_rate=4.0))
    assert together.coordinates == ("yaw", "lean", "spin")
    assert float(alone.coupling) == pytest.approx(1.5, rel=1e-12)  # (C + m a^2) spin = 1.5 N m s, where nothing else is in C
    assert float(together.coupling) == 0.0


def test_a_free_body_spins_stably_about_its_extreme_axes_only():
    """Euler: perturbed rates go with s^2 = -(I2 - I1)(I2 - I3) w^2/(I1 I3) about axis 2; turns are seen from the turning body."""
    body, rate = FreeRigidBody(), 2.0
    I = [float(body.i1), float(body.i2), float(body.i3)]
    for k, axis in enumerate("xyz"):
        i, j = (k + 1) % 3, (k + 2) % 3
        squared = -(I[k] - I[i]) * (I[k] - I[j]) * rate**2 / (I[i] * I[j])
        small = linearize(body, jj.start(body, **{f"attitude_omega_{axis}": rate}))
        values = np.asarray(small.state_eigenvalues())
        expected = np.sqrt(complex(squared))
        assert np.min(np.abs(values - expected)) < 1e-9
        assert np.min(np.abs(values - 1j * rate)) < 1e-9  # a turned axis of rotation, seen from the body
        assert float(small.residual) < 1e-12


def test_a_prescribed_motion_is_not_steady_while_it_accelerates():
    scene = DrivenPendulum()
    assert float(linearize(scene, jj.start(scene)).residual) > 0.1


@pytest.mark.parametrize("derivative", [jax.jacrev, pytest.param(jax.jacfwd, marks=pytest.mark.slow)])
def test_derivatives_pass_through_linearisation(derivative):
    """Of the gravity term -m g a of lean in the radius, and of the gyroscopic one (C + m a^2) spin = 3/2 m a^2 spin."""

    def terms(radius):
        disc = TiltingDisc(**{**DISC, "radius": radius})
        small = linearize(disc, jj.consistent(disc, 0.0, *disc.named(spin_rate=4.0, x_rate=4.0 * radius)[:2]), ("yaw", "lean", "spin"))
        return jnp.stack([small.K[1, 1], small.C[1, 0]])

    assert_allclose(jax.jit(derivative(terms))(0.5), [-9.81, -3.0 * 0.5 * 4.0], rtol=tolerance("round_off"))


def test_wrong_names_are_answered_with_valid_ones():
    bicycle = WhippleBicycle()
    state = _running(bicycle, 5.0)
    with pytest.raises(ValueError, match="no coordinate `learn` to perturb; did you mean `lean`"):
        linearize(bicycle, state, ("learn",))
    with pytest.raises(ValueError, match="said to be dependent"):
        linearize(bicycle, state, ("pitch",), dependent=("pitch",))
    with pytest.raises(ValueError, match="not among the privileged speeds"):
        linearize(bicycle, state, ("yaw",))
    with pytest.raises(ValueError, match="unknown privileged speed"):
        linearize(bicycle, state, ("lean",), privileged=("lean_rte",))
    with pytest.raises(ValueError, match="tie the asked coordinates"):
        linearize(bicycle, state, ("lean", "pitch"))


# Minutes of compilation, and not yet run together with the rest: kept out of the short run until it has been.


class TwoSkates(jj.Scene):
    """Two bodies on skates, one turned against the other about a pin at the rear one's front."""

    coordinates = jj.coordinates("x y heading steer")

    def bodies(self, t, q):
        o, moments = 0.0 * q.x, (0.1, 0.2, 0.3)
        ahead = jnp.stack([jnp.cos(q.heading), jnp.sin(q.heading), o])
        at = jnp.stack([q.x, q.y, o])
        front = jj.RigidBody(1.0, moments, at + ahead, jj.rot_z(q.heading + q.steer))
        return {"rear": jj.RigidBody(2.0, moments, at, jj.rot_z(q.heading)), "front": front}

    def velocity_constraints(self, motion):
        return {name: body.orientation[:, 1] @ body.velocity for name, body in motion.bodies.items()}


@pytest.mark.parametrize("heading", [0.0, 0.7, np.pi / 2])
def test_speeds_are_chosen_at_the_state_where_those_of_the_domain_do_not_serve(heading):
    scene = TwoSkates()
    state = jj.start(scene, heading=heading, x_rate=np.cos(heading), y_rate=np.sin(heading))
    small = linearize(scene, state, ())
    assert small.pivot > 0.02
    # straight ahead at 1 m/s with both skates in line: a heading stays, a steer of the front one falls as exp(-t), an offset and the speed stay
    assert_allclose(small.state_eigenvalues().real, [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)
    in_jit = jax.jit(lambda u: linearize(scene, jj.consistent(scene, 0.0, state.q, u), ()))(state.u)
    assert in_jit.pivot < 1e-12
    assert np.isnan(in_jit.A).all()
    with pytest.raises(ValueError, match="do not follow from its rows at this state"):
        linearize(scene, state, (), privileged=("heading_rate", "steer_rate"))
