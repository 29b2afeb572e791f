"""`verify` finds what is wrong in a scene that states something wrong, and names the body, load or row at
fault.
"""

import jax
import jax.numpy as jnp
import pytest
from small_scenes import BeadOnTurningWire, DiscWithHeightRow, DrivenPendulum, OnLine, OnPlane, name_of

import jourdain_jax as jj
from jourdain_jax.analysis import Verification, derivative_exists
from jourdain_jax.analysis.statements import statement_checks


class Sledge(jj.Scene):
    """A sprung body on a knife edge and a bead that a bar ties to it; right as it stands, its methods are
    replaced by wrong ones below.
    """

    mass: object = jj.parameter(1.2, unit="kg", positive=True)
    stiffness: object = jj.parameter(3.0, unit="N/m")
    coordinates = jj.coordinates("x y yaw bead_x bead_y")
    example = {"x": 0.4, "y": -0.3, "yaw": 0.5, "bead_x": 1.1, "bead_y": 0.6, "yaw_rate": 0.3}
    domain = {
        "x": (0.2, 0.6),
        "y": (-0.6, -0.2),
        "yaw": (0.2, 0.8),
        "bead_x": (0.8, 1.2),
        "bead_y": (0.4, 0.9),
    }

    def bodies(self, t, q):
        zero = jnp.zeros_like(q.x)
        sledge = jj.RigidBody(self.mass, self.inertia(), [q.x, q.y, zero], jj.rot_z(q.yaw))
        return {"bead": jj.Particle(0.3 * self.mass, [q.bead_x, q.bead_y, zero]), "sledge": sledge}

    def inertia(self):
        return jnp.diag(jnp.array([0.2, 0.3, 0.4]))

    def loads(self, motion):
        return (
            jj.gravity(motion, 9.81, (0.0, -1.0, 0.0)),
            jj.spring(motion["bead"].point(), jj.fixed_point((1, 0, 0)), self.stiffness, 0.4),
            jj.damper(motion["sledge"].point((0.1, 0.2, 0.0)), jj.fixed_point((0, 1, 0)), 0.5),
        )

    def geometric_constraints(self, pose):
        return {"bar": self.bar(pose["sledge"].place((0.2, 0.0, 0.0)), pose["bead"].position)}

    def bar(self, a, b):
        return jj.rod(a, b, 0.9)

    def velocity_constraints(self, motion):
        return {"blade": self.blade(motion)}

    def blade(self, motion):
        return jj.knife_edge(motion["sledge"], motion["sledge"].position, motion["sledge"].orientation[:, 1])


def wrong(**methods):
    """The sledge with some methods replaced, and a state of it, with the bead at x = 1.1 m."""
    scene = type("Wrong", (Sledge,), methods)()
    return scene, jj.consistent(scene, 0.0, *scene.named(**scene.example)[:2], held=("bead_x",))


def statements(scene, state):
    """Of the verification, the part that looks at what the scene states, piece by piece: the rest takes a
    quarter of a minute to compile.
    """
    Z = jnp.eye(len(state.u))
    return Verification(
        "Wrong", tuple(statement_checks(scene, state.t, state.q, state.u, jnp.zeros(0), Z, 0)), ()
    )


def refused(found, check, culprit):
    """The verification failed in the named check, on the named culprit, and its text says so."""
    assert not found.passed
    lines = [line for line in str(found).splitlines() if line.startswith(f"  {check} ") and "FAILED" in line]
    assert culprit in "\n".join(lines), str(found)


def failed(found):
    """Names of the checks that did not pass."""
    return {check.name for check in found.checks if not check.passed}


def with_slope(f, slope):
    """`f` of one array with a derivative of the user's own making: `slope(x, dx)`."""
    made = jax.custom_jvp(f)
    made.defjvp(lambda primals, tangents: (f(*primals), slope(*primals, *tangents)))
    return made


@pytest.mark.parametrize(
    "scene", [Sledge(), DiscWithHeightRow(), DrivenPendulum(), BeadOnTurningWire(damping=0.4)], ids=name_of
)
def test_right_scenes_pass_at_random_states(scene):
    t, q, u = (x[0] for x in jj.sample_states(scene, 1, seed=3))
    found = jj.verify(scene, jj.consistent(scene, t, q, u))
    assert found.passed, str(found)


def test_a_potential_that_does_not_give_the_force_is_found_at_its_load():
    def loads(self, motion):
        gravity, spring, damper = Sledge.loads(self, motion)
        return (gravity, damper, jj.Load(spring.forces, spring.torques, {}, 1.5 * spring.potential))

    found = jj.verify(*wrong(loads=loads))
    refused(found, "potentials", "load 3 (on `bead`)")
    assert failed(found) == {"potentials", "energy"}


PUSH = with_slope(lambda x: 1.0 + 0.3 * jnp.sin(x), lambda x, dx: 0.3 * jnp.sin(x) * dx)
BRAKE = with_slope(lambda u: -jnp.tanh(u), lambda u, du: -du)  # right at rest
ACROSS = with_slope(
    lambda x: jnp.stack([-jnp.sin(x), jnp.cos(x), 0 * x]),
    lambda x, dx: 0.5 * jnp.stack([-jnp.cos(x), -jnp.sin(x), 0 * x]) * dx,
)
LENGTH = with_slope(
    lambda d: jnp.sqrt(d @ d), lambda d, dd: jnp.array([1.0, 0.7, 1.0]) * d @ dd / jnp.sqrt(d @ d)
)
BENT = with_slope(jnp.sin, lambda x, dx: 0.9 * jnp.cos(x) * dx)


def energy(of):
    return (
        {"potential": lambda self, pose: of(pose["bead"].position[0])},
        "derivatives",
        "the scene's `potential`",
    )


def inertia(entries, sentence="body `sledge`"):
    entries = tuple(map(tuple, entries))
    return {"inertia": lambda self: jnp.array(entries)}, "inertia", sentence


def bead(mass, x):
    return {
        "bodies": lambda self, t, q: (
            Sledge.bodies(self, t, q)
            | {"bead": jj.Particle(mass, jnp.stack([x(q.bead_x), q.bead_y, 0.0 * q.x]))}
        )
    }


def stretched(self, t, q):
    sledge = Sledge.bodies(self, t, q)["sledge"]
    return Sledge.bodies(self, t, q) | {
        "sledge": jj.RigidBody(sledge.mass, sledge.inertia, sledge.position, 1.1 * sledge.orientation)
    }


def pushed(self, motion):
    along = jnp.stack([PUSH(motion.q.bead_x), 0.2 * PUSH(motion.u.x_rate), 0.0 * motion.t])
    return (*Sledge.loads(self, motion), jj.point_force(motion["bead"].point(), along))


NEGATIVE = "body `sledge`: a principal moment of inertia is negative"
WRONG = {  # methods of the sledge, the check that must fail, and what it must name
    "a factor of a potential": energy(with_slope(lambda x: 2.0 * x**2, lambda x, dx: 2.2 * x * dx)),
    "a potential with a stopped gradient": energy(lambda x: 2.0 * jax.lax.stop_gradient(x) * x),
    "a kink just here": energy(lambda x: jnp.abs(x - 1.1)),
    "a gradient that is not a number here": energy(lambda x: jnp.sqrt((x - 1.1) ** 2)),
    "a step just here": energy(lambda x: jnp.floor(10 * (x - 1.1))),
    "a force": ({"loads": pushed}, "derivatives", "load 4 (on `bead`): its force on `bead`"),
    "a generalized force": (
        {"loads": lambda self, motion: (jj.generalized_force(motion, yaw_rate=BRAKE(motion.u.yaw_rate)),)},
        "derivatives",
        "its force on `yaw_rate`",
    ),
    "the drift of a velocity row": (
        {"blade": lambda self, motion: motion["sledge"].velocity @ ACROSS(motion.q.yaw)},
        "derivatives",
        "constraint `blade`",
    ),
    "the gradient of a geometric row": (
        {"bar": lambda self, a, b: LENGTH(b - a) - 0.9},
        "derivatives",
        "constraint `bar`",
    ),
    "a pose": (bead(0.3, BENT), "derivatives", "body `bead`: its position"),
    "an inertia that is not symmetric": inertia(
        [[0.2, 0.05, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.4]], "body `sledge`: its inertia is not symmetric"
    ),
    "a negative moment": inertia([[0.2, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, -0.1]], NEGATIVE),
    "a moment above the sum of the others": inertia(
        jnp.diag(jnp.array([0.2, 0.3, 0.6])).tolist(),
        "body `sledge`: a principal moment of inertia exceeds the sum of the other two",
    ),
    "a large product of inertia": inertia([[0.2, 0.5, 0.0], [0.5, 0.3, 0.0], [0.0, 0.0, 0.4]], NEGATIVE),
    "an inertia that is not a number": inertia([[0.2, 0.0, 0.0], [0.0, jnp.nan, 0.0], [0.0, 0.0, 0.4]]),
    "a negative mass": (bead(-0.3, lambda x: x), "inertia", "body `bead`: its mass is negative"),
    "an orientation that is not a rotation": (
        {"bodies": stretched},
        "inertia",
        "body `sledge`: its orientation is not a rotation matrix",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_found_where_it_is(what):
    methods, check, culprit = WRONG[what]
    refused(statements(*wrong(**methods)), check, culprit)


def test_without_an_example_a_scene_is_checked_in_motion():
    class Slider(OnLine):
        def loads(self, motion):
            return jj.generalized_force(motion, x_rate=BRAKE(motion.u.x_rate))

    refused(jj.verify(Slider()), "derivatives", "its force on `x_rate`")


def test_the_result_for_machines_has_no_numbers_that_json_lacks():
    found = statements(*wrong(inertia=lambda self: jnp.full((3, 3), jnp.nan)))
    assert not found.as_dict()["passed"]
    assert {"name", "value", "threshold", "passed", "culprit", "note"} == set(found.as_dict()["checks"][0])
    assert any(check["value"] is None for check in found.as_dict()["checks"])


class TwoBlades(OnPlane):
    """A particle held twice along the same line: the rows are dependent as long as the slopes are equal."""

    slopes: object = jj.parameter((0.5, 0.5))
    mass: object = jj.parameter(1.0)

    def velocity_constraints(self, motion):
        return {"blades": motion.u.y_rate - self.slopes * motion.u.x_rate}


def test_a_derivative_that_splits_dependent_rows_does_not_exist():
    scene = TwoBlades()
    for slopes, mass, exists in (([1.0, 1.0], 0.0, True), ([1.0, 0.0], 0.0, False), ([0.0, 0.0], 1.0, True)):
        change = scene.replace(slopes=slopes, mass=mass)
        assert derivative_exists(scene, 0.0, [0.1, 0.2], [1.0, 0.5], change, [0.0, 0.0]) == exists


def test_verification_leaves_out_a_derivative_that_does_not_exist_and_says_so():
    scene = TwoBlades()
    found = jj.verify(scene, jj.consistent(scene, 0.0, [0.1, 0.2], [1.0, 0.5]))
    assert found.passed
    assert "parameters omitted" in str(found)
