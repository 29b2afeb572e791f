"""Methods are traced once: what they read is refused where it has state, noticed where it is bound anew, and
a constant where it is a class or a module.
"""

import copy
import functools
import gc
import pickle
import weakref

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from small_scenes import OnLine

import jourdain_jax as jj

GAIN = 1.0
IMPORTS = """
import argparse, array, collections, contextvars, dataclasses, enum, fractions, functools, itertools, random
import types
"""
SPRING = """
class Spring(jj.Scene):
    coordinates = jj.coordinates("x")
    mass: object = jj.parameter(1.0)

    def bodies(self, t, q):
        return {{"mass": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}}

    def loads(self, motion):
        {before}
        return (jj.generalized_force(motion, x_rate=-({read}) * motion.q.x),)
"""
WRAPPER = (
    "class Own:\n    def __init__(self, f): functools.update_wrapper(self, f).k = 1.0\n    def"
    " __call__(self): return self.k\n"
)


def cell(text, read, before="pass"):
    """What a cell of a notebook defines, and a spring below it whose stiffness in N/m is what it reads;
    `before`: a line of the method before that.
    """
    names = {"jj": jj, "jnp": jnp, "np": np, "__name__": "__main__"}
    exec(IMPORTS + text, names)
    exec(SPRING.format(read=read, before=before), names)
    return names


def stiffness(scene, way):
    """By the acceleration at x = 1 m, or the motion to 1 s, in N/m."""
    if way == "accelerations":
        return -float(jj.accelerations(scene, 0.0, jnp.ones(1), jnp.zeros(1)).udot[0])
    if way == "rollout":
        end = jj.rollout(scene, {"x": jnp.ones(2)}, t1=1.0).lanes.q_end[0, 0]
    elif way == "jit":
        end = compiled_by_the_user(scene)
    else:
        end = jj.simulate(scene, {"x": 1.0}, t1=1.0).q_end[0]
    return float(np.arccos(float(end))) ** 2


@eqx.filter_jit
def compiled_by_the_user(scene):
    return jj.simulate(scene, {"x": 1.0}, t1=1.0).q_end[0]


NOTICED = {
    "a number": ("k = 1.0", "k", "k = 4.0"),
    "a number of another type": ("k = True", "jnp.where(isinstance(k, bool), 1.0, 4.0)", "k = 1"),
    "a number of NumPy": ("k = np.float32(1)", "k", "k = np.float32(4)"),
    "a tuple": ("k = (1.0, (2.0, 'a'))", "k[0]", "k = (4.0, (2.0, 'a'))"),
    "a named tuple": (
        "Two = collections.namedtuple('Two', 'a b')\nk = Two(1.0, 2.0)",
        "k.a",
        "k = Two(4.0, 2.0)",
    ),
    "a text": ("k = 'soft'", "{'soft': 1.0, 'stiff': 4.0}[k]", "k = 'stiff'"),
    "a function of JAX": ("law = jnp.add", "law(0.5, 0.5)", "law = lambda a, b: 4.0"),
    "a slice": ("k = slice(0, 1)", "jnp.array([1.0, 4.0])[k][0]", "k = slice(1, 2)"),
    "a fraction": ("k = fractions.Fraction(1)", "float(k)", "k = fractions.Fraction(4)"),
    "a dtype": ("k = np.dtype(np.int64)", "1.0 if k == np.int64 else 4.0", "k = np.dtype(np.float32)"),
    "a function that remembers": (
        "law = functools.lru_cache(lambda x: 1.0)",
        "law(1)",
        "law = functools.lru_cache(lambda x: 4.0)",
    ),
    "a function": ("def law(): return 1.0", "law()", "def law(): return 4.0"),
    "other code in a function": (
        "def law(): return 1.0\ndef other(): return 4.0",
        "law()",
        "law.__code__ = other.__code__",
    ),
    "a compiled function": (
        "import jax\nlaw = jax.jit(lambda x: 1.0 * x)",
        "law(1.0)",
        "law = jax.jit(lambda x: 4.0 * x)",
    ),
    "a partial function": (
        "law = functools.partial(pow, 1.0)",
        "law(2)",
        "law = functools.partial(pow, 2.0)",
    ),
    "a class": ("class Law:\n    k = 1.0", "Law.k", "class Law:\n    k = 4.0"),
    "a module": (
        "law = types.ModuleType('law')\nlaw.k = 1.0",
        "law.k",
        "law = types.ModuleType('law')\nlaw.k = 4.0",
    ),
    "a function inside the method": ("k = 1.0", "(lambda: k)()", "k = 4.0"),
    "a name defined below": ("", "k", "k = 4.0"),
    "a replaced method": (
        "",
        "1.0",
        "Spring.loads = lambda self, motion: (jj.generalized_force(motion, x_rate=-4.0 * motion.q.x),)",
    ),
    "an attribute of the scene's class": ("", "Spring.k if hasattr(Spring, 'k') else 1.0", "Spring.k = 4.0"),
}


@pytest.mark.parametrize("kind", NOTICED)
def test_what_is_bound_anew_is_noticed(kind):
    """By the structure of the scene, under which all that was traced of it is kept."""
    before, read, after = NOTICED[kind]
    names = cell(before or "k = 1.0", read)
    scene = names["Spring"]()
    structure = jax.tree.structure(scene)
    exec(after, names)
    changed = jax.tree.structure(scene)
    assert changed != structure
    if before and not before.startswith(("class", "import", "law")):
        exec(before, names)
        assert jax.tree.structure(scene) != changed


@pytest.mark.parametrize("way", ["simulate", "rollout", "jit", "model"])
def test_every_use_notices_a_number_that_is_bound_anew(way):
    names = cell("k = 1.0", "k")
    scene = (jj.build if way == "model" else jj.Scene.replace)(names["Spring"]())
    assert stiffness(scene, way) == pytest.approx(1.0, abs=1e-6)
    exec("k = 4.0", names)
    assert stiffness(scene, way) == pytest.approx(4.0, abs=1e-6)


HAS_STATE = {
    "list": "k = [1.0]",
    "list in a tuple": "k = ([1.0],)",
    "a subclass of list": "class Own(list): pass\nk = Own([1.0])",
    "a subclass of float": "class Own(float): pass\nk = Own(1.0)",
    "dictionary": "k = {'a': 1.0}",
    "set": "k = {1.0}",
    "deque": "k = collections.deque([1.0])",
    "UserDict": "k = collections.UserDict(a=1.0)",
    "array.array": "k = array.array('d', [1.0])",
    "bytearray": "k = bytearray(3)",
    "array of NumPy": "k = np.ones(3)",
    "array of one number": "k = np.array(1.0)",
    "array of objects": "k = np.array([1.0, None])",
    "record of NumPy": "k = np.zeros(1, [('a', float)])[0]",
    "array of JAX": "k = jnp.ones(3)",
    "Namespace of argparse": "k = argparse.Namespace(a=1.0)",
    "ContextVar": "k = contextvars.ContextVar('k', default=1.0)",
    "dataclass": "@dataclasses.dataclass\nclass Two:\n    a: float = 1.0\nk = Two()",
    "frozen dataclass": "@dataclasses.dataclass(frozen=True)\nclass Two:\n    a: float = 1.0\nk = Two()",
    "member of an enumeration": "k = enum.Enum('Kind', 'soft').soft",
    "member of an enumeration of numbers": "k = enum.IntEnum('Kind', 'soft').soft",
    "subclass of a tuple": "class Own(tuple): pass\nk = Own((1.0,))",
    "subclass of a number": "class Own(np.float64): pass\nk = Own(1.0)",
    "wrapped function with a number": WRAPPER + "k = Own(lambda: 1.0)",
    "wrapped method with a number": (
        WRAPPER + "class Other:\n    @Own\n    def law(self): return 1.0\nk = Other.law"
    ),
    "object": "class Own: pass\nk = Own()",
    "object with slots": "class Own:\n    __slots__ = ('a',)\nk = Own()",
    "object that can be called": "class Own:\n    def __call__(self): return 1.0\nk = Own()",
    "method of an object": "class Own:\n    def law(self): return 1.0\nk = Own().law",
    "partial function of a list": "k = functools.partial(sum, [1.0])",
    "generator": "k = itertools.count()",
    "random numbers": "k = random.Random(1)",
    "scene": "k = jj.models.VerticalDisc()",
}


@pytest.mark.parametrize("kind", HAS_STATE)
def test_what_has_state_is_refused_by_name_when_the_class_is_made(kind):
    refused(
        r"`Spring.loads` reads `k`, .*make it a field", cell, HAS_STATE[kind], "1.0 if k is None else 1.0"
    )


def test_a_cached_method_is_refused_by_name_when_the_class_is_made():
    with pytest.raises(ValueError, match=r"`Cached.bodies` is cached by functools.*remove the decorator"):

        class Cached(jj.models.VerticalDisc):
            bodies = functools.lru_cache(jj.models.VerticalDisc.bodies)


def test_methods_of_the_class_and_of_those_it_is_derived_from_count():
    names = cell("k = 1.0", "k")
    exec(
        "class Law:\n    def law(self, motion): return jj.generalized_force(motion, x_rate=-more *"
        " motion.q.x)",
        names,
    )
    exec(
        "class Stiffer(Spring, Law):\n    def loads(self, motion): return (*super().loads(motion),"
        " self.law(motion))",
        names,
    )
    scene, names["more"] = names["Stiffer"](), 2.0
    assert stiffness(scene, "accelerations") == pytest.approx(3.0)
    names["more"] = 4.0
    assert stiffness(scene, "accelerations") == pytest.approx(5.0)
    names["k"] = 2.0
    assert stiffness(scene, "accelerations") == pytest.approx(6.0)


def test_an_object_that_takes_the_place_of_a_number_is_refused_at_the_next_call():
    names = cell("k = 1.0", "k")
    scene = names["Spring"]()
    assert stiffness(scene, "accelerations") == 1.0
    names["k"] = [1.0]
    for _ in range(2):
        refused(r"`Spring.loads` reads `k`, an object \(list\)", stiffness, scene, "accelerations")
    names["k"] = 4.0
    assert stiffness(scene, "accelerations") == pytest.approx(4.0)


OWN_MODULE = "import sys\nsys.modules['own_constants'] = own = types.ModuleType('own')\nown.k = 1.0"
CONSTANTS = {
    "an attribute of a module": (
        "pkg = types.ModuleType('pkg')\npkg.k = 1.0",
        "pkg.k",
        "pass",
        "pkg.k = 4.0",
    ),
    "an attribute of a class": ("class Law:\n    k = 1.0", "Law.k", "pass", "Law.k = 4.0"),
    "what a helper reads": ("k = 1.0\ndef law(): return k", "law()", "pass", "k = 4.0"),
    "a name imported in the method": (OWN_MODULE, "k", "from own_constants import k", "own.k = 4.0"),
}


def test_what_is_a_constant_is_read_anew_after_the_caches_are_cleared():
    cells = {kind: cell(before, read, line) for kind, (before, read, line, _) in CONSTANTS.items()}
    scenes = {kind: names["Spring"]() for kind, names in cells.items()}

    def found():
        return {kind: stiffness(scene, "accelerations") for kind, scene in scenes.items()}

    assert found() == dict.fromkeys(CONSTANTS, 1.0)
    for kind, (*_, after) in CONSTANTS.items():
        exec(after, cells[kind])
    assert found() == dict.fromkeys(CONSTANTS, 1.0)
    jj.clear_caches()
    assert found() == dict.fromkeys(CONSTANTS, 4.0)
    assert stiffness(scenes["what a helper reads"], "simulate") == pytest.approx(4.0, abs=1e-6)


def test_cleared_caches_hold_no_scene():
    names = cell("k = 1.0", "k")
    scene = names["Spring"](mass=jnp.asarray(1.25))
    stiffness(scene, "accelerations")
    stiffness(scene, "simulate")
    kept = weakref.ref(scene.mass)
    del scene
    assert kept() is not None
    jj.clear_caches()
    gc.collect()
    assert kept() is None


def spring_around(gain):
    """A spring whose stiffness is a variable of this function, and what sets it."""

    class Around(OnLine):
        def loads(self, motion):
            return jj.generalized_force(motion, x_rate=-gain * motion.q.x)

    def put(value):
        nonlocal gain
        gain = value

    return Around, put


def test_a_variable_of_an_enclosing_function_counts():
    kind, put = spring_around(1.0)
    scene = kind()
    assert stiffness(scene, "simulate") == pytest.approx(1.0, abs=1e-6)
    put(4.0)
    assert stiffness(scene, "simulate") == pytest.approx(4.0, abs=1e-6)
    refused(r"`Around\.loads` reads `gain`", spring_around, np.ones(1))


@pytest.mark.parametrize("transformed", [jax.grad, jax.jit])
def test_a_method_that_reads_what_jax_is_tracing_is_refused_with_its_name(transformed):
    def end(stiffness):
        return jj.simulate(spring_around(stiffness)[0](), {"x": 1.0}, t1=0.1).q_end[0]

    refused(r"`Around\.loads` reads `gain`, which JAX is tracing", lambda: transformed(end)(2.0))


def law(x):
    return GAIN * x


class Pushed(OnLine):
    """Functions in fields and inputs read names as well."""

    inputs = jj.inputs("push")
    static: object = eqx.field(static=True, default=law)
    held: object = law

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=motion.inputs.push + self.static(motion.q.x) - self.held(motion.q.x)
        )


def test_functions_in_fields_and_inputs_count(monkeypatch):
    scene, table = Pushed(), np.array([1.0, 1.0])

    def end(push):
        return float(jj.simulate(scene, {"x": 0.0}, t1=1.0, inputs={"push": push}).q_end[0])

    by_name, by_table = (lambda t: GAIN * jnp.cos(t)), (lambda t: table[0] * jnp.cos(t))
    for gain in (1.0, 4.0, 1.0):  # what an input reads may have state: it is traced in each call
        monkeypatch.setitem(globals(), "GAIN", gain)
        table[0] = gain
        for push in (by_name, by_table, by_name, by_table):
            assert end(push) == pytest.approx(gain * (1.0 - np.cos(1.0)), abs=1e-6)
    structure = jax.tree.structure(scene)
    monkeypatch.setitem(globals(), "GAIN", 4.0)
    assert jax.tree.structure(scene) != structure
    assert np.isfinite(end(by_name))
    assert (
        Pushed(held=lambda x: table[0] * x) is not None
    )  # of a function in a field, what has state is a constant


def test_nothing_is_traced_anew_where_nothing_has_changed():
    names = cell(
        "k, calls = 1.0, 0\nseen = []\ndef note(): seen.append(1)", "k", "global calls; calls += 1; note()"
    )
    scene = names["Spring"]()
    for way in ("accelerations", "simulate"):
        stiffness(scene, way)
    count, structure = len(names["seen"]), jax.tree.structure(scene)
    names["k"] = float("1.0")  # another object of one value
    names["mass"] = 4.0  # a global that is named like an attribute
    for way in ("accelerations", "simulate"):
        stiffness(scene, way)
    assert len(names["seen"]) == count > 0
    assert jax.tree.structure(names["Spring"]()) == structure


def test_scenes_are_copied_and_stored():
    scene = Pushed()
    for other in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert jax.tree.structure(other) == jax.tree.structure(scene)
    disc = jj.models.VerticalDisc()
    assert jax.tree.structure(disc.replace(mass=2.0)) == jax.tree.structure(disc)
