"""Numbers that depend on parameters alone, and what is seen at saved states, by machine code against the same by XLA."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax import Lowered
from jourdain_jax.build.plausibility import faults_at
from jourdain_jax.build.row_program import row_program
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.models import MODELS
from jourdain_jax.motion.native import seen
from jourdain_jax.native import ffi
from jourdain_jax.scene.parameters import parameter_faults

pytestmark = pytest.mark.skipif(bool(ffi.reason_against()), reason=ffi.reason_against())

ROUND_OFF = 1e-13  # relative


def _by_both(scene: jj.Scene, program: Lowered):
    """Functions of the scene and of a state that give all this, by machine code and by XLA."""

    def ours(scene, q, y, t=0.2):
        inputs = jnp.full(len(scene.inputs), 0.3)
        fixed = seen.fixed_values(program, scene)
        return fixed, seen.speeds_and_pivot(program, fixed, t, q, y, inputs), seen.energies(program, fixed, t, q, y, inputs)

    def theirs(scene, q, y, t=0.2):
        inputs = jnp.full(len(scene.inputs), 0.3)
        fixed = program.fixed_values(scene)
        state = fixed, t, tuple(q), tuple(y), inputs
        return fixed, program.speeds_and_pivot(*state), program.energy_values(*state)

    return ours, theirs


def _same(found, expected, tolerance=ROUND_OFF):
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=tolerance * (1.0 + np.max(np.abs(y), initial=0.0)))


def _states(scene: jj.Scene, program: Lowered, count: int):
    _, q, u = jj.sample_states(scene, count)
    return jnp.asarray(q), jnp.asarray(u)[:, np.array(program.independent, int)]


@pytest.mark.parametrize("name", MODELS)
def test_all_programs_are_seen_alike(name):
    scene = MODELS[name]()
    program = lowered(scene)
    if not isinstance(program, Lowered):
        pytest.skip("it has no scalar program")
    assert seen.is_supported(program)
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
        np.testing.assert_allclose(x, y, rtol=ROUND_OFF)


@pytest.mark.parametrize("name", ["tilting-disc", "snakeboard", "trailer-chain"])  # the last has derivatives of speeds as machine code
def test_derivatives_are_those_by_xla(name):
    scene = MODELS[name]()
    program = lowered(scene)
    (q,), (y,) = _states(scene, program, 1)
    along = jax.tree.map(jnp.ones_like, scene), jnp.ones_like(q), jnp.ones_like(y)
    assert seen._has_many_operations(program) == (name == "trailer-chain")
    ours, theirs = (jax.jit(lambda *x, f=f: jax.jvp(f, x, along))(scene, q, y) for f in _by_both(scene, program))
    _same(ours, theirs, 1e-12)

    def total(f, scene, q, y):
        fixed, (u, _), energies = f(scene, q, y)
        return jnp.sum(jnp.stack(fixed)) + jnp.sum(u**2) + jnp.sum(energies)

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


def test_a_derivative_with_respect_to_all_parameters_has_calls_in_it_in_place_of_operations():
    scene = MODELS["whipple-bicycle"]()
    program = lowered(scene)
    traced = jax.make_jaxpr(lambda along: jax.jvp(lambda s: jnp.stack(seen.fixed_values(program, s)), (scene,), (along,))[1])(scene)
    assert str(traced).count(" mul ") + str(traced).count("dot_general") == 0  # 600 operations where XLA does it


@pytest.mark.parametrize("name", MODELS)
def test_wrong_parameters_and_bodies_are_found_alike(name):
    scene = MODELS[name]()
    program = row_program(scene)
    leaves, treedef = jax.tree.flatten(scene)
    generator = np.random.default_rng(0)
    signs = generator.choice([1.0, 1.0, 1.0, -1.0, 0.0, np.nan, np.inf], (64, len(leaves)))
    signs[:4] = np.array([1.0, -1.0, 0.0, np.nan])[:, None]
    signs[4:40] = np.where(np.arange(len(leaves)) == generator.integers(len(leaves), size=36)[:, None], signs[4:40], 1.0)  # one that is wrong
    lanes = jax.tree.unflatten(treedef, [jnp.asarray(s.reshape(-1, *([1] * np.ndim(x)))) * x for s, x in zip(signs.T, leaves, strict=True)])
    q = jnp.asarray(jj.sample_states(scene, 1)[1])[0]

    def theirs(scene):
        return ~jnp.any(
            jnp.stack([jnp.array(False), *parameter_faults(scene).values(), *faults_at(scene, 0.0, q, jnp.zeros(len(scene.speed_names)), None).values()])
        )

    found = jax.vmap(lambda scene: seen.is_right(program, scene, 0.0, q))(lanes)
    np.testing.assert_array_equal(found, jax.vmap(theirs)(lanes))
    assert bool(found[0])
    assert not bool(found[3])


def test_states_of_many_motions_are_seen_by_xla():
    """One motion calls machine code for all its saved states at once; in a batch of motions XLA, which puts no rows together for it, takes half of the time."""
    scene = MODELS["tilting-disc"]()
    program = lowered(scene)
    assert isinstance(program, Lowered)
    q, y = (x.reshape(2, 3, -1) for x in _states(scene, program, 6))
    fixed, inputs = program.fixed_values(scene), jnp.zeros(0)

    def ours(q, y):
        return seen.speeds_and_pivot(program, fixed, 0.2, q, y, inputs), seen.energies(program, fixed, 0.2, q, y, inputs)

    def theirs(q, y):
        state = fixed, 0.2, tuple(q), tuple(y), inputs
        return program.speeds_and_pivot(*state), program.energy_values(*state)

    one, many = (lambda f: jax.vmap(f)), (lambda f: jax.vmap(jax.vmap(f)))
    assert "jourdain_machine_code" in str(jax.make_jaxpr(one(ours))(q[0], y[0]))
    assert "jourdain_machine_code" not in str(jax.make_jaxpr(many(ours))(q, y))
    _same(many(ours)(q, y), many(theirs)(q, y))
    total = lambda f: lambda q, y: jnp.sum(many(f)(q, y)[0][0] ** 2)  # noqa: E731
    _same(jax.grad(total(ours), (0, 1))(q, y), jax.grad(total(theirs), (0, 1))(q, y))
    slopes = lambda f: jax.vmap(jax.jacfwd(lambda q, y: one(f)(q, y)[0], (0, 1)))  # noqa: E731
    _same(slopes(ours)(q, y), slopes(theirs)(q, y))
    _same(jax.vmap(one(ours), (0, None))(q, y[0]), jax.vmap(one(theirs), (0, None))(q, y[0]))
