"""Everything public says what it is: names of arguments, and units where a number has one."""

import inspect
import re
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import jourdain_jax as jj
from jourdain_jax import Contact
from jourdain_jax.analysis.verification import Check
from jourdain_jax.dynamics.reactions import ContactForce, RowReactions
from jourdain_jax.motion.trajectories.diagnostics import Diagnostics, Energies
from jourdain_jax.scene import description
from jourdain_jax.scene.coordinates import Coordinates, Named, Names
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose, Motion, Point, Pose

# what a user is handed without having imported it
HANDED_OUT = (
    Check,
    ContactForce,
    RowReactions,
    Diagnostics,
    Energies,
    Contact,
    Coordinates,
    Names,
    Named,
    BodyMotion,
    BodyPose,
    Motion,
)
HANDED_OUT += (Point, Pose)
SPACES = (jj, jj.identification, jj.studies, jj.equations, jj.analysis)
PUBLIC = {
    name: getattr(space, name)
    for space in SPACES
    for name in space.__all__
    if not inspect.ismodule(getattr(space, name))
}
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(value)}
CLASSES = {value.__name__: value for value in (*PUBLIC.values(), *HANDED_OUT) if inspect.isclass(value)}
SELF_EVIDENT = {"self", "scene", "t", "q", "u"}
# functions of a state or of numbers with a unit: their text must state one
# as `(m)`, `(N m, inertial frame)`, `(s; default: 0)`, as `in N/m`, or as a unit that is no word or symbol of
# another kind
UNIT = r"(?:kg|rad|[mNJWs])(?:[ /](?:kg|rad|[mNJWs])\b|\^\d)*"
UNITS = re.compile(
    rf"(?<!\w)\({UNIT}[,;)]|\bin {UNIT}(?=[\s,.;:)]|$)|(?<![\w'])(?:(?:rad|m|N|kg)/(?:s|m|rad)\b|N m\b|N"
    r" s/m\b|kg m\^2)"
)
WITH_UNITS = """
rot_x rod knife_edge spring damper gravity torque point_force generalized_force fixed_point disc_contact
ball_contact start simulate kinetic_energy potential_energy virtual_power newton_residual generalized_forces
unconstrained_equations energy pose_at
"""
# functions that implement an equation of the paper say which
WITH_SOURCE = """
accelerations gibbs_function gibbs_equations lagrange_equations virtual_power newton_residual
generalized_forces unconstrained_equations partial_velocities constraint_rows velocity_residual
position_residual structure_of
"""


def _methods(owner):
    """Public methods and properties that a class of the package defines, by name."""
    for name in dir(owner):
        value = inspect.getattr_static(owner, name)
        home = next((base for base in owner.__mro__ if name in vars(base)), object)
        if name.startswith("_") or not home.__module__.startswith("jourdain_jax"):
            continue
        if isinstance(value, property):
            yield name, value.fget
        elif callable(value) or isinstance(value, staticmethod | classmethod):
            yield name, getattr(owner, name)


def _unsaid(function):
    """Parameters that a docstring does not name."""
    text = inspect.getdoc(function) or ""
    return [
        name
        for name in inspect.signature(function).parameters
        if name not in SELF_EVIDENT and not re.search(rf"\b{name}\b", text)
    ]


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_public_function_says_what_its_arguments_are(name):
    assert inspect.getdoc(FUNCTIONS[name]), f"`{name}` has no docstring"
    assert _unsaid(FUNCTIONS[name]) == []


@pytest.mark.parametrize("name", sorted(CLASSES))
def test_a_public_class_and_its_methods_say_what_they_are(name):
    own = vars(CLASSES[name]).get("__doc__")
    assert own, f"`{name}` has no docstring"
    assert not own.startswith(f"{name}("), f"`{name}` has only the docstring that its decorator made"
    for method, function in _methods(CLASSES[name]):
        assert inspect.getdoc(function), f"`{name}.{method}` has no docstring"
        assert _unsaid(function) == [], f"{name}.{method}"


@pytest.mark.parametrize("name", WITH_UNITS.split())
def test_what_takes_or_gives_a_quantity_states_its_unit(name):
    assert UNITS.search(inspect.getdoc(FUNCTIONS[name]))


@pytest.mark.parametrize(
    "text",
    [
        "The scene's row(s) of M, `m g e` at a time t.",
        "The rows in speeds; s, m and N.",
        "`strength`: g, in some way.",
    ],
)
def test_a_docstring_without_a_unit_would_be_seen(text):
    assert not UNITS.search(text)


@pytest.mark.parametrize(
    "text",
    [
        "A length (m).",
        "A torque (3,) (N m, here)",
        "c in N s/m.",
        "T in J",
        "g in m/s^2; e",
        "(kg m^2)",
        "t (s; default: 0)",
    ],
)
def test_a_unit_is_seen_as_one(text):
    assert UNITS.search(text)


@pytest.mark.parametrize("name", WITH_SOURCE.split())
def test_what_implements_an_equation_of_the_paper_says_which(name):
    assert re.search(r"\(\d+\)", inspect.getdoc(FUNCTIONS[name]))


def test_an_undocumented_argument_would_be_seen():
    def wanting(scene, t, stiffness):
        """A function of a `scene`."""

    assert _unsaid(wanting) == ["stiffness"]


@pytest.mark.parametrize(
    ("folders", "words"), [(("src", "bench", "tests"), "The same"), (("src",), "Of|By|With|From")]
)
def test_no_docstring_leaves_its_subject_to_the_name_or_the_docstring_above(folders, words):
    root = Path(__file__).parents[1]
    begins = re.compile('""' + f'"(?:{words}) ')
    assert [
        str(path)
        for folder in folders
        for path in (root / folder).rglob("*.py")
        if begins.search(path.read_text())
    ] == []


def test_the_package_lists_every_public_name_once():
    assert not [name for name, value in PUBLIC.items() if not value.__module__.startswith("jourdain_jax")]
    assert len(PUBLIC) == sum(
        not inspect.ismodule(getattr(space, name)) for space in SPACES for name in space.__all__
    )
    assert len(jj.__all__) <= 115


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("simulate", lambda made: made["motion"].q_end.shape == (5,) and abs(float(made["slope"])) > 0),
        ("rollout", lambda made: made["lanes"]["lean"].shape == (16, 201) and not made["lanes"].failed.size),
        ("fit", lambda made: abs(float(made["found"].scene.offset) - 0.25) < 1e-3),
    ],
)
def test_the_examples_of_a_docstring_run(name, holds, capsys):
    text = inspect.getdoc(FUNCTIONS[name]).split("**Examples**")[1]
    made = {"jj": jj, "jax": jax, "jnp": jnp}
    exec(textwrap.dedent(text), made)
    assert capsys.readouterr().out
    assert holds(made)


def test_the_list_of_methods_is_that_of_the_base_class():
    methods = [
        name
        for name, member in vars(jj.Scene).items()
        if inspect.isfunction(inspect.unwrap(member)) and not name.startswith("_")
    ]
    assert set(description.METHODS) == set(methods) - {"replace", "named"}
    assert set(description.ATTRIBUTES) == {
        name for name in jj.Scene.__annotations__ if not name.startswith("_")
    } - {"switching"}
