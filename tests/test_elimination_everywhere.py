"""The scalar program divides by nothing that vanishes where rows determine the speeds, and keeps rows by
multipliers elsewhere.
"""

from dataclasses import fields

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from generated_robots import PlanarRobot, drawn
from numpy.testing import assert_allclose
from solved_states import over_states
from tolerances import ROUND_OFF

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.models import MODELS

# The scalar program divides by nothing that vanishes where the rows themselves determine the speeds: at any
# heading, with no mass, with dependent


@pytest.mark.parametrize("seed", [1, 3, 5, 12, 15])
def test_robots_and_beads_have_right_accelerations_at_every_heading(seed):
    anywhere = drawn(seed)
    t, q, u = jj.sample_states(anywhere, 64, seed=1)
    expected = np.asarray(over_states(lambda *state: jj.accelerations(anywhere, *state).udot, t, q, u))
    size = 1 + np.max(np.abs(expected), axis=1)
    for every_speed in (None, True):
        program = jj.lower(anywhere, every_speed)
        independent = list(program.independent)
        _, ydot, _, pivots, *_ = program.rates_and_pivots(
            program.fixed_values(anywhere), t, tuple(q.T), tuple(u.T[independent]), jnp.zeros(0)
        )
        assert np.max(np.abs(np.stack(ydot) - expected.T[independent]) / size) <= 1e-9
        if structure_of(anywhere).well_conditioned:
            assert np.all(np.abs(np.array(pivots)) > 0.02)


class Twice(PlanarRobot):
    """The robot with a row written twice, at another scale."""

    def velocity_constraints(self, m):
        rows = super().velocity_constraints(m)
        return rows | {"again": -3.0 * rows["left"]}


def test_rows_that_repeat_others_in_another_scale_are_redundant():
    structure = structure_of(Twice(turned=0.3))
    assert structure.rank == 3
    assert structure.redundant_rows == ("again[0]", "again[1]")
    assert structure.dependent_rows  # what is left of them still depends on each other


@pytest.mark.parametrize("turned", [0.0, 0.1, 0.7, 2.5])
def test_no_row_of_two_wheels_on_an_axle_is_called_redundant(turned):
    structure = structure_of(PlanarRobot(turned=turned))
    assert structure.rank == 3
    assert structure.redundant_rows == ()


def test_rates_may_be_differentiated_where_rows_were_combined():
    scene = PlanarRobot(turned=0.4)
    program = jj.lower(scene)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1, seed=2))
    y = tuple(u[list(program.independent)])
    weights = np.cos(np.arange(len(scene.speed_names)))[list(program.independent)]

    @jax.jit
    def at(x):
        ydot = program.rates(
            program.fixed_values(scene.replace(track=x[0])), t, tuple(x[1:]), y, jnp.zeros(0)
        )[1]
        return weights @ jnp.stack(ydot)

    x = np.append(float(scene.track), q)
    differences = [(at(x + step) - at(x - step)) / 2e-5 for step in 1e-5 * np.eye(len(x))]
    assert_allclose(jax.jit(jax.grad(at))(x), differences, atol=1e-7)


# Scenes whose speeds all stay in the state: rows kept by multipliers on the graph, states put back onto rows
# by the program.


@pytest.mark.parametrize("name", ["snakeboard", "pendulum-chain", "isokinetic-particle"])
def test_the_program_puts_states_where_dense_matrices_put_them(name):
    scene = MODELS[name]()
    program = jj.lower(scene)
    assert program.dependent == ()
    generator = np.random.default_rng(0)
    t, q, u = (jnp.asarray(x[0]) for x in jj.sample_states(scene, 1))
    q, u = (x + 1e-4 * generator.normal(size=x.shape) for x in (q, u))
    fixed, nothing = program.fixed_values(scene), jnp.zeros(len(scene.inputs))
    found_q, found_u = map(
        jnp.stack, program.projected(fixed, t, tuple(q), tuple(u), nothing, structure_of(scene).affine)
    )
    expected = jj.consistent(scene, t, q, u)
    assert_allclose(found_q, expected.q, atol=ROUND_OFF)
    assert_allclose(found_u, expected.u, atol=ROUND_OFF * (1 + np.max(np.abs(u))))


def test_a_disc_held_by_a_quaternion_keeps_its_norm_by_the_program():
    scene = MODELS["tilting-disc-quaternion"]()
    program = jj.lower(scene)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    y = tuple(u[k] for k in program.independent)
    found, same = program.projected(program.fixed_values(scene), t, tuple(1.001 * q), y, jnp.zeros(0), True)
    ((first, _),) = scene.coordinates.quaternions
    assert abs(jnp.linalg.norm(jnp.stack(found)[first : first + 4]) - 1) <= ROUND_OFF
    assert same == y


@pytest.mark.parametrize("name", ["skate", "chaplygin-sleigh", "isokinetic-particle"])
def test_which_scenes_keep_all_speeds(name):
    scene = MODELS[name]()
    motion = jj.simulate(scene, t1=1.0, rtol=1e-11, atol=1e-11)
    full = jj.simulate(
        scene, formulation=jj.Formulation("full"), t1=1.0, rtol=1e-11, atol=1e-11
    )  # on request, also where speeds could be eliminated
    by_multipliers = "multipliers (KKT), lowered to machine code"
    assert full.reduction == by_multipliers
    assert motion.reduction == (
        "privileged, lowered to machine code" if name == "chaplygin-sleigh" else by_multipliers
    )
    assert_allclose(full.u_end, motion.u_end, atol=1e-9)


class CarAtItsMiddle(jj.Scene):
    """A car whose rear blade is at the middle of its base: a coefficient of its constraints is zero there."""

    base: float = jj.parameter(2.6, unit="m", positive=True)
    share: float = eqx.field(static=True, default=0.5)  # of the base, from the point x, y to the mass centre
    coordinates = jj.coordinates("x y heading steer")
    privileged = ("x_rate", "steer_rate")
    domain = {"heading": (-1.2, 1.2), "steer": (-0.7, 0.7)}

    def bodies(self, t, q):
        car, axle = jj.rot_z(q.heading), jj.vec(q.x, q.y, 0)
        middle, front = (axle + share * self.base * car[:, 0] for share in (self.share, 1.0))
        return {
            "car": jj.RigidBody.box(900.0, (3.6, 1.5, 1.0), position=middle, orientation=car),
            "front": jj.RigidBody(30.0, jnp.ones(3), front, car @ jj.rot_z(q.steer)),
        }

    def velocity_constraints(self, motion):
        car, front = motion["car"], motion["front"]
        return {
            "rear": jj.knife_edge(car, car.place((-2.6 * self.share, 0.0, 0.0)), car.orientation[:, 1]),
            "front": jj.knife_edge(front, front.position, front.orientation[:, 1]),
        }


class Geared(jj.Scene):
    """A disc that a gear turns; the ratio `base/2 - 1.3` is the only coefficient of the dependent speed."""

    base: float = jj.parameter(3.0, unit="m", positive=True)
    coordinates = jj.coordinates("x turn")
    privileged = ("x_rate",)

    def bodies(self, t, q):
        return {"disc": jj.RigidBody(2.0, jnp.ones(3), jj.vec(q.x, 0, 0), jj.rot_z(q.turn))}

    def velocity_constraints(self, motion):
        return {"gear": (0.5 * self.base - 1.3) * motion.u.turn_rate - motion.u.x_rate}


def test_the_only_pivot_is_a_code_where_its_terms_nearly_cancel():
    off = np.array([0.0, 1e-12, 1e-9, -1e-7, 1e-6, 1e-4, -1e-3, 0.1])

    @jax.jit
    @jax.vmap
    def end(base):
        motion = jj.simulate(Geared(base=base), {"x_rate": 1.0}, t1=1.0)
        return motion.result, motion.q_end[1], 1.0 / (0.5 * base - 1.3)

    code, turn, rate = end(2.6 * (1 + off))
    assert np.all(code[:5] != results.SUCCESS)
    assert np.all(code[1:5] == results.SINGULAR_PARTITION)
    assert np.all(code[5:] == results.SUCCESS)
    assert_allclose(turn[5:], rate[5:], rtol=1e-9)


@pytest.mark.parametrize("backend", ["native", "xla"])
def test_lengths_near_those_at_which_a_coefficient_vanishes_are_right(backend):
    draws = np.random.default_rng(0)
    scene = CarAtItsMiddle(base=3.0, share=float(draws.uniform(0.2, 0.8)))
    off = draws.choice([-1.0, 1.0], 24) * 10.0 ** draws.uniform(-14.0, -1.0, 24)
    bases = 2.6 * (1 + np.append(off, 0.0))

    @jax.jit
    @jax.vmap
    def end(base):
        motion = jj.simulate(scene.replace(base=base), {"x_rate": 1.0, "steer": 0.2}, t1=1.0, backend=backend)
        return motion.result, motion.q_end[2]

    code, heading = end(bases)
    right = np.tan(0.2) / ((1 - scene.share) * bases + 2.6 * scene.share)
    assert np.all(code == results.SUCCESS)
    assert_allclose(heading, right, rtol=1e-8)
    for base, expected in list(zip(bases, right, strict=True))[-4:]:
        motion = jj.simulate(scene.replace(base=float(base)), {"x_rate": 1.0, "steer": 0.2}, t1=1.0)
        assert_allclose(motion.q_end[2], expected, rtol=1e-8)


class SleighWithoutDefaults(jj.Scene):
    """A sleigh whose parameters have no defaults."""

    mass: float = jj.parameter(unit="kg")
    offset: float = jj.parameter(unit="m")
    coordinates = jj.coordinates("x y heading")

    def bodies(self, t, q):
        body = jj.rot_z(q.heading)
        centre = jj.vec(q.x, q.y, 0) + self.offset * body[:, 0]
        return {"sleigh": jj.RigidBody(self.mass, jnp.ones(3), centre, body)}

    def velocity_constraints(self, motion):
        body = motion["sleigh"]
        return {"blade": jj.knife_edge(body, body.place((-self.offset, 0.0, 0.0)), body.orientation[:, 1])}


@pytest.mark.parametrize(
    "usual", [MODELS["snakeboard"](), SleighWithoutDefaults(1.3, 0.25)], ids=["snakeboard", "sleigh"]
)
def test_the_scene_of_a_class_that_comes_first_does_not_matter(usual):
    leaves = jax.tree.leaves(usual)
    given = {f.name: getattr(usual, f.name) for f in fields(usual)[len(fields(jj.Scene)) :]}
    draws = np.random.default_rng(0)
    sizes = [np.exp(spread * draws.uniform(-1.0, 1.0, len(leaves))) for spread in (0.0, 0.3, 0.3, 0.8)]
    sources, ends = set(), set()
    for order in ((1,), (0, 1), (3, 2, 1)):
        treedef = jax.tree.structure(type("Fresh", (type(usual),), {})(**given))
        for k in order:  # a class of which nothing is known yet
            scene = jax.tree.unflatten(treedef, [f * x for f, x in zip(sizes[k], leaves, strict=True)])
            program = jj.lower(scene)
        sources.add(program.python_source())
        if order != (0, 1):
            ends.add(np.asarray(jj.simulate(scene, jj.start(scene), t1=0.1).q_end).tobytes())
    assert len(sources) == len(ends) == 1
