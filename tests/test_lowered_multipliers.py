"""Scenes whose speeds all stay in the state: rows kept by multipliers on the graph, states put back onto rows by the program."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from tolerances import tolerance

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.build.structure import LONG
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.models import MODELS
from jourdain_jax.motion.vector_fields.choice import vector_field


def ends(scene, start, t1, **options):
    motion = jj.simulate(scene, start, ts=jnp.array([t1]), rtol=1e-11, atol=1e-11, work=False, **options)
    return jnp.concatenate([motion.q_end, motion.u_end])


@pytest.mark.parametrize("name", ["snakeboard", "pendulum-chain", "isokinetic-particle"])
def test_the_program_puts_states_where_dense_matrices_put_them(name):
    scene = MODELS[name]()
    program = jj.lower(scene)
    assert program.dependent == ()
    generator = np.random.default_rng(0)
    t, q, u = (jnp.asarray(x[0]) for x in jj.sample_states(scene, 1))
    q, u = (x + 1e-4 * generator.normal(size=x.shape) for x in (q, u))
    fixed, nothing = program.fixed_values(scene), jnp.zeros(len(scene.inputs))
    found_q, found_u = map(jnp.stack, program.projected(fixed, t, tuple(q), tuple(u), nothing, structure_of(scene).affine))
    expected_q = project_positions(scene, t, q, iterations=2)
    assert_allclose(found_q, expected_q, atol=tolerance("round_off"))
    assert_allclose(found_u, project_speeds(scene, t, expected_q, u, iterations=2), atol=tolerance("round_off") * (1 + np.max(np.abs(u))))


def test_a_disc_held_by_a_quaternion_keeps_its_norm_by_the_program():
    scene = MODELS["tilting-disc-quaternion"]()
    program = jj.lower(scene)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    y = tuple(u[k] for k in program.independent)
    found, same = program.projected(program.fixed_values(scene), t, tuple(1.001 * q), y, jnp.zeros(0), True)
    ((first, _),) = scene.coordinates.quaternions
    assert abs(float(jnp.linalg.norm(jnp.stack(found)[first : first + 4])) - 1) <= tolerance("round_off")
    assert same == y


def test_a_motion_through_a_loss_of_rank_is_right_or_continued_by_dense_matrices():
    board = MODELS["snakeboard"]()
    angle = np.pi / 2
    # ends exactly where the rows are parallel: the program does not serve there
    start = jj.start(board, steer=0.3, steer_rate=0.5, heading_rate=0.2)
    motion = jj.simulate(board, start, t1=float((angle - 0.3) / 0.5), rtol=1e-9, atol=1e-9)
    beyond = jj.simulate(board, start, t1=float((np.pi - 0.6) / 0.5), rtol=1e-9, atol=1e-9)
    dense = jj.simulate(board, start, t1=float((np.pi - 0.6) / 0.5), rtol=1e-11, atol=1e-11, backend="dense")
    assert int(beyond.result) == int(dense.result) == results.SUCCESS
    assert_allclose(beyond.u_end, dense.u_end, atol=1e-6)
    assert int(motion.result) in (results.SUCCESS, results.SINGULAR_PARTITION, results.STEP_TOO_SMALL)
    if int(motion.result) == results.SUCCESS:
        middle = jnp.interp(motion.t_end, dense.ts, dense["x_rate"])
        assert_allclose(motion["x_rate"][-1], middle, atol=1e-3)


def test_which_scenes_keep_all_speeds():
    for name, scene in ((name, model()) for name, model in MODELS.items() if name in ("skate", "chaplygin-sleigh", "isokinetic-particle")):
        form = vector_field(scene)
        assert (form.name == "full") == (name != "chaplygin-sleigh")
        assert form.lowered is not None
        assert form.reduction_name == ("privileged, lowered" if name == "chaplygin-sleigh" else "multipliers (KKT), lowered")
    # on request, also where speeds could be eliminated
    full = jj.simulate(MODELS["chaplygin-sleigh"](), formulation=jj.Formulation("full"), t1=1.0, rtol=1e-11, atol=1e-11)
    assert full.reduction == "multipliers (KKT), lowered to machine code"
    assert_allclose(full.u_end, jj.simulate(MODELS["chaplygin-sleigh"](), t1=1.0, rtol=1e-11, atol=1e-11).u_end, atol=1e-9)


def test_a_long_chain_counts_as_well_conditioned_where_a_short_one_with_the_same_number_does_not():
    structure = dataclasses.replace(structure_of(MODELS["skate"]()), worst_pivot=0.01)
    assert dataclasses.replace(structure, rank=2 * LONG).well_conditioned
    assert not dataclasses.replace(structure, rank=LONG).well_conditioned
