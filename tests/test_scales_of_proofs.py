"""What is proved of a scene does not depend on the size of its numbers: nothing is dropped for being small,
nothing hidden by what is large elsewhere.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from test_identity_test import traced

import jourdain_jax as jj
from jourdain_jax.program.identity_test import equal

SCALES = [float(f"1e{k}") for k in (-30, -24, -16, -9, -3, 3, 9, 16, 24, 30)]


def judged(f):
    """Whether the two results of f(x, y, p), which are numbers or arrays, are equal."""
    nodes, _, probes = traced(lambda *at: [*jnp.concatenate([jnp.atleast_1d(x) for x in f(*at)])])
    a, b = np.reshape(nodes, (2, -1)).tolist()
    return equal(probes(a), probes(b)).tolist()


DIFFERENT = {
    "a small term beside a large one": lambda c, x, y, p: (y, y + c * x),
    "a large term beside a small one": lambda c, x, y, p: (c * y, c * y + x),
    "another function": lambda c, x, y, p: (y, y - c * jnp.exp(x / 0.1)),
    "within a root": lambda c, x, y, p: (jnp.sqrt(1.0 + y * y), jnp.sqrt(1.0 + y * y + c * x)),
    "in a divisor": lambda c, x, y, p: (1.0 / (2.0 + y), 1.0 / (2.0 + y + c * jnp.sin(x))),
    "twice": lambda c, x, y, p: (y * p, (y + c * x) * (p + c)),
}
# but where a number and its double lie on either side of 2^20, 2^60, 2^100: there what is equal passes for
# different, which costs operations, never truth
OF_IDENTITIES = [*SCALES[:-1], 1e28]
EQUAL = {
    "waves": lambda c, x, y, p: (
        c * jnp.sin(x + y),
        c * jnp.sin(x) * jnp.cos(y) + c * jnp.cos(x) * jnp.sin(y),
    ),
    "squares": lambda c, x, y, p: (c * (x + y) ** 2, c * x * x + 2.0 * (c * x) * y + (c * y) * y),
    "a factor taken out": lambda c, x, y, p: ((c * x) / (c * y), x / y),
    "a turned plane": lambda c, x, y, p: (c * (jnp.cos(x) ** 2 + jnp.sin(x) ** 2) * p, c * p),
    "a difference of large numbers": lambda c, x, y, p: (c * x * y - c * y * x + p, p),
}


@pytest.mark.parametrize("name", DIFFERENT)
def test_no_term_is_too_small_or_too_large_to_count(name):
    assert [c for c in SCALES if judged(lambda x, y, p, c=c: DIFFERENT[name](c, x, y, p)) != [False]] == []


@pytest.mark.parametrize("name", EQUAL)
def test_identities_hold_at_every_scale(name):
    assert [c for c in OF_IDENTITIES if judged(lambda x, y, p, c=c: EQUAL[name](c, x, y, p)) != [True]] == []


def test_a_large_number_elsewhere_hides_nothing():
    def f(x, y, p):
        return jnp.stack([1e16 * jnp.sin(y) + p, x * 0.0, y]), jnp.stack(
            [1e16 * jnp.sin(y) + p, jnp.sin(x), y]
        )

    assert judged(f) == [True, False, True]


def sleigh(kind, metre, kilogram, second):
    """A sleigh with a row nonlinear in the speeds or not, a drive and a load, in any units: one metre,
    kilogram and second are given in those of the scene.
    """
    speed = metre / second

    class Sleigh(jj.Scene):
        coordinates = jj.coordinates("x y heading")
        domain = {"x": (-metre, metre), "y": (-metre, metre), "heading_rate": (-1.0 / second, 1.0 / second)}
        domain |= {"x_rate": (-speed, speed), "y_rate": (-speed, speed)}

        def bodies(self, t, q):
            ahead, inertia = 0.1 * metre * jj.rot_z(q.heading)[:, 0], 0.05 * kilogram * metre**2 * jnp.ones(3)
            at = jnp.stack([q.x, q.y, 0.0]) + ahead
            return {"sleigh": jj.RigidBody(2.0 * kilogram, inertia, at, jj.rot_z(q.heading))}

        def velocity_constraints(self, motion):
            u, sideways = motion.u, jj.rot_z(motion.q.heading)[:2, 1]
            turned = 1e-2 * u.heading_rate**2 * second**2 * speed
            drift = {"affine": 1e-3 * speed, "homogeneous": 0.0, "nonlinear": turned}
            return {"edge": sideways @ u.array[:2] + drift[kind]}

        def loads(self, motion):
            torque = 0.1 * kilogram * speed**2 * jnp.sin(motion.q.heading)
            return jj.generalized_force(motion, heading_rate=torque)

    return Sleigh()


# m kg s; mm t s; nm kg s; km t h
UNITS = [(1.0, 1.0, 1.0), (1e3, 1e-3, 1.0), (1e9, 1.0, 1.0), (1e-3, 1e-3, 1 / 3600)]


@pytest.mark.parametrize("kind", ["affine", "homogeneous", "nonlinear"])
def test_units_decide_nothing(kind):
    said = set()
    for units in UNITS:
        scene = sleigh(kind, *units)
        found = jj.structure_of(scene)
        assert (found.affine, found.homogeneous) == (kind != "nonlinear", kind != "affine")
        said.add((found.rank, found.independent, found.redundant_rows, jj.lower(scene).held))
    assert len(said) == 1, said
