"""The baselines of `bench/` give the accelerations of the engine, and their operations are counted right."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solved_states import over_states
from tolerances import relative_error, tolerance

import jourdain_jax as jj

hand_derived = pytest.importorskip("baselines.hand_derived", reason="the scripts of `bench/` are not here")
from baselines import count, dense, disc_run, flat, heyoka_disc  # noqa: E402

STATES = 20
ALTERNATIVES = {
    "skate, x_rate": lambda q, u: (u[:, 0], u[:, 2]),
    "skate, forward speed": lambda q, u: (_forward(q, u), u[:, 2]),
    "chaplygin-sleigh, blade speeds": lambda q, u: (_forward(q, u), u[:, 2]),
}


def _forward(q, u):
    return u[:, 0] * np.cos(q[:, 2]) + u[:, 1] * np.sin(q[:, 2])


def _with_random_parameters(name: str) -> jj.Scene:
    """A model whose parameters differ from the defaults by up to 20 %, angles that are zero excepted: they become 0.2."""
    scene, generator = jj.models.MODELS[name](), np.random.default_rng(7)
    return scene.replace(**{key: (value or 0.2) * generator.uniform(0.8, 1.2) for key, value in _parameters(scene).items()})


@functools.cache
def _solved(name: str):
    """A scene, states of it, and the engine's rates there."""
    scene = _with_random_parameters(name)
    t, q, u = jj.sample_states(scene, STATES)
    assert len(t) == STATES
    return scene, (t, q, u), *map(np.asarray, over_states(lambda *y: (jj.coordinate_rates(scene, *y), jj.accelerations(scene, *y).udot), t, q, u))


def _assert_equal(found, expected, among=None):
    """At each state, up to round-off of the largest rate there, or of the largest in `among`."""
    largest = np.max(np.abs(expected if among is None else among), axis=1)
    assert np.max(np.max(np.abs(found - expected), axis=1) / largest) < tolerance("round_off")


def _columns(states) -> tuple:
    return tuple(np.asarray(states).T)


def _parameters(scene: jj.Scene) -> dict:
    return {field.name: float(getattr(scene, field.name)) for field in dataclasses.fields(scene) if field.metadata}


@pytest.mark.parametrize("name", hand_derived.HAND_DERIVED)
def test_equations_derived_by_hand_give_the_rates_of_the_engine(name):
    known = hand_derived.HAND_DERIVED[name]
    scene, (t, q, u), qdot, udot = _solved(name)
    independent = list(jj.lower(scene).independent)
    assert known.coordinates == scene.coordinate_names.entries
    assert known.speeds == tuple(scene.speed_names.entries[i] for i in independent)
    found = known.rates(_parameters(scene), t, _columns(q), _columns(u[:, independent]))
    _assert_equal(np.stack(found[0], 1), qdot)
    _assert_equal(np.stack(found[1], 1), udot[:, independent], among=udot)


@pytest.mark.parametrize("name", ALTERNATIVES)
def test_equations_in_better_speeds_give_the_same_motion(name):
    known, speeds = hand_derived.ALTERNATIVES[name], ALTERNATIVES[name]
    scene, (t, q, u), qdot, udot = _solved(name.split(",")[0])
    # along the motion: d/dt of the forward speed, or of x_rate
    forward = _forward(q, udot) + u[:, 2] * (u[:, 1] * np.cos(q[:, 2]) - u[:, 0] * np.sin(q[:, 2]))
    expected = np.stack([udot[:, 0] if "x_rate" in known.speeds else forward, udot[:, 2]], 1)
    found = known.rates(_parameters(scene), t, _columns(q), speeds(q, u))
    _assert_equal(np.stack(found[0], 1), qdot)
    _assert_equal(np.stack(found[1], 1), expected, among=udot)


@pytest.mark.parametrize(("name", "rates"), [("tilting-disc", dense.disc_rates), ("whipple-bicycle", dense.bicycle_rates)])
def test_dense_equations_give_the_rates_of_the_engine(name, rates):
    scene, (t, q, u), qdot, udot = _solved(name)
    found = jax.jit(jax.vmap(rates, in_axes=(None, 0, 0)))(_parameters(scene), t, jnp.concatenate([q, u], axis=1))
    _assert_equal(found, np.concatenate([qdot, udot], axis=1))


def test_the_dense_scripts_have_the_parameters_of_the_models():
    for name, parameters in (("tilting-disc", dense.DISC_PARAMETERS), ("whipple-bicycle", dense.BICYCLE_PARAMETERS)):
        assert parameters == _parameters(jj.models.MODELS[name]())


def test_dense_and_flat_equations_run_the_disc_to_the_same_end():
    starts, end = disc_run.starts(3), 0.5
    run = jax.jit(lambda rates, y: dense.integrate(rates, dense.DISC_PARAMETERS, y, end, "Dopri8", 1e-11), static_argnums=0)
    by_hand = run(flat.disc_rates, starts)
    assert relative_error(run(dense.disc_rates, disc_run.with_all_speeds(starts))[:, disc_run.MINIMAL], by_hand) < tolerance("closed_form")


@pytest.mark.parametrize("width", [1, 4])
def test_heyoka_runs_the_disc_to_the_same_end(width):
    starts = disc_run.starts(4)
    if heyoka_disc.heyoka is None:
        with pytest.raises(ImportError, match="pip install heyoka"):
            heyoka_disc.final_states(1e-13, width)
        pytest.skip(heyoka_disc.MISSING)
    assert disc_run.error(heyoka_disc.final_states(1e-13, width)(starts), disc_run.reference(starts)) < tolerance("closed_form")


def test_operations_are_counted_after_common_subexpressions():
    def rates(p, t, q, v):
        gain = jnp.sin(p["a"]) * p["b"] + 1  # of parameters alone: free
        shared = gain * (q[0] * v[0])  # 2
        jnp.sqrt(q[0])  # needed by nothing
        return (shared + jnp.cos(t), -(gain * (v[0] * q[0]))), (q[0] ** 3 / p["b"], jnp.ones(()))  # 2; 1; 2 + 1

    counted = count.count_operations(jax.jit(rates), {"a": 1.0, "b": 2.0}, 1, 1)
    assert counted == {"mul": 4, "add": 1, "cos": 1, "neg": 1, "div": 1}


def test_arrays_are_not_counted():
    with pytest.raises(ValueError, match="gives an array"):
        count.count_operations(lambda p, t, q, v: (jnp.stack([q[0], q[1]]) @ jnp.ones(2),), {}, 2, 0)


@pytest.mark.parametrize(
    ("name", "operations"),
    [("two-wheel-axle-coordinates", 11), ("skate", 9), ("chaplygin-sleigh", 13), ("vertical-disc", 5), ("tilting-disc", 21), ("ball-on-turntable", 34)],
)
def test_hand_derived_equations_need_few_operations(name, operations):
    assert hand_derived.operations(name) == operations
