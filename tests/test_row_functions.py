"""Rows by machine code as functions that JAX differentiates, and named starts that they are put onto."""

import jax
import jax.numpy as jnp
import result_codes as results
from numpy.testing import assert_allclose
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.program import interpret
from jourdain_jax.structure.row_program import row_program


def of_skate(y_rate, run=jj.simulate):
    start = {"heading": 0.0, "x_rate": 1.0, "y_rate": y_rate, "heading_rate": 0.1}
    return run(jj.models.Skate(), start, t1=0.5)


def test_values_that_contradict_each_other_get_a_result_code_where_they_are_traced():
    seen = jax.jit(of_skate)
    assert seen(0.5).result == results.INCONSISTENT_START
    refused("violates constraint `edge`", of_skate, 0.5)
    for motion in (seen(1e-7), of_skate(1e-7)):
        assert motion.result == results.SUCCESS
        assert_allclose(motion.u[0], [1.0, 0.0, 0.1], atol=1e-15)  # what passes for round-off moves
        assert_allclose(motion.moved_u, 1e-7, rtol=1e-6)
    lanes = of_skate(jnp.array([0.0, 0.5, 1e-7]), jj.rollout)
    assert lanes.result.tolist() == [results.SUCCESS, results.INCONSISTENT_START, results.SUCCESS]


def test_a_scene_whose_parameters_are_judged_by_an_unknown_operation_moves_without_a_program_of_rows(
    monkeypatch,
):
    def moved():
        class Hanging(jj.Scene):
            length: float = jj.parameter(0.7, positive=True)
            coordinates = jj.coordinates("x z")

            def bodies(self, t, q):
                return {"bob": jj.Particle(1.0, [q.x, 0.0, q.z])}

            def geometric_constraints(self, pose):
                return {"rod": pose.q.x**2 + pose.q.z**2 - self.length**2}

            def loads(self, motion):
                return jj.gravity(motion, 9.81)

        scene = Hanging()
        return row_program(scene), jj.simulate(scene, {"x": 0.42, "z": -0.56}, t1=0.2).q_end

    program, known = moved()
    monkeypatch.setattr(
        interpret, "REDUCTIONS", interpret.REDUCTIONS - {"reduce_or"}
    )  # as where a newer version of JAX brings an operation
    none, found = moved()
    assert program is not None
    assert none is None
    assert_allclose(found, known, rtol=0, atol=1e-8)
