"""What holds of every model: its equations agree with each other, also for other parameters; derivatives
through its simulation are right.

The whole set takes minutes; by default a part of it runs, all of it with `-m ''`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from tolerances import ROUND_OFF, tolerance

import jourdain_jax as jj
from jourdain_jax import Lowered
from jourdain_jax.equations import coordinate_rates, unconstrained_equations
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.models import MODELS
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.structure.trace import named_values

DRAWS, STATES = 5, 20

natively = machine_code.needed


def other_parameters(name, seed):
    """The model with all parameters changed by up to a tenth; those that are zero, by up to 0.1, unless they
    must not be negative.
    """
    scene, generator = MODELS[name](), np.random.default_rng(seed)
    shift = lambda x: generator.uniform(-0.1, 0.1, x.shape) * np.where(np.asarray(x) == 0, 1.0, np.asarray(x))
    return scene.replace(
        **{
            key: value + shift(value)
            for key, value, metadata in parameters_of(scene)
            if not metadata["non_negative"] or np.all(value > 0)
        }
    )


@eval_numpy  # each program runs once, so that compiling it would take longer than running it
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, 0))
@eqx.filter_vmap(in_axes=(None, 0, 0, 0))
def _solved(scene, t, q, u):
    equations = unconstrained_equations(scene, t, q, u)
    found = {name: jj.accelerations(scene, t, q, u, reduction=name) for name in jj.reductions(scene)}
    return equations.Q - equations.h, {
        name: (x.udot, x.constraint_force, x.applicable) for name, x in found.items()
    }


@pytest.mark.parametrize("name", sorted(MODELS))
def test_all_reductions_agree_at_100_random_states_with_random_parameters(name):
    scenes = [other_parameters(name, seed) for seed in range(DRAWS)]
    states = [jj.sample_states(scene, STATES, seed) for seed, scene in enumerate(scenes)]
    assert min(len(t) for t, _, _ in states) == STATES  # every draw was assembled
    arrays, rest = zip(*(eqx.partition(scene, eqx.is_array) for scene in scenes), strict=True)
    stacked = eqx.combine(jax.tree.map(lambda *x: jnp.stack(x), *arrays), rest[0])
    impressed, found = _solved(
        stacked, *(jnp.stack([jnp.asarray(state[i]) for state in states]) for i in range(3))
    )
    udot, force, applies = found["qr"]
    assert np.all(applies)
    size = lambda *x: jnp.sum(jnp.stack([jnp.max(jnp.abs(y), axis=-1, keepdims=True) for y in x]), axis=0)
    sizes = (size(udot), size(force, impressed))
    if name == "heisenberg-particle":  # no acceleration, no force: nothing to be relative to
        sizes = (1.0, 1.0)
    # where the privileged speeds serve in the whole domain, every reduction must apply at every state
    needed = 1.0 if all(jj.structure_of(scene).well_conditioned for scene in scenes) else 0.9
    for way, (*values, applicable) in found.items():
        works = np.asarray(applicable)
        assert works.mean() >= needed, f"`{way}` applies at {works.sum()} of {works.size} states"
        for value, reference, relative_to in zip(values, (udot, force), sizes, strict=True):
            assert np.max(np.asarray(jnp.abs(value - reference) / relative_to)[works]) <= tolerance(
                "round_off"
            ), way

    _check_lowered(name, scenes, states, udot, sizes[0])


def _check_lowered(name, scenes, states, udot, size):
    """The scalar program, at the same states and parameters, on NumPy: nothing is compiled."""
    program = lowered(scenes[0])
    assert isinstance(program, Lowered), str(program)
    for scene, (t, q, u), dense, relative_to in zip(
        scenes, states, np.asarray(udot), np.broadcast_to(size, (DRAWS, STATES, 1)), strict=True
    ):
        assert lowered(scene) is program  # parameters are inputs of the program
        probes = Probes(program.graph, named_values(scene, t, q, u, np.zeros((STATES, len(scene.inputs)))))
        ydot, qdot, z = probes(program.ydot).T, probes(program.qdot).T, probes(program.z).T
        rates = np.asarray(jax.vmap(lambda t, q, u, scene=scene: coordinate_rates(scene, t, q, u))(t, q, u))
        assert (
            np.max(np.abs(ydot - dense[:, list(program.independent)]) / relative_to, initial=0.0) <= ROUND_OFF
        ), "accelerations"
        assert np.max(np.abs(z - u[:, list(program.dependent)]), initial=0.0) <= tolerance(
            "round_off"
        ) * np.max(np.abs(u)), "dependent speeds"
        assert np.max(np.abs(qdot - rates), initial=0.0) <= ROUND_OFF * (1 + np.max(np.abs(rates))), (
            "rates of coordinates"
        )


def end_of_two_steps(name):
    """`x -> q, u at the end of two steps`, where x holds all parameters and the state at the start; and x.

    Every step is accepted, whatever its error, and the first is shorter than half of the span: so the
    derivatives are those of the steps to round-off.
    """
    scene = MODELS[name]()
    t, q, u = (jnp.asarray(x[0]) for x in jj.sample_states(scene, 1))
    start = jj.State(t, q, u, *jnp.zeros(3), (scene.coordinate_names, scene.speed_names))
    flat, unravel = ravel_pytree(({key: value for key, value, _ in parameters_of(scene)}, q, u))
    options = {
        "ts": t + jnp.array([0.02]),
        "rtol": 1e3,
        "atol": 1e3,
        "max_step": 0.008,
        "work": False,
        "events": False,
    }

    def end(x):
        parameters, q, u = unravel(x)
        own, begun = scene.replace(**parameters), eqx.tree_at(lambda s: (s.q, s.u), start, (q, u))
        motion = jj.simulate(own, begun, **options)
        return jnp.concatenate([motion.q_end, motion.u_end])

    return end, np.where(flat == 0, 0.01, flat)


@natively
@pytest.mark.parametrize("name", sorted(MODELS))
def test_derivatives_through_a_start_and_two_steps_are_those_of_differences_in_both_modes(name):
    """Forward mode, J d, against central differences of steps h and 2h, the leading error removed, and
    against reverse mode: w'(J d) = (J'w)'d; by the machine code that a user gets. The operations around it
    run on NumPy, in a third of the time that XLA takes to compile them.
    """
    end, x = end_of_two_steps(name)
    generator = np.random.default_rng(0)
    direction = generator.normal(size=x.shape) * np.abs(x)
    forward = eval_numpy(lambda x: jax.jvp(end, (x,), (jnp.asarray(direction),)))
    value, along = forward(x)
    weights = generator.normal(size=value.shape)
    (gradient,) = eval_numpy(lambda x: jax.vjp(end, x)[1](jnp.asarray(weights)))(x)
    h = 3e-4
    by_step = [
        (forward(x + k * h * direction)[0] - forward(x - k * h * direction)[0]) / (2 * k * h)
        for k in (1, 2, 4)
    ]
    better, worse = ((4 * by_step[i] - by_step[i + 1]) / 3 for i in (0, 1))
    # how far these are right: what the next larger step changes, and round-off
    left = np.abs(better - worse) + 10 * np.finfo(float).eps / h * np.max(np.abs(value))
    assert np.max(left) <= 1e-8 * np.max(np.abs(along))
    assert np.all(np.abs(along - better) <= left)
    apart = abs(gradient @ direction - weights @ along)
    assert apart <= ROUND_OFF * np.abs(gradient) @ np.abs(direction)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_verification_passes(name):
    scene = MODELS[name]()
    found = jj.verify(scene, jj.start(scene, **scene.example))
    assert found.passed, str(found)
