"""The wrong mode of differentiation is answered by an error of our own, the right one by the right derivative."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BeadOnTurningWire

import jourdain_jax as jj
from jourdain_jax import DifferentiationModeError
from jourdain_jax.calculus.guards import forward_only, reverse_only


def decay(rate, adjoint):
    """`sum y(1)` of `ydot = -rate y` from ones."""
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-10)
    term = diffrax.ODETerm(lambda t, y, rate: -y * rate)
    solution = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, None, jnp.ones(2), rate, stepsize_controller=controller, adjoint=adjoint, throw=False)
    return jnp.sum(solution.ys)


def reverse(rate):
    return decay(reverse_only(rate), diffrax.RecursiveCheckpointAdjoint())


def forward(rate):
    return forward_only(decay(rate, diffrax.ForwardMode()))


FORWARD_USES = {
    "jacfwd": jax.jacfwd(reverse),
    "jacfwd of jit": jax.jacfwd(eqx.filter_jit(reverse)),
    "jit of jacfwd": jax.jit(jax.jacfwd(reverse)),
    "jit of jacfwd of jit": jax.jit(jax.jacfwd(jax.jit(reverse))),
    "jvp": lambda x: jax.jvp(reverse, (x,), (x,)),
    "jvp of jit": lambda x: jax.jvp(jax.jit(reverse), (x,), (x,)),
    "vmap of jvp along one direction": lambda x: jax.vmap(lambda x: jax.jvp(reverse, (x,), (1.0,)))(jnp.full(2, x)),
}
SECOND_USES = {
    "hessian": jax.hessian(reverse),
    "grad of grad": jax.grad(jax.grad(reverse)),
    "grad of grad of jit": jax.grad(lambda x: jax.grad(eqx.filter_jit(reverse))(x)),
    "jit of grad of grad": jax.jit(jax.grad(jax.grad(reverse))),
}


@pytest.mark.parametrize("use", FORWARD_USES)
def test_forward_mode_through_a_reverse_only_adjoint_names_the_adjoint_to_use(use):
    with pytest.raises(DifferentiationModeError, match="ForwardMode"):
        FORWARD_USES[use](1.0)


def test_forward_mode_along_a_time_names_the_adjoint_to_use():
    with pytest.raises(DifferentiationModeError, match="ForwardMode"):
        jax.jvp(lambda t1: jj.simulate(BeadOnTurningWire(), {"r": 0.5}, ts=[0.1], t1=t1, backend="xla").q_end, (0.2,), (1.0,))


def test_reverse_mode_of_the_time_of_an_event_names_the_adjoint_to_use():
    with pytest.raises(DifferentiationModeError, match="RecursiveCheckpointAdjoint"):
        jax.grad(lambda lean: jj.simulate(jj.models.TiltingDisc(), {"lean": lean}, ts=[0.1], adjoint=diffrax.ForwardMode()).t_end)(0.3)


@pytest.mark.parametrize("use", SECOND_USES)
def test_second_derivatives_through_a_reverse_only_adjoint_name_the_adjoint_to_use(use):
    with pytest.raises(DifferentiationModeError, match="differentiated twice"):
        SECOND_USES[use](1.0)


@pytest.mark.parametrize("ask", [jj.report, jj.verify, jj.energy_balance, jj.sample_states])
@pytest.mark.parametrize("inside", [jax.jit, jax.vmap, lambda f: lambda x: jax.jvp(f, (x,), (x,))])
def test_functions_that_need_numbers_say_so_by_name(ask, inside):
    with pytest.raises(jj.DifferentiationModeError, match=rf"`{ask.__name__}` was called inside jit, vmap or a derivative.*outside"):
        inside(lambda radius: ask(jj.models.TiltingDisc(radius=radius)))(jnp.array([0.5]) if inside is jax.vmap else 0.5)


def test_what_a_motion_says_in_words_and_pictures_needs_its_numbers(tmp_path):
    motion = jj.simulate(BeadOnTurningWire(), {"r": 0.5}, ts=[0.1])
    written = {jj.save: "motion.npz", jj.show: "motion.html", jj.plot: "motion.png", jj.animate: "motion.gif"}
    asks = {ask.__name__: lambda motion, ask=ask, name=name: ask(motion, path=tmp_path / name) for ask, name in written.items()}
    asks |= {"message": lambda motion: motion.message, "warnings": lambda motion: motion.warnings, "raise_if_failed": lambda motion: motion.raise_if_failed()}
    for name, ask in asks.items():
        with pytest.raises(jj.DifferentiationModeError, match=f"`{name}` was called inside jit"):
            jax.jit(ask)(motion)
    assert not list(tmp_path.iterdir())


def test_functions_that_need_numbers_take_known_ones_where_others_are_traced():
    wire, found = BeadOnTurningWire(), []
    motion = jj.simulate(wire, {"r": 0.5}, ts=[0.1])
    jax.jit(lambda x: found.extend([jj.energy_balance(wire), motion.raise_if_failed().message, jj.sample_states(wire, 1)[1].shape]) or x)(0.5)
    assert found == [jj.energy_balance(wire), motion.message, (1, 1)]


@pytest.mark.parametrize("use", [jax.grad(forward), jax.jit(jax.grad(jax.jit(forward)))])
def test_reverse_mode_through_a_forward_only_adjoint_names_the_adjoint_to_use(use):
    with pytest.raises(DifferentiationModeError, match="RecursiveCheckpointAdjoint"):
        use(1.0)


BATCHED_REVERSE = {
    "vmap of grad": jax.vmap(jax.grad(reverse)),
    "jit of vmap of grad of jit": jax.jit(jax.vmap(jax.grad(jax.jit(reverse)))),
    "grad of vmap": jax.grad(lambda x: jnp.sum(jax.vmap(reverse)(x))),
    "grad of vmap of jit": jax.jit(jax.grad(lambda x: jnp.sum(jax.vmap(eqx.filter_jit(reverse))(x)))),
    "grad of checkpoint": jax.grad(jax.checkpoint(lambda x: jnp.sum(jax.vmap(reverse)(x)))),
    "grad of map": jax.grad(lambda x: jnp.sum(jax.lax.map(reverse, x))),
    "diagonal of jacrev": lambda x: jnp.diagonal(jax.jacrev(jax.jit(jax.vmap(reverse)))(x)),
}


@pytest.mark.parametrize("use", BATCHED_REVERSE)
def test_first_order_reverse_mode_passes_the_marker_under_any_nesting(use):
    rates = jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(BATCHED_REVERSE[use](rates), -2 * np.exp(-np.asarray(rates)), rtol=1e-8)


def test_forward_over_forward_passes_the_forward_only_marker():
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(forward)))(1.0), 2 * np.exp(-1.0), rtol=1e-8)


@pytest.mark.parametrize("adjoint", [None, diffrax.ForwardMode()], ids=["reverse", "forward"])
@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_a_wrong_parameter_has_derivatives_that_are_nan(adjoint, backend):
    scene = jj.models.Skate()
    derivative = jax.jacrev if adjoint is None else jax.jacfwd

    def place(gravity_and_speed):
        mass, speed = gravity_and_speed
        return jj.simulate(scene.replace(mass=mass), {"x_rate": speed, "heading_rate": 0.7}, ts=[0.5], backend=backend, adjoint=adjoint).q[0]

    numbers = jnp.array([[1.0, 0.5], [jnp.nan, 0.5], [-1.0, 0.5]])
    slopes = jax.jit(jax.vmap(derivative(place)))(numbers)
    alone = jax.jit(derivative(place))(numbers[0])
    np.testing.assert_allclose(slopes[0], alone, rtol=1e-10, atol=1e-12)
    assert np.isfinite(alone).all()
    assert np.isnan(slopes[1:, :, 0]).all()
