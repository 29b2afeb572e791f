"""Scenes from SymPy's mechanics: their accelerations are those of SymPy's own equations; and the page on
scenes from other tools.
"""

import functools
import shutil
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import DOCS, run
from refusals import refused
from tolerances import CLOSED_FORM

import jourdain_jax as jj
from jourdain_jax.equations import constraint_rows

# Scenes from SymPy's mechanics: their accelerations are those of SymPy's own equations.


sympy = pytest.importorskip("sympy")
mechanics = pytest.importorskip("sympy.physics.mechanics")
systems = pytest.importorskip("sympy_systems")

INPUTS = {"torque": 0.7}


def accelerations_of(kane, values, t, q, u, inputs):
    """udot by SymPy's unconstrained equations and the rates of its velocity rows.

    SymPy eliminates its rows by a symbolic LU, whose pivots may vanish unseen; here its matrices are solved
    together,

        M udot - A' lambda = f,   A udot = -b.
    """
    free = mechanics.KanesMethod(
        kane._inertial,
        list(kane.q),
        list(kane.u),
        _kinematic(kane),
        bodies=kane.bodies,
        forcelist=kane.forcelist,
    )
    free.kanes_equations()
    A, b = (kane._k_dnh, kane._f_dnh) if kane._f_dnh else (sympy.zeros(0, len(u)), sympy.zeros(0, 1))
    functions = {
        x.func.__name__: x
        for x in mechanics.find_dynamicsymbols(free.forcing)
        if not isinstance(x, sympy.Derivative)
    }
    known = dict(zip([*kane.q, *kane.u], [*q, *u], strict=True)) | values | {mechanics.dynamicsymbols._t: t}
    known |= {functions[name]: value for name, value in inputs.items() if name in functions}
    matrices = [
        mechanics.msubs(matrix, kane.kindiffdict()) for matrix in (free.mass_matrix, free.forcing, A, b)
    ]
    M, f, A, b = sympy.lambdify(list(known), matrices, cse=True)(*map(float, known.values()))
    count = len(b)
    A = np.reshape(A, (count, len(u)))
    both = np.block([[M, -A.T], [A, np.zeros((count, count))]])
    return np.linalg.solve(both, np.concatenate([np.ravel(f), -np.ravel(b)]))[: len(u)]


@pytest.fixture
def system():
    """A cart on rails with a rod hinged to it, as SymPy's `System`: a push as an input, an actuator, a row;
    and the values of its constants.
    """
    if not hasattr(mechanics, "System"):
        pytest.skip("this SymPy has no `System`")
    q1, q2, u1, u2, push = mechanics.dynamicsymbols("q1 q2 u1 u2 push")
    m, length, g, c = systems.m, systems.length, systems.g, systems.c
    N, O = mechanics.ReferenceFrame("N"), mechanics.Point("O")
    A = N.orientnew("A", "Axis", [q2, N.y])
    P = O.locatenew("P", q1 * N.x)
    G = P.locatenew("G", -length * A.z)
    cart = mechanics.Particle("cart", P, m)
    rod = mechanics.RigidBody("rod", G, A, m, (mechanics.inertia(A, m * length**2, m * length**2 / 3, m), G))
    system = mechanics.System(N, O)
    system.add_coordinates(q1, q2)
    system.add_speeds(u1, u2)
    system.add_kdes(q1.diff() - u1 + u2, q2.diff() - u2)
    system.add_bodies(cart, rod)
    system.add_loads(mechanics.Force(P, push * N.x))
    system.apply_uniform_gravity(-g * N.z)
    system.add_actuators(mechanics.TorqueActuator(-c * u2, A.y, A, N))
    return system, {m: 1.3, length: 0.6, g: 9.81, c: 0.2}


def test_a_system_of_sympy_becomes_a_scene(system):
    system, values = system
    scene = jj.from_sympy(system, values=values)()
    system.form_eoms()
    assert scene.inputs.entries == ("push",)
    assert errors(system.eom_method, scene, values, inputs={"push": 0.7}) < CLOSED_FORM


@pytest.mark.parametrize("geometric", [True, False])
def test_rows_of_a_system_are_taken_over(system, geometric):
    system, values = system
    q1, q2 = system.q
    if geometric:
        system.q_ind, system.q_dep = [q1], [q2]
        system.add_holonomic_constraints(q1 + sympy.sin(q2) * values[systems.length])
    else:
        system.add_nonholonomic_constraints(system.u[0] - (2 + sympy.cos(q1)) * system.u[1])
    system.u_ind, system.u_dep = system.u[:1], system.u[1:]
    scene = jj.from_sympy(system, values=values)()
    system.form_eoms()
    assert errors(system.eom_method, scene, values, inputs={"push": 0.7}) < CLOSED_FORM


def _kinematic(kane):
    return [rate - value for rate, value in kane.kindiffdict().items()]


def errors(kane, scene, values, count=3, inputs=None):
    """Relative difference of all accelerations at random states on the rows."""
    inputs = {name: INPUTS[name] for name in scene.inputs.entries} if inputs is None else inputs
    found = []
    for t, q, u in zip(*jj.sample_states(scene, count), strict=True):
        expected = accelerations_of(kane, values, t, q[: len(kane.q)], u, inputs)
        found.append(
            np.max(np.abs(np.asarray(jj.accelerations(scene, t, q, u, inputs).udot) - expected))
            / np.max(np.abs(expected))
        )
    assert len(found) == count
    return max(found)


def made(system):
    """A system, values of its constants, and its scene."""
    kane, origin, values = system()
    return kane, values, jj.from_sympy(kane, origin, values)()


@pytest.mark.parametrize("name", systems.SYSTEMS)
def test_accelerations_are_those_of_sympys_own_equations(name):
    kane, values, scene = made(systems.SYSTEMS[name])
    assert scene.speed_names.entries == tuple(str(u.func) for u in kane.u)
    assert scene.coordinate_names.entries[: len(kane.q)] == tuple(str(q.func) for q in kane.q)
    assert errors(kane, scene, values) < CLOSED_FORM


def test_a_function_of_time_that_is_no_coordinate_is_an_input():
    *_, scene = made(systems.pendulum)
    assert scene.inputs.entries == ("torque",)
    without, with_torque = (
        jj.accelerations(scene, 0.0, [0.4], [0.3], {"torque": x}).udot[0] for x in (0.0, 0.5)
    )
    assert_allclose(with_torque - without, 0.5 / (1.3 * 0.6**2), rtol=1e-12)


def test_a_contact_point_without_coordinates_gets_a_path():
    *_, scene = made(systems.rolling_disc)
    assert scene.coordinate_names.entries[3:] == ("C_x", "C_y")
    motion = jj.motion_at(scene, 0.0, [0.0, 0.0, 0.0, 0.2, 0.1], [0.0, 3.0, 0.0])  # upright, rolling along x
    assert_allclose(motion["disc"].velocity, [1.2, 0.0, 0.0], atol=1e-12)
    assert_allclose(motion["disc"].position, [0.2, 0.1, 0.4], atol=1e-12)


def test_a_wheel_without_an_angle_gets_one():
    kane, origin, values = systems.slipping_disc()
    scene = jj.from_sympy(kane, origin, values)()
    assert scene.coordinate_names.entries == ("q1", "q2", "R_angle", "C_x", "C_y")
    motion = jj.motion_at(scene, 0.0, [0.3, 0.2, 1.0, 0.0, 0.0], [0.5, -0.4, 2.0, 0.0, 0.0])
    R = np.asarray(motion["disc"].orientation)
    omega = np.array([0.0, 0.0, 0.5]) + jj.rot_z(0.3) @ np.array([-0.4, 0.0, 0.0]) + 2.0 * R[:, 1]
    assert_allclose(motion["disc"].angular_velocity, omega, atol=1e-12)
    disc = kane.bodies[0]
    own = mechanics.inertia(disc.frame, *(systems.m * systems.r**2 / n for n in (4, 2, 4)))
    disc.inertia = (own, disc.masscenter)
    stated = jj.pose_at(jj.from_sympy(kane, origin, values)(), 0.0, [0.3, 0.2, 1.0, 0.0, 0.0])["disc"]
    assert_allclose(stated.body.inertia, motion["disc"].body.inertia, atol=1e-12)


def test_velocities_that_agree_where_rows_are_met_need_no_coordinates():
    assert made(systems.sleigh)[-1].coordinate_names.entries == ("x", "y", "heading")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of SymPy 1.13
def test_joints_of_sympy_become_a_scene_when_their_equations_are_formed():
    m, length, loads = sympy.symbols("m l loads", positive=True)
    ceiling, first, second = (
        mechanics.Body("ceiling"),
        mechanics.Body("first", mass=m),
        mechanics.Body("second", mass=2 * m),
    )
    joints = (
        mechanics.PinJoint("J1", ceiling, first, child_point=length * first.y),
        mechanics.PinJoint("J2", first, second, child_point=length * second.y),
    )
    for body in (first, second):
        body.apply_force(-loads * ceiling.y)
    method = mechanics.JointsMethod(ceiling, *joints)
    refused(
        r"`system` is a JointsMethod.*after its `form_eoms", jj.from_sympy, method, ceiling.masscenter, {}
    )
    method.form_eoms()
    values = {m: 1.3, length: 0.6, loads: 2.0}
    scene = jj.from_sympy(method, ceiling.masscenter, values)()
    assert scene.loads_ == 2.0  # a method of scenes has the name itself
    assert errors(method.method, scene, values) < CLOSED_FORM


def test_velocity_rows_that_repeat_geometric_ones_are_left_out():
    *_, scene = made(systems.four_bar)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    assert constraint_rows(scene, t, q, u).names == ("configuration 1", "configuration 2")


def test_functions_of_many_kinds_have_values_on_jax():
    from jourdain_jax.importers.formulas import Formulas

    x, y = sympy.symbols("x y")
    names = "sin cos tan asin acos atan sinh cosh tanh asinh atanh exp log sqrt Heaviside erf sinc"
    one = [getattr(sympy, name)(x) for name in names.split()]
    one += [sympy.acosh(1 + x), 1 / sympy.sqrt(x), x**-3, x**y, sympy.Abs(-x * y), sympy.atan2(y, x)]
    one += [sympy.sign(-x), sympy.Min(x, y), sympy.Max(x, y), sympy.floor(7 * y), sympy.ceiling(7 * y)]
    one += [
        sympy.Piecewise((x, x > y), (y**2, sympy.Or(y > 5, sympy.Ne(x, y))), (0, True)),
        sympy.pi * x + sympy.E,
        sympy.Rational(1, 3) * y,
    ]
    values = Formulas({"all": one}, [x, y]).values({x: 0.3, y: 0.8})["all"]
    expected = [float(expression.subs({x: 0.3, y: 0.8})) for expression in one]
    assert_allclose(np.array(values, float), expected, rtol=1e-12)


def _changed(system, change):
    kane, origin, values = system()
    change(kane)
    return kane, origin, values


def _inertia_in(kane, frame):
    rod = kane.bodies[1]
    rod.inertia = (mechanics.inertia(frame, 1, 2, 3), rod.masscenter)


def _with(kane, origin, values, **changes):
    return kane, origin, values | changes


t, y = (mechanics.dynamicsymbols._t, mechanics.dynamicsymbols("y"))
BAD = {
    "input-in-a-position": (
        lambda: systems.moved_pivot(),
        r"`pivot\(t\)` occurs in a position.*neither a coordinate nor a speed",
    ),
    "no-value": (lambda: (*systems.pendulum()[:2], {systems.m: 1.0}), r"no value for `c`, `g`, `l`"),
    "value-of-nothing": (
        lambda: _with(*systems.pendulum(), gg=1.0),
        r"`values` names `gg`.*did you mean `g`",
    ),
    "value-is-no-number": (
        lambda: _with(*systems.pendulum(), m="heavy"),
        r"value of `m` is the text 'heavy'",
    ),
    "values-are-a-list": (lambda: (*systems.pendulum()[:2], [1.0]), r"`values` is a list"),
    "no-origin": (lambda: (systems.pendulum()[0], None, {}), r"`origin` is `None`"),
    "another-object": (
        lambda: (3.0, None, {}),
        r"`system` is a float, expected a `KanesMethod` or a `System`",
    ),
    "no-bodies": (lambda: systems.pendulum(bodies=None), r"does not know its bodies"),
    "empty-bodies": (lambda: systems.pendulum(bodies=[]), r"no body with a mass that moves"),
    "no-kinematic-equations": (lambda: systems.pendulum(kd_eqs=None), r"no kinematic equations"),
    "mass-in-time": (
        lambda: systems.pendulum(mass=2 + sympy.sin(t)),
        r"mass of body `bob` is `sin\(t\) \+ 2`",
    ),
    "unknown-function": (
        lambda: systems.pendulum_with(systems.given_function),
        r"function `f` in `.*` has no counterpart in JAX",
    ),
    "function-not-in-jax": (
        lambda: systems.pendulum_with(lambda q, N: sympy.besselj(0, q) * N.x),
        r"function `besselj`",
    ),
    "imaginary-load": (
        lambda: systems.pendulum_with(lambda q, N: sympy.I * q * N.x),
        r"`I` is not a real number",
    ),
    "acceleration-in-a-load": (
        lambda: systems.pendulum_with(lambda q, N: mechanics.dynamicsymbols("u").diff() * N.x),
        r"not their rates",
    ),
    "rate-of-an-input": (
        lambda: systems.pendulum_with(lambda q, N: y.diff() * N.x),
        r"`Derivative\(y\(t\), t\)` occurs.*make `y\(t\)` a coordinate",
    ),
}

LOOSE = mechanics.ReferenceFrame("loose")
CHANGED = {
    "no-orientation": (
        systems.slipping_disc,
        lambda kane: setattr(kane.bodies[0], "frame", LOOSE),
        r"frame `loose` has no orientation in `N`",
    ),
    "two-angular-velocities": (
        systems.double_pendulum,
        lambda kane: kane.bodies[1].frame.set_ang_vel(
            kane.bodies[0].frame, 3 * kane.u[0] * kane.bodies[0].frame.z
        ),
        r"an angular velocity that disagrees with its orientation",
    ),
    "inertia-that-changes": (
        systems.double_pendulum,
        lambda kane: _inertia_in(kane, kane._inertial),
        r"body `rod 2` in its own frame `B` changes in time",
    ),
    "inertia-in-a-loose-frame": (
        systems.double_pendulum,
        lambda kane: _inertia_in(kane, LOOSE),
        r"body `rod 2` is stated in a frame without orientation",
    ),
    "two-bodies-of-a-name": (
        systems.double_pendulum,
        lambda kane: setattr(kane, "_bodylist", [kane.bodies[0]] * 2),
        r"two bodies are called `rod 1`",
    ),
}
BAD |= {
    name: (functools.partial(_changed, system, change), message)
    for name, (system, change, message) in CHANGED.items()
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_become_a_scene_is_refused_by_name(case):
    make, message = BAD[case]
    refused(message, jj.from_sympy, *make())


def test_without_sympy_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(ImportError, match="pip install sympy"):
        jj.from_sympy(None, None, {})


# The page on scenes from other tools: its code runs as it stands, in order, beside the files that it shows.


pytest.importorskip("sympy")
PAGE = DOCS / "howto" / "from_other_tools.md"


def test_the_code_of_the_page_runs(tmp_path, monkeypatch, capsys):
    text = PAGE.read_text(encoding="utf-8")
    shutil.copy(PAGE.with_name("robot.urdf"), tmp_path)
    monkeypatch.chdir(tmp_path)
    scope = run(PAGE)
    printed = capsys.readouterr().out
    assert printed.count("reached the end of its span") == text.count("print(motion)")
    assert [scope[name]().coordinate_names.entries[0] for name in ("Disc", "Robot", "Arm")] == [
        "yaw",
        "x",
        "shoulder",
    ]
