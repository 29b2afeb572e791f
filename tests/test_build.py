"""The two phases: what is built once about a scene is one value, and what comes after does not depend on how often, or after what, it is called."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.models import MODELS, ChaplyginSleigh, DoublePendulumRods, TiltingDisc

OFTEN = 12  # more than any number of calls that once changed the way


@pytest.fixture(scope="module")
def disc():
    return jj.build(TiltingDisc())


def test_what_is_built_is_there_part_by_part(disc):
    assert disc.rows.names == jj.report(disc).rows
    assert disc.rows.rank == len(disc.rows.names) == 2
    assert disc.freedoms.count == len(disc.scene.speed_names) - disc.rows.rank
    assert set(disc.freedoms.privileged) | set(disc.freedoms.dependent) == set(disc.scene.speed_names.entries)
    assert disc.dependence.on_time == ()
    assert disc.conserved.energy
    assert set(disc.conserved.ignorable) >= {"x", "y", "yaw", "spin"}
    assert disc.program.operations == jj.lower(TiltingDisc()).operations
    assert (disc.state, disc.not_lowered) == ("minimal", "")
    assert not disc.warnings
    assert all(word in str(disc) for word in ("Model of TiltingDisc", "machine code", "privileged speeds", "27 operations", "conserved"))


def test_warnings_say_where_rank_is_lost():
    built = jj.build(DoublePendulumRods())
    report = jj.report(DoublePendulumRods())
    assert built.rows.rank_losses == report.rank_losses
    assert bool(built.warnings) == bool(report.rank_losses)


def test_what_was_built_is_pickled_as_its_scene(disc):
    again = pickle.loads(pickle.dumps(disc))
    assert str(again) == str(disc)
    assert again.rows == disc.rows
    assert again.freedoms == disc.freedoms


def test_what_was_built_stands_wherever_its_scene_does():
    sleigh = ChaplyginSleigh()
    built = jj.build(sleigh)
    start, ts = {"x_rate": 0.5, "heading_rate": 0.3}, jnp.array([0.5, 1.0])
    assert_array_equal(jj.simulate(built, start, ts=ts).q, jj.simulate(sleigh, start, ts=ts).q)
    many = {"x_rate": jnp.array([0.5, 0.6])}
    assert_array_equal(jj.rollout(built, many, ts=ts).lanes.q, jj.rollout(sleigh, many, ts=ts).lanes.q)
    state = jj.start(built, **start)
    assert_array_equal(state.u, jj.start(sleigh, **start).u)
    assert_array_equal(jj.linearize(built, state).A, jj.linearize(sleigh, state).A)
    assert str(jj.report(built)) == str(jj.report(sleigh))
    assert jj.lower(built) is jj.lower(sleigh)
    data = jj.Experiment(ts, {"heading": jnp.array([0.1, 0.2])}, 0.01, start=start)
    fits = [jj.fit(scene, data, free=["offset"]) for scene in (built, sleigh)]
    assert fits[0].estimates == fits[1].estimates


def test_a_model_says_each_choice_with_its_reason():
    sleigh, rods = ChaplyginSleigh(), DoublePendulumRods()
    assert jj.build(sleigh).way == "machine code"
    assert jj.build(sleigh, backend="xla").way == "XLA: as asked"
    dense = jj.build(rods, jj.Formulation("full", reduction="kkt"))
    assert (dense.state, dense.way) == ("full", "dense matrices: as asked")
    assert "full: as asked" in str(jj.build(sleigh, jj.Formulation("full")))
    with pytest.raises(ValueError, match="a reduction"):
        jj.build(sleigh, jj.Formulation(reduction="kkt"), backend="xla")
    with pytest.raises(TypeError, match=r"a model has its own; give it to `jj\.build`"):
        jj.simulate(dense, t1=0.1, backend="dense")
    with pytest.raises(AttributeError, match="`Model`"):
        jj.Built  # noqa: B018


def test_a_model_with_other_parameters_keeps_its_choices_and_is_differentiated_under_jit_and_vmap():
    start, ts = {"x_rate": 0.5, "heading_rate": 0.3}, jnp.array([0.5, 1.0])
    model = jj.build(ChaplyginSleigh(), jj.Formulation("full"), backend="xla")

    def end(model, offset):
        motion = jj.simulate(model.replace(offset=offset), start, ts=ts)
        assert (motion.state_form, "machine code" in motion.reduction) == ("full", False)
        return motion.q_end[0]

    offsets = jnp.array([0.2, 0.3])
    slopes = jax.jit(jax.vmap(jax.grad(end, argnums=1), (None, 0)))(model, offsets)
    expected = [jax.grad(lambda offset: jj.simulate(ChaplyginSleigh(offset=offset), start, ts=ts).q_end[0])(x) for x in offsets]
    assert_allclose(slopes, expected, rtol=1e-6)
    assert len(jax.tree.leaves(model)) == len(jax.tree.leaves(model.scene))
    assert_allclose(jj.start(model, **start).u, jj.start(model.scene, **start).u, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", MODELS)
def test_a_start_and_a_diagnosis_are_bit_equal_however_often_they_are_asked_for(name):
    scene = MODELS[name]()
    starts = [jj.start(scene, **scene.example) for _ in range(OFTEN)]
    for start in starts[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(start), jax.tree.leaves(starts[0]), strict=True))
    found = jj.accelerations(scene, starts[0].t, starts[0].q, starts[0].u).udot
    jj.sample_states(scene, 2)  # anything in between
    assert np.array_equal(found, jj.accelerations(scene, starts[-1].t, starts[-1].q, starts[-1].u).udot)


@pytest.mark.parametrize("name", MODELS)
def test_a_motion_and_its_diagnosis_are_bit_equal_however_often_they_are_asked_for(name):
    scene = MODELS[name]()
    ts = jnp.linspace(0.0, 0.5, 4)
    motions = [jj.simulate(scene, scene.example, ts=ts) for _ in range(OFTEN)]
    inside = jax.jit(lambda start: jj.simulate(scene, start, ts=ts))
    start = jj.start(scene, **scene.example)
    compiled = [inside(start) for _ in range(3)]
    for first, *others in (motions, compiled):
        for other in others:
            assert np.array_equal(first.q, other.q)
            assert np.array_equal(first.u, other.u)
    assert len({str(motion) for motion in motions for _ in range(10)}) == 1


def test_a_function_that_takes_scenes_only_says_what_to_pass(disc):
    with pytest.raises(AttributeError, match=r"`Model` has no `bodies`; where a scene is asked for, pass its `\.scene`"):
        disc.bodies  # as a function of scenes would ask  # noqa: B018


def crane() -> type[jj.Scene]:
    """A new class of a scene whose parameters decide which speed is best kept independent."""

    class Crane(jj.Scene):
        arm: float = jj.parameter(1.0)
        rope: float = jj.parameter(1.0)
        coordinates = jj.coordinates("x y z")
        domain = dict.fromkeys("xyz", (-1.0, 1.0))

        def bodies(self, t, q):
            return {"load": jj.Particle(1.0, jnp.stack([q.x, q.y, q.z]))}

        def velocity_constraints(self, motion):
            q, u = motion.q, motion.u
            return {"rope": (self.arm + 0.3 * jnp.sin(q.x)) * u.y_rate - (self.rope + 0.2 * jnp.cos(q.z)) * u.z_rate - 0.1 * q.y * u.x_rate}

    return Crane


def test_a_model_whose_numbers_decide_otherwise_than_the_defaults_of_its_class_says_so():
    kind = crane()
    built = [jj.build(kind(*numbers)) for numbers in ((1.0, 1.0), (1.0, 10.0), (10.0, 1.0))]
    chosen, told = [model.freedoms.privileged for model in built], ["which stand in for parameters that JAX traces" in str(model) for model in built]
    assert told == [privileged != chosen[0] for privileged in chosen]
    assert any(told)


def batch(scene, ts, start) -> list:
    return np.asarray(jj.rollout(scene, {**start, "x": jnp.array([0.1, 0.2])}, ts=ts, progress=False)["y"]).tolist()


def fitted(scene, ts, start) -> list:
    data = jj.Experiment(ts, {"x": 0.1 + ts, "z": 0.02 * ts}, 0.01, start=start)
    return np.asarray(jj.fit(scene, data, free={"arm": None}, max_iterations=2).values).tolist()


@pytest.mark.parametrize("run", [batch, fitted])
def test_what_a_batch_or_a_fit_runs_is_not_decided_by_the_call_before_it(run):
    ts = jnp.linspace(0.0, 1.0, 6)
    start = {"x": 0.1, "x_rate": 1.0, "y_rate": 0.5}
    found = []
    for order in ([(1.0, 10.0), (10.0, 1.0)], [(10.0, 1.0), (1.0, 10.0)]):
        kind, of = crane(), {}
        for arm, rope in order:
            scene = kind(arm, rope)
            of[arm, rope] = jj.build(scene).freedoms.privileged, run(scene, ts, start)
        found.append(of)
    assert found[0] == found[1]
    assert len({privileged for privileged, *_ in found[0].values()}) == 2
