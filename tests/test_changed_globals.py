"""A change of what a scene's methods read is noticed by everything that keeps something: the motion is that of the present numbers."""

import copy
import dataclasses
import pickle
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj

GAIN, FACTORS, SETTINGS, ARRAY, CALLS = 1.0, [1.0, 1.0], {"inner": {"gain": 1.0}}, np.ones(3), []
LARGE = np.ones(5000)
PLAIN = types.SimpleNamespace(gain=1.0)
OWN_MODULE = types.ModuleType("own_module")
OWN_MODULE.GAIN = 1.0


class Settings:
    gain = 1.0


class Instance:
    def __init__(self):
        self.gain = 1.0


INSTANCE = Instance()


@dataclasses.dataclass(slots=True)
class Slotted:
    gain: float = 1.0


class Answering:
    def __getattr__(self, name):
        return {"gain": SLOTTED.gain}[name]  # a KeyError for anything else


SLOTTED, ANSWERING = Slotted(), Answering()


def helper(x):
    return deeper(x)


def deeper(x):
    return GAIN * x


@jax.jit
def compiled(x):
    return 1.0 * x


def closed_over(gain=1.0):
    def law(x):
        return gain * x

    def put(value):
        nonlocal gain
        gain = value

    return law, put


LAW, PUT = closed_over()


def with_default(x, gain=1.0):
    return gain * x


with_default.factor = 1.0


class Spring(jj.Scene):
    """A mass of 1 kg on a spring, whose stiffness is 1 N/m times whatever `stiffness` reads."""

    coordinates = jj.coordinates("x")
    factor = 1.0
    numbers = (1.0, [1.0])
    mass: jax.Array = jj.parameter(1.0)

    def bodies(self, t, q):
        return {"mass": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        CALLS.append(1)  # what is only added to is not read
        return (self.force(motion.q.x),)

    def force(self, x):
        k = self.factor * self.numbers[1][0] * FACTORS[1] * SETTINGS["inner"]["gain"] * ARRAY[2] * LARGE[777] * PLAIN.gain * OWN_MODULE.GAIN
        return jj.Load(
            generalized={"x_rate": -k * Settings.gain * INSTANCE.gain * ANSWERING.gain * with_default.factor * with_default(LAW(helper(compiled(x))))}
        )


SCENE = Spring()


def after_a_second(scene=SCENE, **options) -> float:
    """x(1) = cos(sqrt k) for a start at x = 1."""
    return float(jj.simulate(scene, {"x": 1.0}, t1=1.0, **options).q_end[0])


class Undone(pytest.MonkeyPatch):
    """Entries of lists and arrays, too."""

    def setentry(self, x, i, value):
        self.setattr(self, "put_back", [*getattr(self, "put_back", []), (x, i, x[i])], raising=False)
        x[i] = value

    def undo(self):
        for x, i, old in getattr(self, "put_back", []):
            x[i] = old
        super().undo()


@pytest.fixture
def changed():
    undone = Undone()
    yield undone
    undone.undo()


CHANGES = {
    "a global that a helper's helper reads": lambda m: m.setitem(globals(), "GAIN", 4.0),
    "a function that is called": lambda m: m.setitem(globals(), "deeper", lambda x: 4.0 * x),
    "a compiled function": lambda m: m.setitem(globals(), "compiled", jax.jit(lambda x: 4.0 * x)),
    "a list": lambda m: m.setentry(FACTORS, 1, 4.0),
    "a dictionary in a dictionary": lambda m: m.setitem(SETTINGS["inner"], "gain", 4.0),
    "an array": lambda m: m.setentry(ARRAY, 2, 4.0),
    "a large array": lambda m: m.setentry(LARGE, 777, 4.0),
    "a namespace": lambda m: m.setattr(PLAIN, "gain", 4.0),
    "a module of the user's": lambda m: m.setattr(OWN_MODULE, "GAIN", 4.0),
    "a class": lambda m: m.setattr(Settings, "gain", 4.0),
    "an object": lambda m: m.setattr(INSTANCE, "gain", 4.0),
    "an object with slots": lambda m: m.setattr(SLOTTED, "gain", 4.0),
    "an attribute of a function": lambda m: m.setattr(with_default, "factor", 4.0),
    "an attribute of the scene's class": lambda m: m.setattr(Spring, "factor", 4.0),
    "a list in an attribute": lambda m: m.setentry(Spring.numbers[1], 0, 4.0),
    "a method": lambda m: m.setattr(Spring, "loads", lambda self, motion: jj.Load(generalized={"x_rate": -4.0 * motion.q.x})),
    "a helper method": lambda m: m.setattr(Spring, "force", lambda self, x: jj.Load(generalized={"x_rate": -4.0 * x})),
    "a default argument": lambda m: m.setattr(with_default, "__defaults__", (4.0,)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_an_acceleration_is_that_of_what_the_methods_read_now(change, changed):
    def acceleration():
        return float(jj.accelerations(SCENE, 0.0, jnp.ones(1), jnp.zeros(1)).udot[0])

    assert acceleration() == pytest.approx(-1.0)
    CHANGES[change](changed)
    assert acceleration() == pytest.approx(-4.0)
    changed.undo()
    assert acceleration() == pytest.approx(-1.0)


def test_a_variable_of_an_enclosing_function_counts():
    before = after_a_second()
    PUT(4.0)
    after = after_a_second()
    PUT(1.0)
    assert [before, after, after_a_second()] == pytest.approx([np.cos(1.0), np.cos(2.0), np.cos(1.0)], abs=1e-6)


@eqx.filter_jit
def compiled_by_the_user(scene):
    return jj.simulate(scene, {"x": 1.0}, t1=1.0).q_end[0]


USES = {
    "simulate": after_a_second,
    "simulate without lowering": lambda: after_a_second(backend="dense"),
    "simulate with the full state": lambda: after_a_second(formulation=jj.Formulation("full")),
    "rollout": lambda: jj.rollout(SCENE, {"x": jnp.ones(2)}, t1=1.0).lanes.q_end[0, 0],
    "a function compiled by the user": lambda: compiled_by_the_user(SCENE),
    "a gradient": lambda: jax.grad(lambda x: jj.simulate(SCENE, {"x": x}, t1=1.0).q_end[0])(1.0),
    "linearize": lambda: np.cos(np.max(np.imag(jj.linearize(SCENE, {"x": 0.0}).eigenvalues()))),
    "the lowered program": lambda: np.cos(np.sqrt(-_lowered_rate())),
    "accelerations": lambda: _invariant(),
}


def _lowered_rate() -> float:
    program = jj.lower(SCENE)
    return float(program.rates(program.fixed_values(SCENE), 0.0, (1.0,), (0.0,), jnp.zeros(0))[1][0])


def _invariant() -> float:
    """cos(sqrt k) by the power of the load at x = 1, u = 1."""
    return float(np.cos(np.sqrt(-float(jj.accelerations(SCENE, 0.0, jnp.ones(1), jnp.ones(1)).udot[0]))))


@pytest.mark.parametrize("use", USES)
def test_every_use_notices_the_change(use, changed):
    assert float(USES[use]()) == pytest.approx(np.cos(1.0), abs=1e-6)
    changed.setitem(globals(), "GAIN", 4.0)
    assert float(USES[use]()) == pytest.approx(np.cos(2.0), abs=1e-6)
    changed.undo()
    assert float(USES[use]()) == pytest.approx(np.cos(1.0), abs=1e-6)


def push(t):
    return GAIN * jnp.cos(t)


class Pushed(Spring):
    """Held functions and inputs read globals as well."""

    inputs = jj.inputs("push")
    law: object = eqx.field(static=True, default=helper)
    held: object = helper

    def loads(self, motion):
        return jj.Load(generalized={"x_rate": motion.inputs.push + 0.0 * self.law(motion.q.x) - 0.0 * self.held(motion.q.x)})


def test_inputs_and_functions_in_fields_count(changed):
    scene = Pushed()

    def end():
        return float(jj.simulate(scene, {"x": 0.0}, t1=1.0, inputs={"push": push}).q_end[0])

    assert end() == pytest.approx(1.0 - np.cos(1.0), abs=1e-6)
    structures = [jax.tree.structure(scene)]
    changed.setitem(globals(), "GAIN", 4.0)
    assert end() == pytest.approx(4.0 * (1.0 - np.cos(1.0)), abs=1e-6)
    assert jax.tree.structure(scene) not in structures


def test_nothing_is_made_anew_where_nothing_has_changed(changed):
    after_a_second()
    before, structure = len(CALLS), jax.tree.structure(SCENE)
    changed.setitem(globals(), "GAIN", float("1.0"))  # another object of one value
    changed.setentry(FACTORS, 1, float("1.0"))
    after_a_second()
    assert len(CALLS) == before
    assert jax.tree.structure(Spring()) == structure


def test_an_unread_global_is_no_part_of_the_scene(changed):
    structure = jax.tree.structure(SCENE)
    changed.setitem(globals(), "x", 1.0)  # named like an attribute that methods read
    assert jax.tree.structure(SCENE) == structure


def test_scenes_are_copied_and_stored():
    for other in (copy.deepcopy(SCENE), pickle.loads(pickle.dumps(SCENE))):
        assert jax.tree.structure(other) == jax.tree.structure(SCENE)
    assert jax.tree.structure(SCENE.replace(mass=2.0)) == jax.tree.structure(SCENE)


def test_a_method_replaced_on_a_class_that_was_made_by_type_counts():
    made = type("Made", (Spring,), {})()  # its module is the one of the metaclass

    def acceleration():
        return float(jj.accelerations(made, 0.0, jnp.ones(1), jnp.zeros(1)).udot[0])

    before = acceleration()
    type(made).loads = lambda self, motion: jj.Load(generalized={"x_rate": -4.0 * motion.q.x})
    assert [before, acceleration()] == pytest.approx([-1.0, -4.0])


@pytest.mark.parametrize("transformed", [jax.grad, jax.jit])
def test_a_method_that_reads_what_jax_is_tracing_is_refused_with_its_name(transformed):
    def end(stiffness):
        class Sprung(jj.Scene):
            coordinates = jj.coordinates("x")

            def bodies(self, t, q):
                return {"mass": jj.Particle(1.0, jnp.stack([q.x, 0.0, 0.0]))}

            def potential(self, pose):
                return 0.5 * stiffness * pose.q.x**2

        return jj.simulate(Sprung(), {"x": 1.0}, t1=0.1).q_end[0]

    with pytest.raises(ValueError, match="`Sprung` reads `stiffness`, which JAX is tracing"):
        transformed(end)(2.0)
