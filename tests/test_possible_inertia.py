"""Moments of inertia from numbers that may be anything: always those of a body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.identification import inertia_from_log_cholesky, log_cholesky, possible_inertia
from jourdain_jax.identification.solve.unknowns import unknowns_of

GENERATOR = np.random.default_rng(0)


def test_inertia_is_that_of_a_body_whatever_the_numbers_are():
    numbers = jnp.asarray(GENERATOR.normal(size=(2000, 6)) * np.array([2.0, 2.0, 2.0, 3.0, 3.0, 3.0]))
    moments = np.linalg.eigvalsh(np.asarray(jax.vmap(inertia_from_log_cholesky)(numbers)))
    assert np.all(moments[:, 0] > 0)
    assert np.all(moments[:, 2] <= (moments[:, 0] + moments[:, 1]) * (1 + 1e-12))


def test_every_cloud_of_points_has_its_numbers():
    for _ in range(20):
        points, masses = GENERATOR.normal(size=(7, 3)), GENERATOR.uniform(0.1, 1.0, 7)
        r = points - masses @ points / masses.sum()
        inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, r, strict=True))
        numbers = log_cholesky(inertia)
        assert numbers.shape == (6,)
        assert_allclose(inertia_from_log_cholesky(numbers), inertia, rtol=1e-12, atol=1e-12)
    flat = np.array([[0.5, 0.0, 0.1], [0.0, 0.8, 0.0], [0.1, 0.0, 0.4]])
    four = log_cholesky(flat, symmetric=True)
    assert four.shape == (4,)
    assert_allclose(inertia_from_log_cholesky(four), flat, rtol=1e-13, atol=1e-15)


def test_derivatives_are_finite_and_there_are_as_many_numbers_as_moments():
    numbers = log_cholesky([0.5, 0.8, 0.6])
    six = lambda x: inertia_from_log_cholesky(x)[np.triu_indices(3)]
    J = jax.jacfwd(six)(numbers)
    assert np.linalg.matrix_rank(J) == 6
    assert_allclose(J @ jax.jacfwd(lambda v: log_cholesky(of(v)))(six(numbers)), np.eye(6), atol=1e-12)


def of(v):
    """A symmetric matrix of its upper triangle."""
    return v[jnp.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]


class Turning(jj.Scene):
    """A body that turns about a fixed point under two springs, so that its moments of inertia show."""

    moments: jnp.ndarray = jj.parameter(jnp.array([0.5, 0.7, 0.4]), unit="kg m^2")

    coordinates = jj.coordinates("yaw pitch")

    def inertia(self):
        return jnp.diag(self.moments)

    def bodies(self, t, q):
        return {"body": jj.RigidBody(1.0, self.inertia(), jnp.zeros(3), jj.rot_z(q.yaw) @ jj.rot_y(q.pitch))}

    def loads(self, motion):
        return jj.generalized_force(motion, yaw_rate=-2.0 * motion.q.yaw, pitch_rate=-3.0 * motion.q.pitch)


class TurningBody(Turning):
    """Its motion, with moments that a body can have."""

    moments: float = jj.parameter(0.5 * np.log([0.3, 0.1, 0.4]))  # of 0.5, 0.7, 0.4 kg m^2

    def inertia(self):
        return inertia_from_log_cholesky(jnp.concatenate([self.moments, jnp.zeros(3)]))


class Driven(Turning):
    """A body under two springs, whose pitch turns a flywheel with a moment of 1.2 kg m^2."""

    def bodies(self, t, q):
        flywheel = jj.RigidBody(
            0.0, jnp.diag(jnp.array([0.0, 1.2, 0.0])), jnp.zeros(3), jj.rot_z(q.yaw) @ jj.rot_y(q.pitch)
        )
        return super().bodies(t, q) | {"flywheel": flywheel}


def test_a_fit_passes_moments_that_no_body_has_and_names_the_body_of_such_a_minimum():
    ts, start = np.linspace(0.0, 4.0, 41), {"yaw": 0.8, "pitch": 1.0}
    motion = jj.simulate(Driven(), start, ts=ts)
    data = jj.Experiment(ts, {name: motion[name] for name in ("yaw", "pitch")}, 0.01, start=start)
    fit = jj.fit(Turning(), data, ("moments",))
    assert fit.converged
    assert_allclose(fit.scene.moments, [0.5, 1.9, 0.4], rtol=1e-6)
    assert "above the sum of the others" in fit.impossible[0]
    assert "above the sum of the others" in str(fit)


def test_a_fit_whose_moments_end_beyond_what_a_body_can_have_ends_at_a_body():
    truth = jnp.array([0.5, 0.899, 0.4])  # Iyy is nearly the sum of the other two
    ts, start = np.linspace(0.0, 4.0, 41), {"yaw": 0.8, "pitch": 1.0}
    motion, noise = jj.simulate(Turning(moments=truth), start, ts=ts), np.random.default_rng(3)
    values = {name: np.asarray(motion[name]) + 0.1 * noise.normal(size=41) for name in ("yaw", "pitch")}
    data = jj.Experiment(ts, values, 0.1, start=start)
    free, body = (jj.fit(scene, data, ("moments",)) for scene in (Turning(), TurningBody()))
    by_name = jj.fit(Turning(), data, {"body": possible_inertia()})
    least, middle, largest = np.sort(free.scene.moments)
    assert largest > least + middle
    assert not by_name.impossible
    assert_allclose(by_name.scene.moments, jnp.diag(body.scene.inertia()), rtol=1e-6)
    assert_allclose(by_name.tied["moments"].value, by_name.scene.moments)
    flat = by_name["body second moment[1]"]  # Iyy is at most Ixx + Izz
    assert flat.value == 0
    assert 0 < flat.high < 0.2
    assert body.converged
    assert not body.impossible
    moments = np.linalg.eigvalsh(np.asarray(body.scene.inertia()))
    assert moments[0] > 0
    assert moments[2] <= moments[:2].sum() * (1 + 1e-12)
    assert_allclose(np.sort(moments), np.sort(truth), atol=0.1)


NUMBERS_OF = [
    (jj.models.WhippleBicycle(), "rear frame", {"IBxx", "IByy", "IBzz", "IBxz"}, 4),
    (jj.models.WhippleBicycle(), "rear wheel", {"IRxx", "IRyy"}, 2),
    (jj.models.Rattleback(), "stone", {"A", "B", "C", "D"}, 4),
    (jj.models.FreeRigidBody(), "body", {"i1", "i2", "i3"}, 3),
    (Turning(), "body", {"moments"}, 3),
]


@pytest.mark.parametrize(
    ("scene", "body", "names", "count"),
    NUMBERS_OF,
    ids=lambda x: type(x).__name__ if isinstance(x, jj.Scene) else None,
)
def test_whatever_the_numbers_of_a_body_are_its_parameters_are_possible(scene, body, names, count):
    unknowns = unknowns_of(scene, [], {body: possible_inertia()})
    layout = unknowns.layout
    assert layout.sizes == (count, 0)
    assert set(layout.following) == names
    for name in names:
        assert_allclose(getattr(layout.scene(scene, unknowns.guess), name), getattr(scene, name), rtol=1e-12)
    positive = unknowns.low == 0
    for x in GENERATOR.normal(size=(5, count)) * 2.0:
        shared = np.where(positive, np.exp(x), x)
        moved = layout.scene(scene, shared)
        I = np.asarray(jj.pose_at(moved, 0.0, moved.named()[0]).bodies[body].body.inertia)
        least, middle, largest = np.linalg.eigvalsh(I)
        assert least > 0
        assert largest <= (least + middle) * (1 + 1e-12)
        assert_allclose(
            np.concatenate(layout.bodies[0].numbers(moved)), shared, rtol=1e-6, atol=1e-6
        )  # as many as there are parameters


def test_a_batch_of_numbers_makes_a_batch_of_parameters():
    scene = jj.models.WhippleBicycle()
    free = {"rear wheel": possible_inertia(), "mB": None, "IFxx": lambda scene: 2.0 * scene.IRxx}
    layout = unknowns_of(scene, [], free).layout
    shared = GENERATOR.normal(size=(3, 2, 3))
    many = layout.scene(scene, shared)
    for index in np.ndindex(3, 2):
        one = layout.scene(scene, shared[index])
        for name in ("IRxx", "IRyy", "mB", "IFxx"):
            assert_allclose(getattr(many, name)[index], getattr(one, name), rtol=1e-14)
