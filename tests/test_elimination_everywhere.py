"""The scalar program divides by nothing that vanishes where the rows themselves determine the speeds: at any heading, with no mass, with dependent rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from generated_robots import BeadOnCurve, PlanarRobot, drawn
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax import NullSpaceQR, structure_of
from jourdain_jax.build.trace import named_values
from jourdain_jax.dynamics.accelerations import bare_accelerations
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.minimal import accelerations_of, minimal_kinematics
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.models import TrailerChain
from jourdain_jax.program.evaluate import Probes

WEIGHTLESS = {"trailer_mass": 0.0, "trailer_inertia": 0.0}
ROBOT = {"left_rate": 3.0, "right_rate": 20.0}


@eval_numpy
def dense_accelerations(scene, t, q, u):
    return jax.vmap(lambda t, q, u: bare_accelerations(scene, t, q, u, jnp.zeros(0), reduction=NullSpaceQR()).udot)(t, q, u)


@eval_numpy
def privileged_accelerations(scene, t, q, y):
    structure = structure_of(PlanarRobot(turned=0.4))
    known = minimal_kinematics(scene, structure.independent, structure.kept_rows, t, q, y)
    return accelerations_of(scene, known, t, q)[1].udot[jnp.array(structure.independent)]


def at_states(scene, program, t, q, u, nodes):
    """Values of nodes of a program at states of a scene."""
    values = named_values(scene, t, q, u, np.zeros((len(t), 0)))
    values |= {f"p{k}_{i}": np.full(len(t), x) for k, leaf in enumerate(jax.tree.leaves(scene)) for i, x in enumerate(np.ravel(leaf))}
    return Probes(program.graph, {name: np.asarray(value, float) for name, value in values.items()})(nodes)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 5)), 12, pytest.param(15, marks=pytest.mark.slow)])
def test_robots_and_beads_have_right_accelerations_at_every_heading(seed):
    anywhere = drawn(seed, narrow=False)
    t, q, u = jj.sample_states(anywhere, 64, seed=1)
    expected = dense_accelerations(anywhere, t, q, u)
    for every_speed in (None, True):
        program = lowered(anywhere, every_speed)
        found = at_states(anywhere, program, t, q, u, [*program.ydot, *program.pivots])
        udot, pivots = found[: len(program.ydot)].T, found[len(program.ydot) :]
        wanted = expected[:, list(program.independent)]
        size = 1 + np.max(np.abs(expected), axis=1, keepdims=True)
        assert np.max(np.abs(udot - wanted) / size) <= 1e-9
        if structure_of(anywhere).well_conditioned:
            assert np.all(np.abs(pivots) > 20 * SMALLEST_PIVOT * np.reshape(program.pivot_sizes(program.fixed_values(anywhere)), (-1, 1)))


def motion_and_reference(scene, start, t1, *, traced=(), **options):
    """Under `jit`, `traced` parameters traced as well, and by dense matrices."""

    def run(values, start):
        return jj.simulate(scene.replace(**values) if values else scene, start, ts=jnp.linspace(0.0, t1, 9), rtol=1e-10, atol=1e-10, work=False, **options)

    values = {name: getattr(scene, name) for name in traced}
    reference = jj.simulate(scene, start, ts=jnp.array([t1]), formulation=jj.Formulation("full"), backend="dense", rtol=1e-11, atol=1e-11, work=False)
    return jax.jit(run)(values, jj.start(scene, **start)), reference


@pytest.mark.parametrize(
    ("scene", "start"),
    [
        (BeadOnCurve(), BeadOnCurve().start()),
        (PlanarRobot(trailers=1, turned=0.4), PlanarRobot(trailers=1).start(**ROBOT)),
    ],
    ids=["bead on a ring", "robot with a trailer"],
)
@pytest.mark.parametrize("state", ["auto", "full"])
def test_motions_through_full_turns_are_served_by_one_program(scene, start, state):
    motion, reference = motion_and_reference(scene, start, 3.0, formulation=jj.Formulation(state))
    assert int(motion.result) == results.SUCCESS
    assert "lowered" in motion.reduction
    assert motion.smallest_pivot > 0.1
    assert_allclose(motion.q_end, reference.q_end, atol=1e-8)


def test_rows_along_axes_at_any_angle_that_is_traced_are_served():
    scene = PlanarRobot(trailers=1)
    start = jj.start(scene, **scene.start(**ROBOT))
    angles = jnp.array([0.0, 0.4, np.pi / 2, -2.0])
    ends = jax.jit(jax.vmap(lambda a: jj.simulate(scene.replace(turned=a), start, ts=jnp.array([2.0]), rtol=1e-10, atol=1e-10, work=False)))(angles)
    assert np.all(np.asarray(ends.result) == results.SUCCESS)
    assert_allclose(ends.q_end, jnp.broadcast_to(ends.q_end[0], ends.q_end.shape), atol=1e-8)


WEIGHTLESS_ROBOT = PlanarRobot(trailers=1, maximal=True, **WEIGHTLESS), PlanarRobot(trailers=1, maximal=True).start(**ROBOT)
WEIGHTLESS_CAR = TrailerChain(trailers=1, **WEIGHTLESS), TrailerChain(trailers=1).towing([0.0, 0.3], forward=1.0, turn=0.8)


@pytest.mark.parametrize(
    ("scene", "start", "state"),
    [
        pytest.param(*WEIGHTLESS_ROBOT, "full", id="robot-full"),
        pytest.param(*WEIGHTLESS_CAR, "auto", id="car-auto"),
        pytest.param(*WEIGHTLESS_ROBOT, "auto", id="robot-auto", marks=pytest.mark.slow),
        pytest.param(*WEIGHTLESS_CAR, "full", id="car-full", marks=pytest.mark.slow),
    ],
)
def test_massless_trailers_follow_also_where_their_masses_are_traced(scene, start, state):
    motion, reference = motion_and_reference(scene, start, 2.0, traced=WEIGHTLESS, formulation=jj.Formulation(state))
    assert int(motion.result) == results.SUCCESS
    assert_allclose(motion.q_end, reference.q_end, atol=1e-8)


class LightKnee(jj.Scene):
    """A pendulum with a knee of no mass half-way, in Cartesian coordinates: at right angles no two speeds determine the others, and M is singular."""

    knee: object = jj.parameter(0.0, unit="kg", non_negative=True)
    coordinates = jj.coordinates("x z x_end z_end")
    domain = {"x": (-0.9, 0.9), "z": (-1.2, 1.0), "x_end": (-0.9, 0.9), "z_end": (-2.2, 2.0)}

    def bodies(self, t, q):
        o = 0 * q.x
        return {"knee": jj.Particle(self.knee, jnp.stack([q.x, o, q.z])), "bob": jj.Particle(1.0, jnp.stack([q.x_end, o, q.z_end]))}

    def geometric_constraints(self, pose):
        q = pose.q
        return {"rod": q.x**2 + q.z**2 - 1.0, "straight": jnp.stack([q.x_end - 2 * q.x, q.z_end - 2 * q.z])}

    def loads(self, motion):
        return (jj.gravity(motion, 9.81, (0.0, 0.0, -1.0)),)


@pytest.mark.parametrize("knee", [0.0, 0.7])
def test_multipliers_serve_where_a_body_that_rows_hold_has_no_mass(knee):
    start = {"x": 0.6, "z": -0.8, "x_end": 1.2, "z_end": -1.6, "x_rate": 4.0}
    motion, reference = motion_and_reference(LightKnee(knee=knee), start, 2.0, traced=("knee",))
    assert int(motion.result) == results.SUCCESS
    assert_allclose(motion.q_end, reference.q_end, atol=1e-8)
    energy = motion.energies().balance
    assert_allclose(energy, jnp.full(len(energy), energy[0]), atol=1e-7)


class Twice(PlanarRobot):
    """The robot with a row written twice, at another scale."""

    def velocity_constraints(self, m):
        rows = super().velocity_constraints(m)
        return rows | {"again": -3.0 * rows["left"]}


@pytest.mark.parametrize("state", ["auto", "full"])
def test_dependent_rows_are_served_in_both_forms_of_the_state(state):
    scene = Twice(turned=0.3)
    structure = structure_of(scene)
    assert structure.rank == 3
    assert structure.redundant_rows == ("again[0]", "again[1]")
    assert structure.dependent_rows  # what is left of them still depends on each other
    motion, reference = motion_and_reference(scene, scene.start(**ROBOT), 2.0, formulation=jj.Formulation(state), traced=("turned",))
    assert int(motion.result) == results.SUCCESS
    assert_allclose(motion.q_end, reference.q_end, atol=1e-8)


@pytest.mark.parametrize("turned", [0.0, 0.1, 0.7, 2.5])
def test_no_row_of_two_wheels_on_an_axle_is_called_redundant(turned):
    structure = structure_of(PlanarRobot(turned=turned))
    assert structure.rank == 3
    assert structure.redundant_rows == ()


def test_rates_may_be_differentiated_where_rows_were_combined():
    scene = PlanarRobot(turned=0.4)
    program = lowered(scene)
    t, q, u = (x[:1] for x in jj.sample_states(scene, 1, seed=2))
    weights = np.cos(np.arange(len(scene.speed_names)))[list(program.independent)]

    def end(track, q):
        y = tuple(u[0, k] for k in program.independent)
        ydot = program.rates(program.fixed_values(scene.replace(track=track)), t[0], tuple(q), y, jnp.zeros(0))[1]
        return weights @ jnp.stack(ydot)

    slopes = jnp.concatenate([jnp.ravel(x) for x in jax.jit(jax.grad(end, (0, 1)))(scene.track, jnp.asarray(q[0]))])

    def by_matrices(track, q):
        moved = scene.replace(track=track)
        return weights @ privileged_accelerations(moved, t[0], q, u[0, list(program.independent)])

    steps, by_hand = 1e-5 * np.eye(1 + q.shape[1]), []
    for step in steps:
        ends = [by_matrices(float(scene.track) + sign * step[0], q[0] + sign * step[1:]) for sign in (1, -1)]
        by_hand.append((ends[0] - ends[1]) / 2e-5)
    assert_allclose(slopes, by_hand, atol=1e-7)


@pytest.mark.parametrize("scale", [1e3, 1e-4])
def test_pivots_and_codes_do_not_depend_on_what_was_built_before(scale):
    found = {}
    for order in ((1.0, scale), (scale, 1.0)):

        class Belt(jj.Scene):
            """A belt on a drum that is not round."""

            radius: float = jj.parameter(1.0, unit="m")
            coordinates = jj.coordinates("x angle")
            privileged = "x_rate"

            def bodies(self, t, q):
                turned = self.radius * jnp.stack([jnp.cos(q.angle), jnp.sin(q.angle), 0 * q.x])
                return {"load": jj.Particle(1.0, jnp.stack([q.x, 0 * q.x, 0 * q.x])), "drum": jj.Particle(1.0, turned)}

            def velocity_constraints(self, motion):
                return {"belt": self.radius * (2 + jnp.cos(motion.q.angle)) * motion.u.angle_rate - motion.u.x_rate}

        for radius in order:
            motion = jj.simulate(Belt(radius=radius), {"angle": 2.0, "x_rate": radius}, t1=2.0)
            found[order, radius] = [float(x).hex() for x in (motion.smallest_pivot, *motion.q_end, *motion.u_end)], int(motion.result), int(motion.fallback)
    for radius in (1.0, scale):
        assert found[(1.0, scale), radius] == found[(scale, 1.0), radius]
        assert found[(1.0, scale), radius][1:] == (results.SUCCESS, results.AS_ASKED)
        assert 0.1 < float.fromhex(found[(1.0, scale), radius][0][0]) < 0.9
