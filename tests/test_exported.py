"""Motions in programs that run elsewhere: exported ones, and those for other devices, hold no machine code of this process."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax import DifferentiationModeError
from jourdain_jax.calculus.elsewhere import or_elsewhere
from jourdain_jax.native import ffi

SKATE = jj.models.Skate()
SPEEDS = jnp.array([0.5, 1.0, 2.0])
MACHINE_CODE = "jourdain_jax_"  # names of handlers begin so


def _places(speed, **options):
    return jj.simulate(SKATE, {"heading": 0.3, "x_rate": speed, "heading_rate": 0.7}, ts=[0.5, 1.0], **options).q


def _total(speed, **options):
    return jnp.sum(_places(speed, **options) ** 2)


def _exported(function, *arguments, **options):
    found = jax.export.export(jax.jit(function), **options)(*(jax.ShapeDtypeStruct(jnp.shape(x), jnp.float64) for x in arguments))
    assert MACHINE_CODE not in found.mlir_module()
    return found


def test_a_batch_is_exported_with_the_numbers_of_xla():
    (count,) = jax.export.symbolic_shape("count")
    known = len(ffi._REGISTERED)
    exported = jax.export.export(jax.jit(jax.vmap(_places)))(jax.ShapeDtypeStruct((count,), jnp.float64))
    assert MACHINE_CODE not in exported.mlir_module()
    assert len(ffi._REGISTERED) == known  # none is made in vain
    found = exported.call(SPEEDS)
    np.testing.assert_allclose(found, jax.vmap(lambda v: _places(v, backend="xla"))(SPEEDS), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found, jax.vmap(_places)(SPEEDS), rtol=0, atol=1e-11)


def test_gradients_are_exported_and_taken_of_what_was_exported():
    gradient = jax.jit(jax.vmap(jax.grad(_total)))
    expected = gradient(SPEEDS)
    np.testing.assert_allclose(_exported(gradient, SPEEDS).call(SPEEDS), expected, rtol=1e-9)
    np.testing.assert_allclose(_exported(_total, 1.0).vjp().call(SPEEDS[1], jnp.ones(()))[0], expected[1], rtol=1e-9)


def test_derivatives_in_forward_mode_are_exported():
    forward = jax.jit(jax.vmap(jax.jacfwd(lambda speed: _places(speed, adjoint=diffrax.ForwardMode()))))
    np.testing.assert_allclose(_exported(forward, SPEEDS).call(SPEEDS), forward(SPEEDS), rtol=1e-9, atol=1e-12)


def test_second_derivatives_are_exported():
    second = jax.jit(jax.jacfwd(jax.jacfwd(lambda speed: _places(speed, adjoint=diffrax.ForwardMode()))))
    np.testing.assert_allclose(_exported(second, 1.0).call(1.0), second(1.0), rtol=1e-9, atol=1e-12)


def test_an_exported_program_says_that_it_has_no_hessian_by_the_default_adjoint():
    with pytest.raises(DifferentiationModeError, match=r"exported programs.* pass `adjoint=diffrax\.ForwardMode"):
        _exported(jax.hessian(_total), 1.0)


def test_the_device_of_the_program_decides_not_that_of_the_process():
    traced = jax.jit(_places).trace(jax.ShapeDtypeStruct((), jnp.float64))
    assert MACHINE_CODE in traced.lower().as_text()
    for device in ("cuda", "tpu"):
        assert MACHINE_CODE not in traced.lower(lowering_platforms=(device,)).as_text()
    both = _exported(_places, 1.0, platforms=("cpu", "cuda"))
    np.testing.assert_allclose(both.call(1.0), _places(1.0), rtol=0, atol=1e-11)


def _double(x, y):
    return {"sum": 2.0 * x + y, "of y": 2.0 * y, "count": jnp.asarray(2)}


def _triple(x, y):
    return {"sum": 3.0 * x + y, "of y": 3.0 * y, "count": jnp.asarray(3)}


either = or_elsewhere(_double, _triple)


@pytest.mark.parametrize(
    "of_way",
    [
        lambda way: way(1.5, 2.0),
        lambda way: jax.vmap(way, (0, None))(jnp.arange(3.0), 2.0),
        lambda way: jax.vmap(lambda x, y: way(x, y)["sum"], (1, None), 1)(jnp.ones((2, 3)), jnp.ones(2)),
        lambda way: jax.vmap(way, (0, None))(jnp.zeros(0), 2.0),
        lambda way: jax.vmap(jax.vmap(way, (None, 0)), (0, None))(jnp.arange(3.0), jnp.arange(2.0)),
        lambda way: jax.jvp(lambda x: way(x, 2.0), (1.5,), (0.5,)),
        lambda way: jax.jacfwd(jax.jacfwd(lambda x: way(x, x)["sum"] ** 2))(1.5),
        lambda way: jax.vmap(lambda z: jax.jvp(lambda x: way(x, z), (z,), (0.5,)))(jnp.arange(3.0)),
    ],
)
def test_either_of_two_ways(of_way):
    def numbers(way, zero=0.0):
        return [x for x in jax.tree.leaves(of_way(lambda x, y: way(x + zero, y))) if jnp.result_type(x) != jax.dtypes.float0]

    here, elsewhere, of_zero = numbers(_double), numbers(_triple), lambda zero: numbers(either, zero)
    for found, expected in ((numbers(either), here), (jax.jit(of_zero)(0.0), here), (_exported(of_zero, 0.0).call(0.0), elsewhere)):
        assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, expected)
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_what_a_function_closes_over_may_be_traced():
    def of(x):
        return or_elsewhere(lambda y: 2.0 * x * y, lambda y: 3.0 * y)(x)

    assert jax.jit(of)(2.0) == 8.0
    assert jax.jit(jax.jvp, static_argnums=0)(of, (2.0,), (1.0,)) == (8.0, 8.0)
