"""What holds of every model: its equations agree with each other, also for other parameters; derivatives through its simulation are right.

The whole set takes minutes; by default a part of it runs, all of it with `-m ''`.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from tolerances import tolerance

import jourdain_jax as jj
from jourdain_jax.build.trace import named_values
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.models import MODELS
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.parameters import parameters_of

DRAWS, STATES = 5, 20
QUICK = {"skate", "chaplygin-sleigh"}  # a full state with projection, a minimal state
SPAN = 0.4


def other_parameters(name: str, seed: int) -> jj.Scene:
    """The model with all parameters changed by up to a tenth; those that are zero, by up to 0.1, unless they must not be negative."""
    scene, generator = MODELS[name](), np.random.default_rng(seed)
    shift = lambda x: generator.uniform(-0.1, 0.1, x.shape) * np.where(np.asarray(x) == 0, 1.0, np.asarray(x))  # noqa: E731
    return scene.replace(**{key: value + shift(value) for key, value, metadata in parameters_of(scene) if not metadata["non_negative"] or np.all(value > 0)})


@eval_numpy  # each program runs once, so that compiling it would take longer than running it
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, 0))
@eqx.filter_vmap(in_axes=(None, 0, 0, 0))
def _solved(scene, t, q, u):
    equations = jj.unconstrained_equations(scene, t, q, u)
    found = {name: jj.accelerations(scene, t, q, u, reduction=name) for name in jj.reductions(scene)}
    return equations.Q - equations.h, {name: (x.udot, x.constraint_force, x.applicable) for name, x in found.items()}


@pytest.mark.parametrize("name", sorted(MODELS))
def test_all_reductions_agree_at_100_random_states_with_random_parameters(name):
    scenes = [other_parameters(name, seed) for seed in range(DRAWS)]
    states = [jj.sample_states(scene, STATES, seed) for seed, scene in enumerate(scenes)]
    assert min(len(t) for t, _, _ in states) == STATES  # every draw was assembled
    arrays, rest = zip(*(eqx.partition(scene, eqx.is_array) for scene in scenes), strict=True)
    stacked = eqx.combine(jax.tree.map(lambda *x: jnp.stack(x), *arrays), rest[0])
    impressed, found = _solved(stacked, *(jnp.stack([jnp.asarray(state[i]) for state in states]) for i in range(3)))
    udot, force, applies = found["qr"]
    assert np.all(applies)
    size = lambda *x: jnp.sum(jnp.stack([jnp.max(jnp.abs(y), axis=-1, keepdims=True) for y in x]), axis=0)  # noqa: E731
    sizes = (size(udot), size(force, impressed))
    if name == "heisenberg-particle":  # no acceleration, no force: nothing to be relative to
        sizes = (1.0, 1.0)
    # where the privileged speeds serve in the whole domain, every reduction must apply at every state
    needed = 1.0 if all(jj.structure_of(scene).well_conditioned for scene in scenes) else 0.9
    for way, (*values, applicable) in found.items():
        works = np.asarray(applicable)
        assert works.mean() >= needed, f"`{way}` applies at {works.sum()} of {works.size} states"
        for value, reference, relative_to in zip(values, (udot, force), sizes, strict=True):
            assert np.max(np.asarray(jnp.abs(value - reference) / relative_to)[works]) <= tolerance("round_off"), way

    _check_lowered(name, scenes, states, udot, sizes[0])


def _check_lowered(name, scenes, states, udot, size):
    """The scalar program, at the same states and parameters, on NumPy: nothing is compiled."""
    program = lowered(scenes[0])
    assert isinstance(program, Lowered), str(program)
    for scene, (t, q, u), dense, relative_to in zip(scenes, states, np.asarray(udot), np.broadcast_to(size, (DRAWS, STATES, 1)), strict=True):
        assert lowered(scene) is program  # parameters are inputs of the program
        probes = Probes(program.graph, named_values(scene, t, q, u, np.zeros((STATES, len(scene.inputs)))))
        ydot, qdot, z = probes(program.ydot).T, probes(program.qdot).T, probes(program.z).T
        rates = np.asarray(jax.vmap(lambda t, q, u, scene=scene: jj.coordinate_rates(scene, t, q, u))(t, q, u))
        assert np.max(np.abs(ydot - dense[:, list(program.independent)]) / relative_to, initial=0.0) <= tolerance("round_off"), "accelerations"
        assert np.max(np.abs(z - u[:, list(program.dependent)]), initial=0.0) <= tolerance("round_off") * np.max(np.abs(u)), "dependent speeds"
        assert np.max(np.abs(qdot - rates), initial=0.0) <= tolerance("round_off") * (1 + np.max(np.abs(rates))), "rates of coordinates"


WITHOUT_PROJECTION = {"pendulum-chain", "tilting-disc-quaternion", "trailer-chain", "two-wheel-axle-free", "two-wheel-axle-redundant", "whipple-bicycle"}
SLOW_BACKWARDS = {"whipple-bicycle"}  # a minute for the compiler


def short_motion(name: str, *, projection: bool):
    """`(x, reverse) -> q, u at the end of two steps`, where x holds parameters and speeds at the start; and x.

    Every step is accepted, whatever its error, and the first is shorter than half of the span: so the derivatives are those of the steps to round-off.
    """
    scene = MODELS[name]()
    start = jj.start(scene, **scene.example)
    flat, unravel = ravel_pytree(({key: value for key, value, _ in parameters_of(scene)}, start.u))

    def end(x, reverse: bool):
        parameters, u = unravel(x)
        options = {
            "rtol": 1e3,
            "atol": 1e3,
            "dt0": 0.008,
            "work": False,
            "events": False,
            "formulation": jj.Formulation(stabilisation="projection" if projection else None),
        }
        adjoint = None if reverse else diffrax.ForwardMode()
        begun = eqx.tree_at(lambda s: s.u, start, u)
        motion = jj.simulate(scene.replace(**parameters), begun, ts=start.t + jnp.array([0.02]), adjoint=adjoint, **options)
        return jnp.concatenate([motion.q_end, motion.u_end])

    return end, jnp.where(flat == 0, 0.01, flat)


def check_both_modes(name: str, *, projection: bool, backwards: bool) -> None:
    """Along one random direction: forward mode against central differences, and against reverse mode."""
    end, x = short_motion(name, projection=projection)
    generator = np.random.default_rng(0)
    direction = jnp.asarray(generator.normal(size=x.shape) * np.abs(x))
    forward = jax.jit(lambda x: jax.jvp(lambda x: end(x, False), (x,), (direction,)))
    value, along = forward(x)
    assert np.max(np.abs(along)) > 0
    size = np.max(np.abs(along)) + 1e-3 * np.max(np.abs(value))
    h = tolerance("difference_step")
    difference = (forward(x + h * direction)[0] - forward(x - h * direction)[0]) / (2 * h)
    assert np.max(np.abs(along - difference)) <= tolerance("gradient_fd") * size
    if backwards:
        weights = jnp.asarray(generator.normal(size=value.shape))
        gradient = jax.jit(jax.grad(lambda x: weights @ end(x, True)))(x)
        assert abs(float(gradient @ direction - weights @ along)) <= tolerance("ill_conditioned") * float(jnp.abs(gradient) @ jnp.abs(direction))


@pytest.mark.parametrize("name", sorted(MODELS))
def test_both_modes_agree_through_two_steps(name):
    check_both_modes(name, projection=name not in WITHOUT_PROJECTION, backwards=name not in SLOW_BACKWARDS)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(WITHOUT_PROJECTION))
def test_both_modes_agree_through_two_steps_with_projection(name):
    check_both_modes(name, projection=True, backwards=True)


some_models = pytest.mark.parametrize("name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in sorted(MODELS)])


@some_models
def test_verification_passes(name):
    scene = MODELS[name]()
    found = jj.verify(scene, jj.start(scene, **scene.example))
    assert found.passed, str(found)


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name == "skate" else pytest.mark.slow) for name in sorted(MODELS)])
def test_derivatives_through_simulation_by_every_parameter(name):
    scene = MODELS[name]()
    flat, unravel = ravel_pytree({key: value for key, value, _ in parameters_of(scene)})
    flat = jnp.where(flat == 0, 0.01, flat)  # differences need both sides, and some parameters may not be negative

    def end(flat, adjoint):
        own = scene.replace(**unravel(flat))
        start = jj.start(own, **scene.example)
        motion = jj.simulate(own, start, ts=jnp.array([SPAN]), rtol=1e-11, atol=1e-11, adjoint=adjoint, work=False, events=False)
        return jnp.concatenate([motion.q_end, motion.u_end])

    forward = np.asarray(jax.jit(jax.jacfwd(lambda x: end(x, diffrax.ForwardMode())))(flat))
    weights = jnp.asarray(np.random.default_rng(0).normal(size=forward.shape[0]))
    reverse = np.asarray(jax.jit(jax.grad(lambda x: weights @ end(x, diffrax.RecursiveCheckpointAdjoint())))(flat))
    # fourth-order central differences, all in one batch
    unit = np.where(np.asarray(flat) == 0, 1.0, np.abs(flat))
    steps = 1e-3 * unit
    points = jnp.stack([flat + k * np.diag(steps) for k in (-2, -1, 1, 2)])
    ends = np.asarray(jax.jit(jax.vmap(jax.vmap(lambda x: end(x, diffrax.ForwardMode()))))(points))
    differences = ((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * steps[:, None])).T
    size = np.max(np.abs(forward * unit)) + 1e-3 * np.max(np.abs(ends))
    assert np.max(np.abs((forward - differences) * unit)) <= tolerance("gradient_simulation") * size
    assert np.max(np.abs((np.asarray(weights) @ forward - reverse) * unit)) <= tolerance("gradient_simulation") * size
