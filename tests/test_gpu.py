"""Kernels of GPUs, checked without one: their twins on the CPU give the bits of machine code in wide registers, and their text is one for NVIDIA's driver."""

import re

import gpu_twin
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ends_of_models import end_of_model

import jourdain_jax as jj
from jourdain_jax.native import ffi, nvidia
from jourdain_jax.scene.parameters import parameters_of

pytestmark = pytest.mark.skipif(bool(ffi.reason_against() or nvidia.reason_against_text()), reason="no machine code is made here")
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_100")
KINDS = {"values": lambda f: f, "tangents": jax.jacfwd, "gradients": jax.grad, "second": jax.hessian}


def _numbers(name: str, kinds, **options) -> dict[str, np.ndarray]:
    """Numbers made of five motions of a model, and their derivatives with respect to a parameter and two directions of the start."""
    scene = jj.models.MODELS[name]()
    scalars = [p for p, value, _ in parameters_of(scene) if np.ndim(value) == 0][:1]
    end, x = end_of_model(name, None, scalars, ts=[0.1, 0.2], **options)
    lanes = x + 1e-3 * jnp.arange(5.0)[:, None]
    return {kind: np.asarray(jax.jit(jax.vmap(KINDS[kind](end)))(lanes)) for kind in kinds}


def _check(name: str, kinds, orders, **options) -> list[str]:
    expected, texts = _numbers(name, kinds, **options), []
    for order, slots in orders:
        with gpu_twin.by_twins(order, slots) as made:
            for kind, found in _numbers(name, kinds, **options).items():
                np.testing.assert_array_equal(found, expected[kind], err_msg=f"{name}, {kind}, threads {order}")
        texts += made
    return texts


def _check_text(texts, architectures) -> None:
    for text in texts:
        for architecture in architectures:
            ptx = nvidia.text_for(text, architecture)
            assert f".target {architecture}" in ptx
            assert not re.findall(r"^\.extern.*", ptx, re.M)


def test_threads_of_a_gpu_give_the_bits_of_wide_registers():
    texts = _check("tilting-disc", ["values", "gradients"], [("reversed", 5)])
    assert len(texts) > 2
    _check_text(texts[:1], ARCHITECTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(jj.models.MODELS))
def test_threads_of_a_gpu_give_the_bits_of_wide_registers_for_every_model(name):
    texts = _check(name, ["values", "tangents", "gradients"], [("in order", 64), ("reversed", 5), ("at once", 9)])
    _check_text(texts, ARCHITECTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tilting-disc", "chaplygin-sleigh", "double-pendulum-rods"])
def test_second_derivatives_and_series_too(name):
    _check(name, ["values", "second"], [("at once", 9)])
    _check(name, ["values", "tangents"], [("reversed", 9)], solver=jj.Taylor())


@pytest.mark.parametrize("name", ["chaplygin-sleigh", "double-pendulum-rods"])
def test_other_models_give_the_same_bits(name):
    _check(name, ["values"], [("at once", 9)])
