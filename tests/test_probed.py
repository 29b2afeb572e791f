"""What is looked at of a scene is the same by its scalar graph and by JAX's own derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jourdain_jax as jj
from jourdain_jax.build.probed import TIMED, probed
from jourdain_jax.build.probed_on_graph import probed_on_graph, sampled_on_graph
from jourdain_jax.build.sampling import random_states, sampled_by_jax, symmetric_configurations
from jourdain_jax.build.structure import structure_of
from jourdain_jax.program.graph import Unsupported

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


@pytest.mark.parametrize("scene", [jj.models.MODELS[name]() for name in MODELS] + [Swinging()], ids=[*MODELS, "swinging"])
def test_probing_on_the_graph_agrees_with_jax(scene):
    t, q, u = random_states(scene, 6, np.random.default_rng(0))
    symmetric = symmetric_configurations(scene)[:4]
    states = np.append(t, np.zeros(len(symmetric))), np.concatenate([q, symmetric]), np.concatenate([u, u[: len(symmetric)]])
    generic = np.arange(len(states[0])) < 6
    expected, found = probed(scene, *states, -states[2], generic), probed_on_graph(scene, *states, -states[2], generic)
    for name in ("q", "position_error", "outside", "A", "A_other", "A_beyond", "M", "phi_at_rest", "potential_rates"):
        one, other = getattr(expected, name), getattr(found, name)
        np.testing.assert_allclose(other, one, rtol=1e-11, atol=1e-11 * (1 + np.max(np.abs(one), initial=0.0)), err_msg=name)
    for name in TIMED:
        assert _moves(expected.timed[name]) == _moves(found.timed[name]), name
    assert _moves(expected.motion_at_rest) == _moves(found.motion_at_rest)
    assert _moves(expected.inertia_rates) == _moves(found.inertia_rates)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11), expected.numbers, found.numbers)


@pytest.mark.parametrize("name", ["snakeboard", "ball-on-turntable", "double-pendulum-rods", "isokinetic-particle", "two-wheel-axle-redundant"])
def test_states_put_on_the_rows_on_the_graph_are_those_of_jax(name):
    scene = jj.models.MODELS[name]()
    t, q, u = random_states(scene, 32, np.random.default_rng(1))
    for expected, found in zip(sampled_by_jax(scene, t, q, u)[:2], sampled_on_graph(scene, t, q, u)[:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)


def test_the_structure_of_a_scene_without_a_scalar_form_is_found_by_jax():
    class Called(jj.models.MODELS["chaplygin-sleigh"]):
        def loads(self, motion):
            friction = jax.pure_callback(lambda u: -0.1 * u, jax.ShapeDtypeStruct((), motion.t.dtype), motion.u.heading_rate, vmap_method="expand_dims")
            return (jj.generalized_force(motion, heading_rate=jax.lax.stop_gradient(friction)),)

    expected, found = structure_of(jj.models.MODELS["chaplygin-sleigh"]()), structure_of(Called())
    assert (found.rank, found.independent, found.row_names) == (expected.rank, expected.independent, expected.row_names)
    assert found.worst_pivot == pytest.approx(expected.worst_pivot, abs=1e-12)


def test_a_scene_with_a_derivative_of_its_own_is_probed_by_jax_which_believes_it():
    @jax.custom_jvp
    def doubled(x):
        return x

    doubled.defjvp(lambda x, dx: (x[0], 2 * dx[0]))

    class Believed(jj.models.MODELS["chaplygin-sleigh"]):
        def coordinate_rates(self, t, q, u):
            return doubled(u.array)

    with pytest.raises(Unsupported, match="derivatives of its own"):
        probed_on_graph(Believed(), *(x[:2] for x in random_states(Believed(), 2, np.random.default_rng(0))), np.ones((2, 3)), np.ones(2, bool))
    assert structure_of(Believed()).rank == 1


def _moves(rates) -> bool:
    return any(bool(np.any(np.isfinite(x) & (x != 0))) for x in jax.tree.leaves(rates))
