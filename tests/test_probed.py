"""What is looked at of a scene is the same by its scalar graph and by JAX's own derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax import coordinate_rates, motion_at, pose_at, position_residual, structure_of, velocity_residual
from jourdain_jax.build.plausibility import numbers_of
from jourdain_jax.build.probed_on_graph import TIMED, generic_inputs, probed_on_graph, sampled_on_graph
from jourdain_jax.build.sampling import random_states, symmetric_configurations
from jourdain_jax.build.trace import explicit_rates, potentials_of
from jourdain_jax.equations.kinematics import inertias, velocities
from jourdain_jax.equations.projection import closure_residual, project_speeds
from jourdain_jax.equations.virtual_power import mass_matrix_at

MODELS = ["skate", "tilting-disc-quaternion", "ball-on-turntable", "snakeboard", "rattleback", "double-pendulum-rods", "isokinetic-particle", "trailer-chain"]


class Swinging(jj.Scene):
    """A bead on a wire that turns, is lifted, grows in time and hangs on a spring whose other end is an input."""

    mass: Float[Array, ""] = jj.parameter(2.0)
    coordinates = jj.coordinates("s")
    inputs = jj.inputs("end")

    def bodies(self, t, q):
        place = jnp.stack([q.s * jnp.cos(0.3 * t), q.s * jnp.sin(0.3 * t), t**2])
        return {"bead": jj.Particle(self.mass * (1 + 0.1 * t), place)}

    def loads(self, motion):
        return (jj.spring(motion["bead"].point(), jj.fixed_point(jnp.stack([motion.inputs.end, 1.0, 0.0])), 3.0 + jnp.sin(motion.t), 0.1),)


def by_jax(scene, t, q, q_beyond, u, u_other):
    """What is looked at, at one state, by JAX's own derivatives."""
    inputs, rest = jnp.asarray(generic_inputs(scene), q.dtype), jnp.zeros_like(u)
    slopes = jax.jacfwd(lambda q, v: velocity_residual(scene, t, q, v, inputs), argnums=1)
    qdot, motion = coordinate_rates(scene, t, q, u), motion_at(scene, t, q, u, inputs)

    def pieces(t):
        poses = [(body.position, body.orientation) for body in pose_at(scene, t, q).bodies.values()]
        rows = velocity_residual(scene, t, q, u, inputs), position_residual(scene, t, q)
        return {"rows": rows, "poses": poses, "inertias": inertias(scene, t, q), "coordinate rates": coordinate_rates(scene, t, q, u)}

    return {
        "closure": closure_residual(scene, t, q),
        "A": slopes(q, u),
        "A_other": slopes(q, u_other),
        "A_beyond": slopes(q_beyond, u),
        "M": mass_matrix_at(scene, t, q),
        "phi_at_rest": velocity_residual(scene, t, q, rest, inputs),
        "motion_at_rest": (velocities(scene, t, q, rest), coordinate_rates(scene, t, q, rest)),
        "timed": jax.jvp(pieces, (t,), (jnp.ones_like(t),))[1] | explicit_rates(scene, motion),
        "inertia_rates": jax.jvp(lambda t, q: inertias(scene, t, q), (t, q), (jnp.ones_like(t), qdot))[1],
        "potential_rates": jax.jvp(lambda i: potentials_of(scene, motion_at(scene, t, q, u, i)), (inputs,), (inputs**2,))[1],
        "numbers": numbers_of(scene, motion),
    }


class Called(jj.models.MODELS["chaplygin-sleigh"]):
    """A sleigh with friction that asks Python, which has no derivative."""

    def loads(self, motion):
        friction = jax.pure_callback(lambda u: -0.1 * u, jax.ShapeDtypeStruct((), motion.t.dtype), motion.u.heading_rate, vmap_method="expand_dims")
        return (jj.generalized_force(motion, heading_rate=jax.lax.stop_gradient(friction)),)


class OnPath(jj.Scene):
    """A bead on a path that is found by an iteration, tied to a point by a rod: poses and rows are calls of JAX."""

    mass: Float[Array, ""] = jj.parameter(2.0)
    coordinates = jj.coordinates("x z")
    domain = {"x": (-1.0, 1.0), "z": (-1.0, 1.0)}

    def bodies(self, t, q):
        newton = lambda v: v - (v**3 + v - q.x) / (3 * v * v + 1)  # noqa: E731
        root = jax.lax.while_loop(lambda v: jnp.abs(newton(v) - v) > 1e-14, newton, jnp.zeros_like(q.x))
        return {"bead": jj.Particle(self.mass, jnp.stack([q.x, root, q.z]))}

    def geometric_constraints(self, pose):
        return {"rod": pose["bead"].position @ pose["bead"].position - 0.5}


SCENES = {name: jj.models.MODELS[name]() for name in MODELS} | {"swinging": Swinging(), "called": Called(), "on a path": OnPath()}


@pytest.mark.parametrize("name", SCENES)
def test_what_is_looked_at_on_the_graph_is_what_jax_finds(name):
    scene = SCENES[name]
    t, q, u = random_states(scene, 6, np.random.default_rng(0))
    symmetric = symmetric_configurations(scene)[:4]
    t, q, u = np.append(t, np.zeros(len(symmetric))), np.concatenate([q, symmetric]), np.concatenate([u, u[: len(symmetric)]])
    found = probed_on_graph(scene, t, q, u, -u, np.arange(len(t)) < 6)
    expected = jax.vmap(by_jax, in_axes=(None, 0, 0, 0, 0, 0))(scene, t, found.q, q, u, -u)
    on_rows = np.isfinite(found.error)
    assert np.max(np.abs(expected["closure"][on_rows]), initial=0.0) < 1e-12
    for name in ("A", "A_other", "A_beyond", "M", "phi_at_rest", "potential_rates"):
        one, other = expected[name], getattr(found, name)
        assert_allclose(other, one, rtol=1e-11, atol=1e-11 * (1 + np.max(np.abs(one), initial=0.0)), err_msg=name)
    for name in TIMED:
        assert _moves(expected["timed"][name]) == _moves(found.timed[name]), name
    assert _moves(expected["motion_at_rest"]) == _moves(found.motion_at_rest)
    assert _moves(expected["inertia_rates"]) == _moves(found.inertia_rates)
    jax.tree.map(lambda a, b: assert_allclose(a, b, rtol=1e-11, atol=1e-11), expected["numbers"], found.numbers)


@pytest.mark.parametrize("name", ["snakeboard", "ball-on-turntable", "double-pendulum-rods", "isokinetic-particle", "two-wheel-axle-redundant", "on a path"])
def test_speeds_put_on_the_rows_on_the_graph_are_those_of_jax(name):
    scene = SCENES[name] if name in SCENES else jj.models.MODELS[name]()
    t, q, u = random_states(scene, 32, np.random.default_rng(1))
    q, found, _ = sampled_on_graph(scene, t, q, u)
    assert_allclose(found, jax.vmap(lambda t, q, u: project_speeds(scene, t, q, u))(t, q, u), rtol=1e-11, atol=1e-11)


def test_what_a_call_in_a_pose_does_not_do_is_known():
    found = structure_of(OnPath())
    assert (found.rank, found.affine, found.homogeneous, found.driven) == (1, True, True, False)


def test_a_callback_in_a_load_changes_nothing_else():
    expected, found = structure_of(jj.models.MODELS["chaplygin-sleigh"]()), structure_of(Called())
    assert (found.rank, found.independent, found.row_names) == (expected.rank, expected.independent, expected.row_names)
    assert found.worst_pivot == pytest.approx(expected.worst_pivot, abs=1e-12)


def test_a_pose_that_jax_cannot_differentiate_is_named():
    class Asked(jj.models.MODELS["chaplygin-sleigh"]):
        def velocity_constraints(self, motion):
            turn = jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), motion.t.dtype), motion.q.heading + motion.u.heading_rate, vmap_method="expand_dims")
            return {"blade": motion.u.y_rate - turn}

    with pytest.raises(ValueError, match=r"the motion of `Asked` needs the derivative of the operation `pure_callback`"):
        structure_of(Asked())


def test_a_derivative_rule_in_the_rates_of_coordinates_is_believed():
    @jax.custom_jvp
    def doubled(x):
        return x

    doubled.defjvp(lambda x, dx: (x[0], 2 * dx[0]))

    class Believed(jj.models.MODELS["chaplygin-sleigh"]):
        def coordinate_rates(self, t, q, u):
            return doubled(u.array)

    assert structure_of(Believed()).rank == 1


def _moves(rates) -> bool:
    return any(bool(np.any(np.isfinite(x) & (x != 0))) for x in jax.tree.leaves(rates))
