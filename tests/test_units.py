"""Quantities with units are no numbers: as numbers they would lose their unit, and 1,300 g would become 1,300
kg.
"""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import OnLine

import jourdain_jax as jj


class Quantity:
    """As the quantities of pint: it converts to a float and to an array, and computes with numbers."""

    def __init__(self, magnitude, units="g"):
        self._magnitude, self._units = magnitude, units

    magnitude = property(lambda self: self._magnitude)
    units = property(lambda self: self._units)
    shape = property(lambda self: np.shape(self._magnitude))
    ndim = property(lambda self: np.ndim(self._magnitude))
    dtype = property(lambda self: np.asarray(self._magnitude).dtype)

    def __float__(self):
        return float(self._magnitude)

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self._magnitude, dtype)

    def __len__(self):
        return len(self._magnitude)

    def __getitem__(self, i):
        return Quantity(self._magnitude[i], self._units)

    def __mul__(self, other):
        return Quantity(self._magnitude * other, self._units)

    __rmul__ = __mul__

    def __gt__(self, other):
        return self._magnitude > getattr(other, "_magnitude", other)

    def __lt__(self, other):
        return self._magnitude < getattr(other, "_magnitude", other)


class ArrayWithUnit(np.ndarray):
    """As the quantities of astropy and unyt: arrays of a class of their own."""

    unit = "g"


class Tagged(float):
    """A float that says its unit."""

    def __new__(cls, value):
        new = super().__new__(cls, value)
        new.units = "g"
        return new


KINDS = {
    "pint": Quantity,
    "astropy": lambda x: np.asarray(x, float).view(ArrayWithUnit),
    "a float": lambda x: Tagged(x) if np.ndim(x) == 0 else [*map(Tagged, x)],
}


class Cart(OnLine):
    inputs = jj.inputs("push")
    mass: jax.Array = jj.parameter(1.0, unit="kg")

    def loads(self, motion):
        return jj.Load(generalized={"x_rate": motion.inputs.push})


CART, TS = Cart(), np.linspace(0.0, 1.0, 5)


def moved(start=None, **options):
    return jj.simulate(CART, {"x": 0.0} if start is None else start, **{"t1": 1.0, **options})


def with_attributes(**attributes):
    return types.new_class("Other", (Cart,), exec_body=lambda space: space.update(attributes))()


WAYS = [
    "Cart(mass=q(1300.0))",
    "CART.replace(mass=q(1300.0))",
    "Cart(mass=q(np.ones(2)))",
    'moved({"x": q(1.0)})',
    "jj.start(CART, x=q(1.0))",
    "moved(t1=q(1.0))",
    "moved(t0=q(0.0))",
    "moved(ts=q(TS))",
    "moved(ts=[q(0.0), q(1.0)])",
    "moved(rtol=q(1e-6))",
    "moved(max_step=q(0.1))",
    'moved(inputs={"push": q(1.0)})',
    "jj.Sampled(TS, q(TS))",
    "jj.Sampled(q(TS), TS)",
    "jj.Spline(TS, q(TS))",
    'jj.rollout(CART, {"x": q(np.ones(2))}, t1=1.0)',
    'jj.rollout(CART, {"x": 0.0}, t1=1.0, parameters={"mass": q(np.ones(2))})',
    "jj.accelerations(CART, 0.0, q(np.ones(1)), np.zeros(1))",
    "jj.accelerations(CART, 0.0, np.zeros(1), q(np.ones(1)))",
    "jj.accelerations(CART, q(0.0), np.zeros(1), np.zeros(1))",
    'jj.linearize(CART, {"x": q(0.0)})',
    'jj.steady(CART, {"x": 0.0}, t0=q(0.0))',
    'jj.periodic(CART, {"x": 0.0}, q(1.0))',
    'jj.periodic(CART, {"x": 0.0}, 1.0, shift={"x": q(1.0)})',
    "jj.equations.generalized_forces(CART, 0.0, np.zeros(1), np.zeros(1), q(np.ones(1)))",
    "jj.newton_residual(CART, 0.0, np.zeros(1), np.zeros(1), q(np.ones(1)))",
    "jj.Particle(q(1.0), jnp.zeros(3))",
    "jj.Particle(1.0, [q(0.0), 0.0, 0.0])",
    'jj.Load(generalized={"x_rate": q(1.0)})',
    'with_attributes(domain={"x": (q(0.0), q(1.0))})',
    'jj.Experiment(TS, {"x": q(TS)}, 0.1, start={"x": 0.0})',
    'jj.Experiment(q(TS), {"x": TS}, 0.1, start={"x": 0.0})',
    'jj.Experiment(TS, {"x": TS}, q(0.1), start={"x": 0.0})',
    'jj.Experiment(TS, {"x": TS}, 0.1, start={"x": q(0.0)})',
    'jj.identification.Sensor("x", delay=q(1.0))',
    "jj.bounds(q(0.0), q(1.0))",
    "jj.studies.Uniform(q(0.0), q(1.0))",
    'jj.Study(CART, start={"x": q(1.0), "x_rate": jj.studies.Uniform(0.0, 1.0)}, samples=2)',
    'jj.Study(CART, start={"x": q(TS), "x_rate": 0.0})',
]


# the second of a domain; the third of the checker of types that watches the tests
MESSAGES = "with a unit|two finite numbers|typechecking parameter"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", WAYS)
def test_a_quantity_with_a_unit_is_refused(way, kind):
    with pytest.raises((ValueError, TypeError), match=MESSAGES):
        eval(way, globals() | {"q": KINDS[kind]})


def test_a_quantity_is_refused_inside_of_jit_and_grad():
    for transformed in (jax.jit, jax.grad):
        with pytest.raises(ValueError, match="`x` is a quantity with a unit"):
            transformed(lambda mass: jj.simulate(Cart(mass=mass), {"x": Quantity(1.0)}, t1=1.0).q_end[0])(1.0)


PLAIN = {
    "an int": 2,
    "a float": 2.0,
    "a scalar of NumPy": np.float32(2.0),
    "an array": np.array(2.0),
    "an array of JAX": jnp.array(2.0),
    "an array of another class": np.ma.masked_array(2.0),
}


@pytest.mark.parametrize("number", PLAIN.values(), ids=PLAIN)
def test_plain_numbers_are_taken(number):
    assert float(Cart(mass=number).mass) == 2.0
    assert moved({"x": number}, t1=number).q_end[0] == pytest.approx(2.0)
