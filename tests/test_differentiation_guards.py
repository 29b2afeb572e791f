"""What is not known inside a derivative, `jit` or `vmap` is answered by an error of our own, and a wrong parameter by NaN."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BeadOnTurningWire

import jourdain_jax as jj


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


@pytest.mark.parametrize("derivative", [jax.jacrev, jax.jacfwd])
@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_a_wrong_parameter_has_derivatives_that_are_nan(derivative, backend):
    scene = jj.models.Skate()

    def place(gravity_and_speed):
        mass, speed = gravity_and_speed
        return jj.simulate(scene.replace(mass=mass), {"x_rate": speed, "heading_rate": 0.7}, ts=[0.5], backend=backend).q[0]

    numbers = jnp.array([[1.0, 0.5], [jnp.nan, 0.5], [-1.0, 0.5]])
    slopes = jax.jit(jax.vmap(derivative(place)))(numbers)
    alone = jax.jit(derivative(place))(numbers[0])
    np.testing.assert_allclose(slopes[0], alone, rtol=1e-10, atol=1e-12)
    assert np.isfinite(alone).all()
    assert np.isnan(slopes[1:, :, 0]).all()
