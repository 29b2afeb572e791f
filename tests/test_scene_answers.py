"""What a scene's methods return, and what is handed to the equations, is checked by kind and shape; the error names the method and the thing."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import Bead

import jourdain_jax as jj
from jourdain_jax.models import BallOnTurntable, TrailerChain


def described(**members):
    """The bead with some members replaced."""
    return type("Described", (Bead,), members)()


def accelerate(scene, q, u, **options):
    """Accelerations at t = 0."""
    return jj.accelerations(scene, 0.0, q, u, **options)


TWO, THREE = jnp.zeros(2), jnp.zeros(3)


def at_rest(scene, **options):
    """Accelerations at the origin, from rest."""
    return jj.accelerations(scene, 0.0, jnp.zeros(2), jnp.zeros(2), **options)


def test_one_load_counts_as_a_tuple_of_one():
    one = described(loads=lambda self, motion: jj.generalized_force(motion, x_rate=3.0))
    np.testing.assert_allclose(at_rest(one).udot, [3.0, 0.0])
    jj.simulate(one, {}, t1=0.1)


PLACE = jnp.zeros(3)


def place():
    return PLACE


def unchecked(field, value):
    """A load as a user makes it, without the run-time type checks of these tests."""
    return eqx.tree_at(lambda load: getattr(load, field), jj.Load(), value, is_leaf=lambda x: x is None or x == {})


@pytest.mark.parametrize(
    ("members", "sentence"),
    [
        ({"loads": lambda self, m: None}, "`loads` of `Described` returned `None`, expected a tuple of loads; write return"),
        ({"loads": lambda self, m: {"weight": 1.0}}, "`loads` of `Described` returned a dict, expected a tuple of loads"),
        ({"loads": lambda self, m: (jnp.ones(3),)}, "load 0 of `Described` is .*, expected a load, such as jj.point_force"),
        ({"loads": lambda self, m: (unchecked("forces", {"bead": 1.0}),)}, r"force of load 0 of `Described` on body `bead` has shape \(\), expected \(3,\)"),
        ({"loads": lambda self, m: (unchecked("generalized", {"x_rate": jnp.ones(2)}),)}, "on speed `x_rate` has shape .2,., expected one number"),
        ({"loads": lambda self, m: (unchecked("potential", jnp.ones(2)),)}, "potential of load 0 of `Described` has shape .2,., expected one number"),
        ({"loads": lambda self, m: (jj.point_force(m["bead"].point(), (1.0, 2.0)),)}, "force on a point of `bead` has shape .2,., expected .3,."),
        ({"loads": lambda self, m: (jj.point_force(m["bead"].point((1.0, 2.0)), jnp.ones(3)),)}, "point of body `bead` has shape .2,., expected .3,."),
        ({"loads": lambda self, m: (jj.torque(m, "bead", 1.0),)}, r"torque on `bead` has shape \(\), expected \(3,\); give three components"),
        ({"loads": lambda self, m: (jj.gravity(m, 9.81, (0.0, -1.0)),)}, "direction of gravity has shape .2,., expected .3,."),
        ({"loads": lambda self, m: (jj.gravity(m, 9.81, (1.0, 1.0, 0.0)),)}, "direction of gravity has length 1.414, expected a unit vector"),
        ({"potential": lambda self, pose: pose.q.array}, "what `potential` of `Described` returned has shape .2,., expected one number"),
        ({"bodies": lambda self, t, q: [jj.Particle(1.0, place())]}, "`bodies` of `Described` returned a list, expected a dictionary by name"),
        ({"bodies": lambda self, t, q: {}}, "`bodies` of `Described` returned no body; return at least one by name"),
        ({"bodies": lambda self, t, q: {"bead": place()}}, "body `bead` of `Described` is .*, expected a `jj.Particle` or a `jj.RigidBody`"),
        ({"bodies": lambda self, t, q: {1: jj.Particle(1.0, place())}}, "`bodies` of `Described` returned a dictionary with the key 1, expected names"),
        ({"geometric_constraints": lambda self, p: p.q.x - p.q.y}, "`geometric_constraints` of `Described` returned .*, expected a dictionary by name"),
        ({"geometric_constraints": lambda self, p: {"row": p.q.x > 0}}, "row `row` of `Described` is of type bool, expected real numbers"),
        ({"velocity_constraints": lambda self, m: (m.u.x_rate,)}, "`velocity_constraints` of `Described` returned a tuple, expected a dictionary"),
        ({"velocity_constraints": lambda self, m: {"row": None}}, "row `row` of `Described` is `None`, expected real numbers"),
        ({"prescribed": lambda self, t: {"x": jnp.stack([t, t])}}, "prescribed value of `x` of `Described` has shape .2,., expected one number"),
        ({"prescribed": lambda self, t: t}, "`prescribed` of `Described` returned .*, expected a dictionary by name"),
        ({"contacts": lambda self, pose: {"rim": 1.0}}, "contact `rim` of `Described` is a float, expected a `jj.disc_contact"),
        (
            {"coordinate_rates": lambda self, t, q, u: jnp.ones(3)},
            r"what `coordinate_rates` of `Described` returned has shape \(3,\), expected \(2,\); return one rate for each of x, y",
        ),
        ({"coordinate_rates": lambda self, t, q, u: None}, "what `coordinate_rates` of `Described` returned is `None`, expected real numbers"),
    ],
)
def test_what_a_method_returns_wrongly_is_named_with_what_to_return(members, sentence):
    with pytest.raises(ValueError, match=sentence):
        at_rest(described(**members))


def test_a_direction_of_gravity_that_is_computed_is_looked_at_when_the_scene_is_probed():
    tilted = described(loads=lambda self, m: (jj.gravity(m, 9.81, self.mass * jnp.array([0.6, 0.8, 0.0])),))
    jj.simulate(tilted, {}, t1=0.1)
    with pytest.raises(ValueError, match=r"the direction of gravity in load 1 of `Described` has a length that differs from 1 by .*, expected a unit vector"):
        jj.simulate(tilted.replace(mass=1.5), {}, t1=0.1)
    with pytest.raises(ValueError, match=r"the direction of gravity in load 1 of `Described`"):
        jj.accelerations(tilted.replace(mass=1.5), 0.0, np.zeros(2), np.zeros(2))
    (failed,) = [check for check in jj.verify(tilted.replace(mass=1.5)).checks if check.name == "inertia"]
    assert not failed.passed
    assert failed.culprit == "load 1 (on `bead`): its direction is no unit vector"


def test_a_direction_of_gravity_that_is_traced_hides_nothing_else():
    class Ghost(Bead):
        direction: object = jj.parameter((0.0, -1.0, 0.0))
        coordinates = jj.coordinates("x y z")

        def loads(self, motion):
            return (jj.gravity(motion, 9.81, self.direction),)

    with pytest.raises(ValueError, match="nothing in `Ghost` has inertia along `z_rate`"):
        jax.jit(lambda e: jj.simulate(Ghost(direction=e), {}, t1=0.1).q_end)(jnp.array([0.0, -1.0, 0.0]))


@pytest.mark.parametrize(
    ("events", "sentence"),
    [
        (lambda self, m: 1.0 - m.q.x, "`events` of `Described` returned .*, expected a dictionary by name"),
        (lambda self, m: {"out": m.q.x < 1.0}, "event `out` of `Described` is of type bool, expected real numbers; return a number, positive while the motion"),
        (lambda self, m: {"out": 1.0 - m.q.array}, "event `out` of `Described` has shape .2,., expected one number; return a number, positive while"),
    ],
)
def test_an_event_is_one_number_that_falls_through_zero(events, sentence):
    with pytest.raises(ValueError, match=sentence):
        jj.simulate(described(events=events), {}, t1=0.1)


def test_an_invariant_of_several_components_is_refused_by_name():
    motion = jj.simulate(described(invariants=lambda self, m: {"momentum": m["bead"].velocity}), {}, t1=0.1)
    with pytest.raises(ValueError, match=r"invariant `momentum` of `Described` has shape .3,., expected one number; give every component a name"):
        motion.invariants()


def test_lists_and_integers_are_numbers():
    pulled = described(loads=lambda self, m: (jj.spring(m["bead"].point((0, 0, 0)), jj.fixed_point((0, 0, 1)), 2, 1),), prescribed=lambda self, t: {"y": 0})
    exact = jj.accelerations(pulled, 0.0, jnp.array([1.0, 0.0]), jnp.array([0.0, 0.0]), reduction="svd").udot
    for q in ([1, 0], (1.0, 0.0), np.array([1, 0]), jnp.array([1, 0], jnp.int32)):
        np.testing.assert_allclose(jj.accelerations(pulled, 0, q, [0, 0], reduction="svd").udot, exact)
        np.testing.assert_allclose(jj.unconstrained_equations(pulled, 0, q, [0, 0]).M, np.eye(2))
        np.testing.assert_allclose(jj.position_residual(pulled, 0, q), [0.0])
        np.testing.assert_allclose(jj.velocity_residual(pulled, 0, q, [0, 2]), [2.0])
        np.testing.assert_allclose(jj.kinetic_energy(pulled, 0, q, [0, 2]), 2.0)
        np.testing.assert_allclose(jj.gibbs_function(pulled, 0, q, [0, 0], [0, 2]), 2.0)
        assert jj.newton_residual(pulled, 0, q, [0, 0], [0, 0]).linear.shape == (1, 3)


def test_a_body_of_integers_has_velocities():
    whole = described(bodies=lambda self, t, q: {"bead": jj.Particle(1, [q.x, q.y, 0]), "post": jj.RigidBody(1, [1, 1, 1], [0, 0, 0], np.eye(3, dtype=int))})
    np.testing.assert_allclose(at_rest(whole).udot, [0.0, 0.0])


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda b: accelerate(b, THREE, TWO), r"`q` of `Bead` has shape \(3,\), expected \(2,\); one number for each of x, y; use `jax.vmap`"),
        (lambda b: accelerate(b, TWO, jnp.zeros((4, 2))), r"`u` of `Bead` has shape \(4, 2\), expected \(2,\); one number for each of x_rate"),
        (lambda b: accelerate(b, {"x": 1.0}, TWO), "`q` of `Bead` is a dictionary, expected a vector of x, y; `jj.start"),
        (lambda b: jj.kinetic_energy(b, 0.0, jnp.zeros(2), jnp.zeros(1)), r"`u` of `Bead` has shape \(1,\), expected \(2,\)"),
        (lambda b: jj.virtual_power(b, 0.0, jnp.zeros(2), jnp.zeros(2), jnp.zeros(2), jnp.zeros(3)), r"`virtual_velocity` of `Bead` has shape \(3,\)"),
        (lambda b: accelerate(b, TWO, TWO, inputs=jnp.ones(1)), r"`inputs` of `Bead` has shape \(1,\), expected \(0,\); .* the scene has no inputs"),
        (lambda b: accelerate(b, TWO, TWO, reduction=3), "`reduction` is an int, expected a name .privileged, qr, svd, kkt"),
    ],
)
def test_a_vector_of_the_wrong_length_is_named_with_its_entries(ask, sentence):
    with pytest.raises(ValueError, match=sentence):
        ask(Bead())


def test_inputs_are_given_by_name_or_as_a_vector():
    chain = TrailerChain(trailers=1)
    q, u, _ = chain.named(**chain.example)
    by_name = jj.accelerations(chain, 0.0, q, u, {"turn": 2.0}).udot
    np.testing.assert_array_equal(by_name, jj.accelerations(chain, 0.0, q, u, [0, 2]).udot)
    with pytest.raises(ValueError, match="`TrailerChain` has no input `trun`; did you mean `turn`"):
        jj.accelerations(chain, 0.0, q, u, {"trun": 2.0})
    with pytest.raises(ValueError, match="input `turn` of `TrailerChain` is a function, expected real numbers; a function of time is for `simulate`"):
        jj.accelerations(chain, 0.0, q, u, {"turn": lambda t: t})


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: jj.RigidBody(1.0, 0.4, PLACE, jnp.eye(3)), r"inertia of a rigid body has shape \(\), expected \(3, 3\); give three principal moments"),
        (lambda: jj.RigidBody(1.0, jnp.ones(3), PLACE, jnp.eye(3), jnp.ones(3)), r"outline of a rigid body has shape \(3,\), expected \(points, 3\)"),
        (lambda: jj.RigidBody("a", jnp.ones(3), PLACE, jnp.eye(3)), "mass of a rigid body is the text 'a', expected real numbers"),
        (lambda: jj.Plane(origin=(0.0, 1.0)), r"origin of a plane has shape \(2,\), expected \(3,\)"),
        (lambda: jj.Plane(tilt=(0.0, 1.0)), r"tilt of a plane has shape \(2,\), expected one number; give one angle in rad"),
        (lambda: jj.fixed_point((1.0, 2.0)), r"position of a fixed point has shape \(2,\), expected \(3,\)"),
    ],
)
def test_parts_of_a_scene_of_the_wrong_shape_say_what_they_are(build, sentence):
    with pytest.raises(ValueError, match=sentence):
        build()


def test_the_path_of_a_point_needs_three_components_and_a_body_that_exists():
    motion = jj.simulate(Bead(), {}, t1=0.1, ts=[0.0, 0.1])
    assert motion.point("bead", (1, 0, 0)).shape == (2, 3)
    with pytest.raises(ValueError, match=r"point of body `bead` has shape \(2,\), expected \(3,\); give three components in its body frame, m"):
        motion.point("bead", (1.0, 2.0))
    with pytest.raises(KeyError) as caught:
        motion.point("baed")
    assert str(caught.value) == "no body `baed` in this scene; did you mean `bead`? Valid names: `bead`."


def test_the_checks_leave_nothing_in_a_compiled_program():
    scene = BallOnTurntable()
    q, u, _ = scene.named(**scene.example)
    program = str(jax.make_jaxpr(lambda q, u: inspect.unwrap(jj.coordinate_rates)(scene, 0.0, q, u))(q, u))
    assert "callback" not in program
    assert "isfinite" not in program
