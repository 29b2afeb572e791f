"""Programs that run elsewhere, exported ones and those for other devices, hold no machine code of this
process: they are made with `backend="xla"`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import Oscillator

import jourdain_jax as jj

SPEEDS = np.array([0.5, 1.0, 2.0])
MACHINE_CODE = "jourdain_jax_"  # names of handlers begin so


def _places(speed, backend="xla", **options):
    return jj.simulate(Oscillator(), {"x": 0.3, "x_rate": speed}, ts=[0.5, 1.0], backend=backend, **options).q


def _total(speed, **options):
    return jnp.sum(_places(speed, **options) ** 2)


def _exported(function, *arguments, **options):
    found = jax.export.export(jax.jit(function), **options)(
        *(jax.ShapeDtypeStruct(jnp.shape(x), jnp.float64) for x in arguments)
    )
    assert MACHINE_CODE not in found.mlir_module()
    return found


def test_a_batch_is_exported_with_the_numbers_of_xla():
    (count,) = jax.export.symbolic_shape("count")
    exported = jax.export.export(jax.jit(jax.vmap(_places)))(jax.ShapeDtypeStruct((count,), jnp.float64))
    assert MACHINE_CODE not in exported.mlir_module()
    found = exported.call(SPEEDS)
    assert_allclose(found, jax.vmap(_places)(SPEEDS), rtol=0, atol=1e-14)
    assert_allclose(found, jax.vmap(lambda v: _places(v, "auto"))(SPEEDS), rtol=0, atol=1e-11)


def test_gradients_are_exported_and_taken_of_what_was_exported():
    expected = jax.jit(jax.grad(lambda speed: _total(speed, backend="auto")))(1.3)
    assert_allclose(_exported(jax.grad(_total), 1.0).call(1.3), expected, rtol=1e-9)
    assert_allclose(_exported(_total, 1.0).vjp().call(jnp.asarray(1.3), jnp.ones(()))[0], expected, rtol=1e-9)


def test_second_derivatives_are_exported():
    second = jax.jit(jax.jacfwd(jax.jacfwd(_places)))
    assert_allclose(_exported(second, 1.0).call(1.0), second(1.0), rtol=1e-9, atol=1e-12)


def test_an_exported_program_says_that_it_has_no_hessian():
    with pytest.raises(jj.DifferentiationModeError, match=r"use `jax.jacfwd\(jax.jacfwd"):
        _exported(jax.hessian(_total), 1.0)


def test_machine_code_in_a_program_that_runs_elsewhere_is_an_error_that_names_the_backend():
    by_machine_code = jax.jit(lambda speed: _places(speed, "auto"))
    traced = by_machine_code.trace(jax.ShapeDtypeStruct((), jnp.float64))
    assert MACHINE_CODE in traced.lower().as_text()
    for device in ("cuda", "tpu"):
        with pytest.raises(RuntimeError, match=f'platform.*{device}.*backend="xla"'):
            traced.lower(lowering_platforms=(device,))
    with pytest.raises(RuntimeError, match=r'to be exported.*backend="xla"'):
        jax.export.export(by_machine_code)(jax.ShapeDtypeStruct((), jnp.float64))
    both = _exported(_places, 1.0, platforms=("cpu", "cuda"))
    assert_allclose(both.call(1.0), _places(1.0), rtol=0, atol=1e-11)
