"""The two phases: what is built once about a scene is one value, and what comes after does not depend on how
often, or after what, it is called.
"""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import InSpace

import jourdain_jax as jj
from jourdain_jax.models import ChaplyginSleigh, DoublePendulumRods, TiltingDisc


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
    assert all(
        word in str(disc)
        for word in (
            "Model of TiltingDisc",
            "machine code",
            "privileged speeds",
            "27 operations",
            "conserved",
        )
    )


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


def test_a_model_says_each_choice_with_its_reason():
    sleigh, rods = ChaplyginSleigh(), DoublePendulumRods()
    assert jj.build(sleigh).way == "machine code"
    assert jj.build(sleigh, backend="xla").way == "XLA: as requested"
    dense = jj.build(rods, jj.Formulation("full", reduction="kkt"))
    assert (dense.state, dense.way) == ("full", "dense matrices: as requested")
    assert "full: as requested" in str(jj.build(sleigh, jj.Formulation("full")))
    refused("own reduction", jj.build, sleigh, jj.Formulation(reduction="kkt"), backend="xla")
    with pytest.raises(TypeError, match=r"a model has its own; pass it to `jj\.build`"):
        jj.simulate(dense, t1=0.1, backend="dense")
    with pytest.raises(AttributeError, match="`Model`"):
        jj.Built  # noqa: B018


def test_a_model_with_other_parameters_keeps_its_choices_and_is_differentiated_under_jit_and_vmap():
    start, ts = {"x_rate": 0.5, "heading_rate": 0.3}, jnp.array([0.5, 1.0])
    model = jj.build(ChaplyginSleigh(), jj.Formulation("full"))
    by_xla = jj.build(ChaplyginSleigh(), backend="xla").replace(offset=0.2)
    assert "machine code" not in jax.eval_shape(lambda: jj.simulate(by_xla, start, ts=ts)).reduction

    def end(model, offset):
        motion = jj.simulate(model.replace(offset=offset), start, ts=ts)
        assert motion.state_form == "full"
        return motion.q_end[0]

    offsets = np.array([0.2, 0.3])
    slopes = jax.jit(jax.vmap(jax.grad(end, argnums=1), (None, 0)))(model, offsets)
    slope = jax.jit(
        jax.grad(lambda offset: jj.simulate(ChaplyginSleigh(offset=offset), start, ts=ts).q_end[0])
    )
    assert_allclose(slopes, [slope(x) for x in offsets], rtol=1e-6)
    assert len(jax.tree.leaves(model)) == len(jax.tree.leaves(model.scene))
    assert_allclose(jj.start(model, **start).u, jj.start(model.scene, **start).u, rtol=0, atol=1e-14)


def test_a_function_that_takes_scenes_only_says_what_to_pass(disc):
    with pytest.raises(
        AttributeError, match="`Model` has no attribute `bodies`; its scene is the attribute `scene`"
    ):
        disc.bodies  # as a function of scenes would ask  # noqa: B018


def crane():
    """A new class of a scene whose parameters decide which speed is best kept independent."""

    class Crane(InSpace):
        arm: float = jj.parameter(1.0)
        rope: float = jj.parameter(1.0)
        domain = dict.fromkeys("xyz", (-1.0, 1.0))

        def velocity_constraints(self, motion):
            q, u = motion.q, motion.u
            return {
                "rope": (
                    (self.arm + 0.3 * jnp.sin(q.x)) * u.y_rate
                    - (self.rope + 0.2 * jnp.cos(q.z)) * u.z_rate
                    - 0.1 * q.y * u.x_rate
                )
            }

    return Crane


def test_a_model_whose_numbers_decide_otherwise_than_the_defaults_of_its_class_says_so():
    kind = crane()
    built = [jj.build(kind(*numbers)) for numbers in ((1.0, 1.0), (1.0, 10.0), (10.0, 1.0))]
    chosen, told = (
        [model.freedoms.privileged for model in built],
        ["which replace parameters traced by JAX" in str(model) for model in built],
    )
    assert told == [privileged != chosen[0] for privileged in chosen]
    assert any(told)


def batch(scene, ts, start):
    return jj.rollout(scene, {**start, "x": jnp.array([0.1, 0.2])}, ts=ts)["y"].tolist()


def alone(scene, ts, start):
    motion = jj.simulate(scene, start, ts=ts)
    return [
        int(motion.result),
        int(motion.fallback),
        float(motion.smallest_pivot),
        *motion.q_end.tolist(),
        *motion.u_end.tolist(),
    ]


def fitted(scene, ts, start):
    data = jj.Experiment(ts, {"x": 0.1 + ts, "z": 0.02 * ts}, 0.01, start=start)
    return jj.fit(scene, data, free={"arm": None}, max_iterations=2).values.tolist()


@pytest.mark.parametrize("run", [alone, batch, fitted])
def test_what_a_motion_a_batch_or_a_fit_runs_is_not_decided_by_the_call_before_it(run):
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


@pytest.mark.parametrize("kind", [TiltingDisc, DoublePendulumRods, jj.models.FreeRigidBody])
def test_a_model_comes_back_from_its_file_without_tracing_the_scene(kind, tmp_path, monkeypatch):
    model, path = jj.build(kind()), tmp_path / "file"
    model.save(path)
    ended = jj.simulate(model, t1=0.1).q_end
    jj.clear_caches()
    monkeypatch.setattr(jax, "make_jaxpr", None)
    loaded = jj.load_model(path, model.scene)
    monkeypatch.undo()
    assert str(loaded) == str(model)
    assert_array_equal(jj.simulate(loaded, t1=0.1).q_end, ended)
    path.write_bytes(path.read_bytes()[:-1])
    refused(
        "file and scene differ in scene, sha256; build and save it again",
        jj.load_model,
        path,
        ChaplyginSleigh(),
    )
