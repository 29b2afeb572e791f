"""Numbers that depend on parameters alone, and derivatives of speeds at saved states, by machine code against the same by XLA."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax import Lowered
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.models import MODELS
from jourdain_jax.motion.native import seen
from jourdain_jax.native import ffi

pytestmark = pytest.mark.skipif(bool(ffi.reason_against()), reason=ffi.reason_against())

ROUND_OFF = 1e-13  # relative


def _by_both(scene: jj.Scene, program: Lowered):
    """Functions of the scene and of a state that give all this, by machine code and by XLA."""

    def ours(scene, q, y, t=0.2):
        inputs = jnp.full(len(scene.inputs), 0.3)
        fixed = seen.fixed_values(program, scene)
        return fixed, seen.speeds_and_pivot(program, fixed, t, q, y, inputs)

    def theirs(scene, q, y, t=0.2):
        inputs = jnp.full(len(scene.inputs), 0.3)
        fixed = program.fixed_values(scene)
        return fixed, program.speeds_and_pivot(fixed, t, tuple(q), tuple(y), inputs)

    return ours, theirs


def _same(found, expected, tolerance=ROUND_OFF):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert_allclose(x, y, rtol=0, atol=tolerance * (1.0 + np.max(np.abs(y), initial=0.0)))


def _states(scene: jj.Scene, program: Lowered, count: int):
    _, q, u = jj.sample_states(scene, count)
    return jnp.asarray(q), jnp.asarray(u)[:, np.array(program.independent, int)]


@pytest.mark.parametrize("name", MODELS)
def test_all_programs_are_seen_alike(name):
    scene = MODELS[name]()
    program = lowered(scene)
    if not isinstance(program, Lowered):
        pytest.skip("it has no scalar program")
    assert seen.beside(program)
    q, y = _states(scene, program, 9)
    ours, theirs = (jax.jit(jax.vmap(f, in_axes=(None, 0, 0)))(scene, q, y) for f in _by_both(scene, program))
    _same(ours, theirs, 1e-12)


def test_what_is_usual_is_the_same_for_parameters_that_differ_from_lane_to_lane():
    scene = MODELS["snakeboard"]()
    program = lowered(scene)
    assert program.usual
    assert program.states
    leaves, treedef = jax.tree.flatten(scene)
    scales = jnp.array([0.5, 1.0, 1.7, jnp.nan])
    lanes = jax.tree.unflatten(treedef, [scales * x for x in leaves])
    ours, theirs = (jax.vmap(f)(lanes) for f in (lambda s: seen.fixed_values(program, s), program.fixed_values))
    for x, y in zip(ours, theirs, strict=True):
        assert_allclose(x, y, rtol=ROUND_OFF)


@pytest.mark.parametrize("name", ["tilting-disc", "snakeboard", "trailer-chain"])  # the last has derivatives of speeds as machine code
def test_derivatives_are_those_by_xla(name):
    scene = MODELS[name]()
    program = lowered(scene)
    (q,), (y,) = _states(scene, program, 1)
    along = jax.tree.map(jnp.ones_like, scene), jnp.ones_like(q), jnp.ones_like(y)
    assert (program.graph.operations(program.z) >= 60) == (name == "trailer-chain")
    ours, theirs = (jax.jit(lambda *x, f=f: jax.jvp(f, x, along))(scene, q, y) for f in _by_both(scene, program))
    _same(ours, theirs, 1e-12)

    def total(f, scene, q, y):
        fixed, (u, _) = f(scene, q, y)
        return jnp.sum(jnp.stack(fixed)) + jnp.sum(u**2)

    ours, theirs = (jax.jit(jax.grad(lambda *x, f=f: total(f, *x), argnums=(0, 1, 2)))(scene, q, y) for f in _by_both(scene, program))
    _same(ours, theirs, 1e-12)


def test_second_derivatives_of_what_is_fixed_are_those_by_xla():
    scene = MODELS["snakeboard"]()
    program = lowered(scene)
    assert program.usual  # numbers to differentiation
    numbers, restored = jax.flatten_util.ravel_pytree(scene)
    weights = jnp.linspace(0.3, 1.0, len(program.fixed))

    def second(fixed_values):
        return jax.jit(jax.hessian(lambda x: jnp.sum(weights * jnp.stack(fixed_values(restored(x))) ** 2)))(numbers)

    ours, theirs = second(lambda s: seen.fixed_values(program, s)), second(program.fixed_values)
    assert np.any(np.abs(theirs) > 1e-3)
    _same(ours, theirs, 1e-12)
