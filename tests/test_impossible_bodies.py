"""Bodies that cannot be end a lane with a result code, where no error can be raised: negative masses, and inertias that no body has."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results

import jourdain_jax as jj
from jourdain_jax.build.plausibility import CHECKS


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
    assert "(a negative mass: body `pebble`)" in named["negative mass"]
    assert "(a negative moment of inertia: body `top`)" in named["products beyond the moments"]
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

    turns = np.linalg.qr(generator.normal(size=(300, 3, 3)))[0]
    moments = (
        generator.uniform(0.01, 1.0, size=(300, 3)) * np.where(generator.uniform(size=(300, 3)) < 0.25, -1.0, 1.0) * 10.0 ** generator.uniform(-9, 9, (300, 1))
    )
    inertias = jnp.asarray(np.einsum("kij,kj,klj->kil", turns, moments, turns))
    (negative,) = (check.wrong for check in CHECKS if check.label == "a negative moment of inertia")
    wrong = jax.jit(negative)(jnp.pad(inertias, ((0, 0), (0, 1), (0, 0))))
    np.testing.assert_array_equal(wrong, moments.min(axis=1) < 0)


class Wheel(jj.Scene):
    """A wheel that rolls on a plane, each of its numbers open to mistakes."""

    moment: jnp.ndarray = jj.parameter(0.3)
    lopsided: jnp.ndarray = jj.parameter(0.0)
    stretch: jnp.ndarray = jj.parameter(1.0)
    mirror: jnp.ndarray = jj.parameter(1.0)
    radius: jnp.ndarray = jj.parameter(0.1)
    height: jnp.ndarray = jj.parameter(0.1)
    tyre: jnp.ndarray = jj.parameter(0.02)
    down: jnp.ndarray = jj.parameter((0.0, 0.0, -1.0))
    coordinates = jj.coordinates("x roll")

    def bodies(self, t, q):
        o = 0.0 * q.x
        inertia = jnp.diag(jnp.stack([self.moment, 0.3 + o, 0.3 + o])) + self.lopsided * jnp.eye(3, k=1)
        turned = jj.rot_y(q.roll) @ jnp.diag(jnp.stack([self.stretch, self.stretch * self.mirror, self.stretch]))
        return {"wheel": jj.RigidBody(1.0, inertia, jnp.stack([q.x, o, o + self.height]), turned)}

    def contacts(self, pose):
        return {"rim": jj.wheel_contact(pose["wheel"], self.radius, self.tyre)}

    def loads(self, motion):
        return (jj.gravity(motion, 9.81, direction=self.down),)


WRONG = {
    "lopsided": (0.01, "an inertia that is not symmetric: body `wheel`"),
    "moment": (-0.3, "a negative moment of inertia: body `wheel`"),
    "stretch": (2.0, "an orientation that is no rotation: body `wheel`"),
    "mirror": (-1.0, "a reflected orientation: body `wheel`"),
    "height": (0.2, "a body off its ground: contact `rim`"),
    "radius": (0.12, "a body off its ground: contact `rim`"),
    "tyre": (-0.01, "a negative tyre: contact `rim`"),
    "down": ((0.0, 0.0, -2.0), "a direction of gravity that is no unit vector: load 1"),
}


@pytest.mark.parametrize("backend", ["auto", pytest.param("dense", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", WRONG)
def test_what_a_single_motion_refuses_is_a_code_in_lanes(name, backend):
    sound, start, (value, fault) = Wheel(), {"x_rate": 0.1}, WRONG[name]
    with pytest.raises(ValueError, match=r"`wheel`|`rim`|gravity"):
        jj.simulate(sound.replace(**{name: value}), start, ts=[0.1])
    lanes = jj.rollout(sound, start, parameters={name: jnp.array([value, getattr(sound, name)])}, ts=[0.1], backend=backend, progress=False)
    assert lanes.result.tolist() == [results.BAD_PARAMETER, results.SUCCESS]
    assert fault in str(lanes)


@pytest.mark.parametrize("values", [{"radius": -0.1, "height": -0.1}, {"tyre": -0.01}, {"tyre": 0.2}])
def test_lengths_of_contacts_that_parameters_make_negative_are_refused(values):
    with pytest.raises(ValueError, match=r"contact `rim` of `Wheel` (is|has a tyre of) -"):
        jj.simulate(Wheel(**values), {"x_rate": 0.1}, ts=[0.1])


def test_wrong_numbers_inside_jit_and_vmap_are_a_code():
    def code(values):
        return jj.simulate(Wheel(stretch=values[0], radius=values[1]), {"x_rate": 0.1}, ts=[0.1]).result

    given = jnp.array([[1.0, 0.1], [2.0, 0.1], [1.0, 0.12]])
    assert jax.jit(jax.vmap(code))(given).tolist() == [results.SUCCESS, results.BAD_PARAMETER, results.BAD_PARAMETER]
    assert [int(jax.jit(code)(values)) for values in given[:2]] == [results.SUCCESS, results.BAD_PARAMETER]
