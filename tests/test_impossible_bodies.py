"""Bodies that cannot be end a lane with a result code, where no error can be raised: negative masses, and inertias that no body has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.build.plausibility import body_faults
from jourdain_jax.motion.trajectories import results


class Spinning(jj.Scene):
    """A body that slides and turns, its numbers made of parameters that may have any sign."""

    mass: jnp.ndarray = jj.parameter(1.0, unit="kg")
    moment: jnp.ndarray = jj.parameter(0.3, unit="kg m^2")
    product: jnp.ndarray = jj.parameter(0.0, unit="kg m^2")
    radius: jnp.ndarray = jj.parameter(0.5, unit="m", positive=True)
    coordinates = jj.coordinates("x turn")

    def bodies(self, t, q):
        inertia = self.moment * jnp.eye(3) + self.product * (jnp.ones((3, 3)) - jnp.eye(3))
        return {
            "top": jj.RigidBody(1.0, inertia, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]), jj.rot_z(q.turn)),
            "pebble": jj.Particle(self.mass * self.radius, jnp.stack([q.x, q.x, 0.0 * q.x])),
        }


LANES = {
    "sound": {},
    "negative mass": {"mass": -0.1},
    "negative moments": {"moment": -0.3},
    "products beyond the moments": {"product": 0.31},
    "negative products beyond half the moments": {"product": -0.16},
    "products within": {"product": 0.14},
    "massless pebble": {"mass": 0.0},
    "wrong radius": {"radius": -1.0},
    "no number": {"moment": np.nan},
}
SOUND = ("sound", "products within", "massless pebble")


def lanes(**options):
    values = {name: np.array([lane.get(name, float(getattr(Spinning(), name))) for lane in LANES.values()]) for name in ("mass", "moment", "product", "radius")}
    return jj.rollout(Spinning(), {"x_rate": 1.0, "turn_rate": 2.0}, parameters=values, ts=[0.5, 1.0], progress=False, **options)


@pytest.mark.parametrize("backend", ["auto", "dense"])
def test_lanes_whose_bodies_cannot_be_end_with_a_code_and_their_neighbours_move(backend):
    found = lanes(backend=backend)
    assert found.result.tolist() == [results.SUCCESS if name in SOUND else results.BAD_PARAMETER for name in LANES]
    for i, name in enumerate(LANES):
        if name in SOUND:
            np.testing.assert_allclose(found.lanes.q[i], [[0.5, 1.0], [1.0, 2.0]], rtol=1e-9)
        else:
            assert np.isnan(found.lanes.q[i]).all()
    named = {name: found.lane(i).message for i, name in enumerate(LANES)}
    assert "(a negative mass or moment of inertia of body `pebble`)" in named["negative mass"]
    assert "of body `top`)" in named["products beyond the moments"]
    assert "(`radius`)" in named["wrong radius"]
    assert "(`moment`)" in named["no number"]
    assert "body `pebble`" in str(found)


def test_a_traced_negative_mass_ends_with_a_code_inside_jit():
    code = jax.jit(jax.vmap(lambda mass: jj.simulate(Spinning(mass=mass), {"x_rate": 1.0}, ts=[1.0]).result))(jnp.array([1.0, -1.0]))
    assert code.tolist() == [results.SUCCESS, results.BAD_PARAMETER]
    with pytest.raises(ValueError, match=r"body `pebble` of `Spinning` has a mass of -0\.5 kg"):
        jj.simulate(Spinning(mass=-1.0), {"x_rate": 1.0}, ts=[1.0])


def test_an_inertia_is_impossible_where_an_eigenvalue_is_negative():
    generator = np.random.default_rng(0)

    class Any(jj.Scene):
        inertia: jnp.ndarray = jj.parameter(jnp.eye(3))
        coordinates = jj.coordinates("x")

        def bodies(self, t, q):
            return {"body": jj.RigidBody(1.0, self.inertia, jnp.stack([q.x, q.x, q.x]), jnp.eye(3))}

    turns = np.linalg.qr(generator.normal(size=(300, 3, 3)))[0]
    moments = (
        generator.uniform(0.01, 1.0, size=(300, 3)) * np.where(generator.uniform(size=(300, 3)) < 0.25, -1.0, 1.0) * 10.0 ** generator.uniform(-9, 9, (300, 1))
    )
    inertias = jnp.asarray(np.einsum("kij,kj,klj->kil", turns, moments, turns))
    wrong = jax.vmap(lambda I: body_faults(Any(inertia=I), 0.0, jnp.zeros(1))["body"])(inertias)
    np.testing.assert_array_equal(wrong, moments.min(axis=1) < 0)
