"""The reduced Appell equations and quadrature give the motion that all coordinates together give (row S9)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import two_wheel_axle
from scipy.integrate import solve_ivp
from tolerances import tolerance

import jourdain_jax as jj
from jourdain_jax.dynamics.reduced import (
    quadrature_times,
    recover_dropped,
    reduced_accelerations,
    reduced_coordinates,
    reduced_rates,
)
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.models import BallOnTurntable, ChaplyginSleigh, IsokineticParticle, TiltingDisc, TwoWheelAxleFree


def integrated(rates, start, times) -> np.ndarray:
    """Solution of an ordinary differential equation at `times`, to round-off."""
    compiled = jax.jit(rates)
    solution = solve_ivp(lambda t, x: np.asarray(compiled(t, x)), (0.0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-13, atol=1e-13)
    return solution.y.T


def reduced_motion(scene, kept, y, times) -> dict:
    """Dropped coordinates at `times` from the reduced equations, starting at zero."""

    def rates(t, x):
        kept, y = jnp.split(x, [count])
        return jnp.concatenate([reduced_rates(scene, t, kept, y), reduced_accelerations(scene, t, kept, y)])

    count = len(kept)
    nodes = quadrature_times(times, 6)
    run = integrated(rates, np.concatenate([kept, y]), np.asarray(nodes).ravel()).reshape(*nodes.shape, -1)
    start = dict.fromkeys(reduced_coordinates(scene).recovered, 0.0)
    return recover_dropped(scene, times, jnp.asarray(run[..., :count]), jnp.asarray(run[..., count:]), start)


def test_the_reduced_equations_of_the_axle_keep_its_heading_alone():
    found = reduced_coordinates(TwoWheelAxleFree())
    # theta is held by its row, phi2 equals phi1 by its row: both appear, neither moves by itself
    assert found.kept == ("phi1", "theta1", "phi2", "theta2")
    assert set(found.recovered) == {"x1", "y1", "z1", "psi1", "x2", "y2", "z2", "psi2"}


def test_a_disc_recovers_its_yaw_before_its_place():
    assert reduced_coordinates(TiltingDisc()).kept == ("lean",)
    assert reduced_coordinates(TiltingDisc()).dropped == (("yaw", "spin"), ("x", "y"))


def test_what_its_own_rate_needs_cannot_be_found_by_quadrature():
    # the attitude of a ball, and with it the place, on which the rolling on a turning table depends
    assert {"attitude_w", "attitude_x", "x", "y"} <= set(reduced_coordinates(BallOnTurntable()).kept)
    assert reduced_coordinates(ChaplyginSleigh()).kept == ("heading",)


def test_the_reduced_accelerations_of_the_axle_are_equations_64():
    scene = TwoWheelAxleFree()
    phi = 0.7
    psi1, phi_acceleration = reduced_accelerations(scene, 0.0, jnp.array([phi, 0.0, phi, 0.0]), jnp.array([1.3, 0.9]))
    expected = 1.2 * 9.81 * np.sin(0.2) * np.cos(phi) / (0.3 * (1.2 + 0.5))
    assert np.isclose(psi1, expected, rtol=tolerance("round_off"))
    assert abs(phi_acceleration) <= tolerance("round_off") * expected


def test_reduced_accelerations_are_those_of_the_whole_scene():
    scene = TiltingDisc()
    independent = list(jj.structure_of(scene).independent)

    @eval_numpy
    @jax.vmap
    def both(t, q, u):
        y = u[jnp.array(independent)]
        return reduced_accelerations(scene, t, q[3:4], y), jj.accelerations(scene, t, q, u).udot[jnp.array(independent)]

    reduced, whole = both(*(jnp.asarray(x) for x in jj.sample_states(scene, 20)))
    assert jnp.max(jnp.abs(reduced - whole)) <= tolerance("round_off") * jnp.max(jnp.abs(whole))


def test_quadrature_of_the_reduced_axle_gives_the_closed_form():
    run = two_wheel_axle.RUN
    times = jnp.linspace(0.0, 2.0, 21)
    found = reduced_motion(TwoWheelAxleFree(), [0.0] * 4, [run["psi1_rate"], run["phi_rate"]], times)
    exact = two_wheel_axle.motion(np.asarray(times), **run)
    for name in ("x1", "y1", "psi1", "psi2", "x2", "y2"):
        moved = exact[name] - exact[name][0]
        assert np.max(np.abs(np.asarray(found[name]) - moved)) <= tolerance("closed_form") * np.max(np.abs(moved)), name


def test_quadrature_of_the_reduced_disc_gives_the_whole_motion():
    scene = TiltingDisc()
    _, u, _ = scene.named(yaw_rate=0.5, lean_rate=0.2, spin_rate=-3.0)
    y = u[jnp.array(jj.structure_of(scene).independent)]
    times = jnp.linspace(0.0, 1.0, 21)
    found = reduced_motion(scene, [0.3], np.asarray(y), times)

    def whole(t, x):
        q, u = jnp.split(x, 2)
        return jnp.concatenate([coordinate_rates(scene, t, q, u), jj.accelerations(scene, t, q, u, reduction="qr").udot])

    q, u, _ = scene.named(lean=0.3, yaw_rate=0.5, lean_rate=0.2, spin_rate=-3.0, x_rate=-0.5 * 3.0)
    direct = integrated(whole, np.concatenate([q, u]), np.asarray(times))
    for name in ("x", "y", "yaw", "spin"):
        expected = direct[:, scene.coordinate_names.entries.index(name)]
        assert np.max(np.abs(np.asarray(found[name]) - expected)) <= tolerance("closed_form") * np.max(np.abs(expected)), name


def test_the_error_of_quadrature_falls_with_its_order():
    # yaw = t^2 from a rate 2 t; x = integral of a rate that needs yaw
    scene = TiltingDisc()

    def error(count):
        times = jnp.linspace(0.0, 1.0, count + 1)
        at = quadrature_times(times, 2)
        zero, one = jnp.zeros_like(at), jnp.ones_like(at)
        speeds = {"yaw_rate": 2 * at, "lean_rate": zero, "spin_rate": one}
        y = jnp.stack([speeds[name] for name in reduced_coordinates(scene).privileged], axis=-1)
        found = recover_dropped(scene, times, zero[..., None], y, dict.fromkeys(("x", "y", "yaw", "spin"), 0.0))
        # upright: xdot = radius spin_rate cos(yaw)
        fine = jnp.linspace(0.0, 1.0, 20001)
        exact = 0.5 * jnp.trapezoid(jnp.cos(fine**2), fine)
        return abs(found["yaw"][-1] - 1.0), abs(found["x"][-1] - exact)

    (yaw, coarse), (_, finer) = error(4), error(8)
    assert yaw <= tolerance("round_off")
    assert coarse / finer > 2**3 * 0.9


def test_missing_start_values_are_named():
    scene = TiltingDisc()
    times = jnp.linspace(0.0, 1.0, 3)
    with pytest.raises(ValueError, match="`yaw`, `spin`, `y`"):
        recover_dropped(scene, times, jnp.zeros((2, 2, 1)), jnp.zeros((2, 2, 3)), {"x": 0.0})


def test_rows_nonlinear_in_the_speeds_have_no_reduced_equations():
    with pytest.raises(ValueError, match="IsokineticParticle"):
        reduced_coordinates(IsokineticParticle())


# Minutes of compilation, and not yet run together with the rest: kept out of the short run until it has been.
