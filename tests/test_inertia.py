"""Bodies without inertia and bodies that cannot be: refused by name, and a result code of their lane where no
error can be raised.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import OnLine
from tolerances import CLOSED_FORM

import jourdain_jax as jj

# What has no inertia has no acceleration: it is refused by name where it never has any, and a lane says so
# where it has none.


class Weightless(OnLine):
    """A bead at x, and a force on a coordinate y that moves nothing."""

    mass: float = jj.parameter(2.0, unit="kg")
    coordinates = jj.coordinates("x y")

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=3.0, y_rate=1.0)


class Geared(Weightless):
    """A bead whose y is geared to x by a row: `y_rate = 2 x_rate`."""

    def velocity_constraints(self, motion):
        return {"gear": motion.u.y_rate - 2.0 * motion.u.x_rate}


class Twice(Weightless):
    """x and y move the same bead along the same line."""

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, [q.x + q.y, 0.0, 0.0])}


class ThinRod(jj.Scene):
    """A rod without thickness, free in space: nothing resists its spin about its own axis."""

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        return {
            "rod": jj.RigidBody.rod(
                1.0, 0.8, axis="x", position=q.array[:3], orientation=jj.quaternion_to_matrix(q["attitude"])
            )
        }


class OnSphere(jj.Scene):
    """A particle on a sphere in spherical angles: at the pole, and only there, the azimuth has no inertia."""

    coordinates = jj.coordinates("polar azimuth")
    example = {"polar": 1.0, "azimuth_rate": 0.5}

    def bodies(self, t, q):
        s = jnp.sin(q.polar)
        return {
            "particle": jj.Particle(1.0, [s * jnp.cos(q.azimuth), s * jnp.sin(q.azimuth), jnp.cos(q.polar)])
        }


class Tumbling(jj.Scene):
    """A free body whose inertia is a matrix, as a CAD program gives it."""

    inertia: jnp.ndarray = jj.parameter(
        np.array([[1.0, 0.1, 0.2], [0.1, 1.3, 0.05], [0.2, 0.05, 0.9]]), unit="kg m^2"
    )
    coordinates = jj.coordinates(jj.quaternion("attitude"))

    def bodies(self, t, q):
        return {"body": jj.RigidBody(1.0, self.inertia, jnp.zeros(3), jj.quaternion_to_matrix(q.attitude))}


def test_an_inertia_that_is_a_matrix_is_lowered_and_its_symmetric_part_counts():
    scene = Tumbling()
    assert jj.lower(scene).operations < 100
    omega = np.array([1.0, -0.5, 2.0])

    def turned(inertia):
        return jj.simulate(
            Tumbling(inertia), {"attitude_omega": omega}, ts=[0.5], rtol=1e-11, atol=1e-11
        ).u_end

    I, along = np.asarray(scene.inertia), np.array([[0.3, 0.7, 0.0], [0.7, 0.0, -0.4], [0.0, -0.4, 0.2]])
    for s in (0.0, 0.5):
        found = jj.accelerations(Tumbling(I + s * along), 0.0, [1.0, 0.0, 0.0, 0.0], omega).udot
        assert_allclose(
            (I + s * along) @ found, np.cross((I + s * along) @ omega, omega), rtol=1e-12, atol=1e-12
        )  # Euler
    weights = np.array([1.0, -2.0, 0.5])
    slopes = jax.jit(jax.grad(lambda inertia: weights @ turned(inertia)))(I)
    assert_allclose(slopes, slopes.T, atol=1e-14)
    assert_allclose(
        np.sum(slopes * along),
        weights @ (turned(I + 1e-4 * along) - turned(I - 1e-4 * along)) / 2e-4,
        rtol=1e-6,
    )


@pytest.mark.parametrize(
    ("scene", "names"),
    [
        (Weightless(), "`y_rate`"),
        (Weightless(mass=0.0), "`x_rate`"),  # one of the two that have none
        (Twice(), "`x_rate`, `y_rate` together"),
        (ThinRod(), "`attitude_omega_x`"),
    ],
)
@pytest.mark.parametrize(
    "ask",
    [jj.structure_of, jj.report, lambda scene: jj.simulate(scene, {}, t1=1.0)],
    ids=["structure", "report", "simulate"],
)
def test_speeds_that_move_no_mass_are_refused_by_name(scene, names, ask):
    refused(f"has inertia along .*{names}.*: no mass moves with it", ask, scene)


def test_a_coordinate_without_inertia_that_a_row_holds_is_no_fault():
    # virtual power of both forces: m x'' = 3 + 2 * 1
    motion = jj.simulate(Geared(), {}, t1=2.0, rtol=1e-12, atol=1e-12).raise_if_failed()
    assert_allclose(motion.q_end, np.array([1.0, 2.0]) * 0.5 * 2.5 * 4.0, rtol=CLOSED_FORM)


def test_an_isolated_loss_of_inertia_is_no_fault_of_the_scene():
    scene = OnSphere()
    assert jj.structure_of(scene).degrees_of_freedom == 2
    q, u, _ = scene.named(azimuth_rate=0.5)  # at the pole
    for name, found in (
        (name, jj.accelerations(scene, 0.0, q, u, reduction=name)) for name in jj.reductions(scene)
    ):
        assert not found.applicable, name
    assert np.all(np.isnan(jj.accelerations(scene, 0.0, q, u).udot))


def test_a_motion_that_starts_without_inertia_says_so_instead_of_inventing_an_acceleration():
    q, u, _ = OnSphere().named(azimuth_rate=0.5)
    stuck = jj.simulate(OnSphere(), jj.consistent(OnSphere(), 0.0, q, u), t1=1.0)
    assert stuck.result == results.NOT_FINITE
    assert "no inertia along a free direction" in stuck.message


class Parted(jj.Scene):
    """A body whose mass, and one whose inertia, is what is left of a number; the second is pushed along x."""

    coordinates = jj.coordinates("x y angle")
    whole: object = jj.parameter(1.5)
    part: object = jj.parameter(0.5)
    moments: object = jj.parameter(1.0)

    def bodies(self, t, q):
        turned = jj.rot_z(q.angle)
        body = jj.RigidBody(1.0, self.moments * jnp.ones(3), [q.x, 0.0, 0.0], turned)
        return {"body": body, "left": jj.Particle(self.whole - self.part, [q.x, q.y, 0.0])}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=1.0)


@pytest.mark.parametrize("backend", ["native", "xla", "dense"])
def test_lanes_in_which_a_free_motion_has_no_inertia_are_wrong_parameters(backend):
    # no force acts along y, or turns the body: the lost inertia had left the equations
    numbers = {"part": np.array([0.5, 1.5, 0.5, 0.5]), "moments": np.array([1.0, 1.0, 0.0, np.nan])}
    lanes = jj.rollout(Parted(), {"y_rate": 0.1}, parameters=numbers, t1=1.0, backend=backend)
    assert lanes.result.tolist() == [results.SUCCESS] + 3 * [results.BAD_PARAMETER]


def test_verification_fails_where_no_acceleration_is_determined_and_says_so():
    q, u, _ = OnSphere().named(azimuth_rate=0.5)
    found = jj.verify(OnSphere(), jj.consistent(OnSphere(), 0.0, q, u))
    assert not found.passed
    assert "no reduction applies" in str(found)
    assert set(found.not_applicable) == set(jj.reductions(OnSphere()))


class BurningRocket(jj.Scene):
    """Fuel leaves with the speed that the rocket has; a force pushes along x."""

    coordinates = jj.coordinates("x angle")

    def bodies(self, t, q):
        left = 2.0 - 0.5 * t
        return {"rocket": jj.RigidBody(left, left * jnp.ones(3), [q.x, 0.0, 0.0], jj.rot_z(q.angle))}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=3.0)


def test_mass_that_leaves_takes_its_momentum_with_it():
    motion = jj.simulate(BurningRocket(), {"x_rate": 1.0, "angle_rate": 2.0}, t1=2.0, rtol=1e-10, atol=1e-10)
    assert_allclose(motion.u_end, [1.0 + 6.0 * np.log(2.0), 2.0], atol=1e-9)  # m x'' = F, I angle'' = 0


# Bodies that cannot be end a lane with a result code, where no error can be raised: negative masses, and
# inertias that no body has.


def turned_inertias(moments, generator):
    """Inertias with these principal moments about axes at random."""
    turns = np.linalg.qr(generator.normal(size=(len(moments), 3, 3)))[0]
    inertias = np.einsum("kij,kj,klj->kil", turns, moments, turns)
    return (inertias + inertias.mT) / 2


@pytest.mark.parametrize("backend", ["native", "dense"])
def test_an_inertia_is_impossible_where_a_moment_is_negative_or_above_the_sum_of_the_others(backend):
    generator = np.random.default_rng(0)
    moments = generator.uniform(0.01, 1.0, size=(300, 3))
    moments *= np.where(generator.uniform(size=(300, 3)) < 0.15, -1.0, 1.0)
    flat = abs(moments[:50])
    flat[:, 2] = flat[:, 0] + flat[:, 1]
    moments = np.concatenate([moments, flat])
    least, middle, largest = np.sort(moments, axis=1).T
    wrong = (least < 0) | (largest > 1.05 * (least + middle))
    assert 100 < wrong.sum() < 250
    scales = 10.0 ** generator.uniform(-9, 9, (len(moments), 1))
    lanes = jj.rollout(
        Tumbling(),
        {"attitude_omega_x": 1e-3},
        parameters={"inertia": turned_inertias(scales * moments, generator)},
        ts=[1e-6],
        backend=backend,
    )
    assert_array_equal(lanes.result == results.BAD_PARAMETER, wrong)


def test_the_motion_of_a_flat_body_has_derivatives_to_either_side():
    inertia = turned_inertias(np.array([[0.3, 0.5, 0.8]]), np.random.default_rng(1))[0]
    along = turned_inertias(np.array([[0.0, 0.0, 1.0]]), np.random.default_rng(2))[0]

    def end(s):
        start = {"attitude_omega_x": 0.7, "attitude_omega_y": -0.9, "attitude_omega_z": 0.4}
        motion = jj.simulate(Tumbling(inertia + s * along), start, ts=[1.0], rtol=1e-11, atol=1e-11)
        return motion.nan_if_failed().u_end

    expected = (end(1e-4) - end(-1e-4)) / 2e-4
    for slope in (jax.jacfwd(end)(0.0), jax.jacrev(end)(0.0)):
        assert_allclose(slope, expected, rtol=1e-6, atol=1e-7)


class Rolling(jj.Scene):
    """A wheel that rolls on a plane, and a ball in a pipe; each of their numbers is open to mistakes."""

    mass: float = jj.parameter(1.0)
    moment: float = jj.parameter(0.3)
    lopsided: float = jj.parameter(0.0)
    radius: float = jj.parameter(0.1)
    height: float = jj.parameter(0.1)
    tyre: float = jj.parameter(0.02)
    rise: float = jj.parameter(0.0)
    slope: float = jj.parameter(0.0)
    tilting: float = jj.parameter(0.0)
    carried: float = jj.parameter(0.0)
    ball: float = jj.parameter(0.1)
    pipe: float = jj.parameter(0.5)
    down: jnp.ndarray = jj.parameter((0.0, 0.0, -1.0))
    normal: float = jj.parameter(1.0)
    axis: float = jj.parameter(1.0)
    coordinates = jj.coordinates("x roll about turn")
    example = {"x_rate": 0.1}

    def bodies(self, t, q):
        o = 0.0 * q.x
        inertia = jnp.diag(jnp.stack([self.moment, 0.3 + o, 0.3 + o])) + self.lopsided * jnp.eye(3, k=1)
        above = 0.4 * jnp.stack([jnp.sin(q.about), o, jnp.cos(q.about)])
        return {
            "wheel": jj.RigidBody(
                self.mass, inertia, [q.x, o, self.slope * q.x + self.height], jj.rot_y(q.roll)
            ),
            "ball": jj.RigidBody.ball(1.0, 0.1, position=above, orientation=jj.rot_y(q.turn)),
        }

    def contacts(self, pose):
        _, across, up = jnp.eye(3)
        floor = jj.Plane(
            normal=self.normal * up, velocity=self.rise * up, angular_velocity=self.tilting * across
        )
        pipe = jj.Cylinder(
            self.pipe,
            self.axis * across,
            side="inside",
            origin=self.carried * pose["wheel"].position[0] * across,
        )
        return {
            "rim": jj.wheel_contact(pose["wheel"], self.radius, self.tyre, ground=floor),
            "top": jj.ball_contact(pose["ball"], self.ball, ground=pipe),
        }

    def loads(self, motion):
        return jj.gravity(motion, 9.81, direction=self.down)


class Turned(jj.Scene):
    """A wheel on an axle whose orientation is open to mistakes."""

    stretch: float = jj.parameter(1.0)
    mirror: float = jj.parameter(1.0)
    coordinates = jj.coordinates("roll")
    example = {"roll_rate": 0.1}

    def bodies(self, t, q):
        scales = jnp.stack([self.stretch, self.stretch * self.mirror, self.stretch])
        turned = jj.rot_y(q.roll) @ jnp.diag(scales)
        return {"wheel": jj.RigidBody(1.0, 0.3 * jnp.eye(3), jnp.zeros(3), turned)}


WRONG = {  # the code's text in a lane, the text of the error alone
    "mass=-0.5": ("a negative mass: body `wheel`", r"mass of -0\.5 kg, expected a number"),
    "lopsided=0.01": (
        "an inertia that is not symmetric: body `wheel`",
        "give the same products of inertia above and below",
    ),
    "moment=-0.3": (
        "a negative moment of inertia: body `wheel`",
        r"moment of inertia of -0\.3 kg m\^2, expected",
    ),
    "moment=0.7": (
        "a moment of inertia above the sum of the others: body `wheel`",
        r"moments of inertia 0\.3, 0\.3 and 0\.7 kg m\^2, the last above",
    ),
    "stretch=2.0": (
        "an orientation that is not a rotation: body `wheel`",
        "R' R differs from the identity by 3",
    ),
    "mirror=-1.0": ("a reflected orientation: body `wheel`", "orientation of determinant -1, a reflection"),
    "height=0.2": ("a body off its ground: contact `rim`", r"its body is 0\.1 m off the ground"),
    "radius=-0.1, height=-0.1": (
        "no positive length: the radius of contact `rim`",
        r"less the tyre of contact `rim` .* -0\.12 m",
    ),
    "tyre=-0.01": ("a negative tyre: contact `rim`", r"tyre of -0\.01 m, expected a radius"),
    "tyre=0.2": (
        "no positive length: the radius less the tyre of contact `rim`",
        r"less the tyre of contact `rim` .* -0\.1 m",
    ),
    "ball=0.6": (
        "no positive length: ground radius minus ball radius of contact `top`",
        "`top` .* has no point where body and ground touch",
    ),
    "pipe=-0.5": (
        "no positive length: the radius of the ground of contact `top`",
        "`top` .* has no point where body and ground touch",
    ),
    "slope=0.1": ("a body off its ground: contact `rim`", "at a probed state its body is"),
    "tilting=0.3": (
        "a plane that contradicts its stated motion: the plane of contact `rim`",
        "at 0 m/s by `origin`",
    ),
    "carried=1.0": (
        "a ground that another body carries: the ground of contact `top`",
        "moves with another body",
    ),
    "axis=2.0": ("not a unit vector: the axis of contact `top`", "the axis of contact `top` .* from 1 by 1,"),
    "normal=1.1": (
        "not a unit vector: the normal of contact `rim`",
        r"normal of contact `rim` .* from 1 by 0\.1",
    ),
    "rise=0.3": (
        "a plane that contradicts its stated motion: the plane of contact `rim`",
        r"at 0 m/s by `origin` .* but at 0\.3 m/s",
    ),
    "down=(0, 0, -2)": (
        "not a unit vector: the direction of gravity in load 1",
        "gravity in load 1 .* differs from 1 by 1,",
    ),
}


@eqx.filter_jit
def compiled(scene, backend):
    motion = jj.simulate(scene, ts=[0.1], backend=backend)
    return motion.result, motion.q


@pytest.mark.parametrize("backend", ["auto", "dense"])
@pytest.mark.parametrize("kind", WRONG)
def test_what_a_single_motion_refuses_is_a_code_in_lanes_and_inside_jit(kind, backend):
    sound, (fault, text) = Turned() if kind.startswith(("stretch", "mirror")) else Rolling(), WRONG[kind]
    assert ("machine code" in str(jj.build(sound, backend=backend))) == (backend == "auto")
    wrong = sound.replace(**eval(f"dict({kind})"))
    refused(text, jj.simulate, wrong, ts=[0.1])
    both = {
        name: jnp.stack([getattr(wrong, name), getattr(sound, name)]) for name in type(sound).__annotations__
    }  # one program for all kinds
    lanes = jj.rollout(sound, {}, parameters=both, ts=[0.1], backend=backend)
    assert lanes.result.tolist() == [results.BAD_PARAMETER, results.SUCCESS]
    assert fault in str(lanes)
    assert fault in lanes.lane(0).message
    assert np.isnan(lanes.lanes.q[0]).all()
    for scene, code in zip((wrong, sound), lanes.result, strict=True):
        found, q = compiled(scene, backend)
        assert (int(found), bool(jnp.isfinite(q).all())) == (code, code == results.SUCCESS)


@pytest.mark.parametrize(
    ("moments", "stretch"), [((1.0, -0.2, 1.0), 1.0), ((1.0, 1.0, 2.2), 1.0), ((1.0, 1.0, 1.0), 1.1)]
)
def test_an_impossible_body_without_parameters_is_a_code_where_others_are_traced(moments, stretch):
    class Sprung(jj.Scene):
        stiffness: float = jj.parameter(1.0)
        coordinates = jj.coordinates("yaw pitch")

        def bodies(self, t, q):
            turned = jj.rot_z(q.yaw) @ jj.rot_y(q.pitch)
            return {
                "odd": jj.RigidBody(1.0, jnp.diag(jnp.array(moments)), jnp.zeros(3), turned * stretch),
                "frame": jj.RigidBody(1.0, jnp.eye(3), jnp.zeros(3), turned),
            }

        def loads(self, motion):
            return jj.generalized_force(motion, yaw_rate=-self.stiffness * motion.q.yaw)

    assert int(compiled(Sprung(), "auto")[0]) == results.BAD_PARAMETER


class Led(jj.Scene):
    """A wheel whose height a geometric row leads, and a rod with a point on a plane of its own, right at the
    start.
    """

    slope: float = jj.parameter(0.0)
    lift: float = jj.parameter(0.0)
    swing: float = jj.parameter(0.0)
    stretch: float = jj.parameter(0.0)
    coordinates = jj.coordinates("x z s roll turn")
    domain = {"x": (-1.0, 1.0), "z": (0.0, 0.5), "s": (-1.0, 1.0)}
    example = {"s": 0.0, "x": 0.0, "s_rate": 0.1, "x_rate": 0.1}

    def bodies(self, t, q):
        o = 0.0 * q.x
        turned = jj.rot_y(q.turn) @ jnp.diag(jnp.stack([1 + self.stretch * q.s, 1 + o, 1 + o]))
        return {
            "wheel": jj.RigidBody(1.0, 0.3 * jnp.eye(3), [q.x, o, q.z + self.slope * q.x], jj.rot_y(q.roll)),
            "rod": jj.RigidBody(1.0, 0.3 * jnp.eye(3), [q.s, o, o + 0.1], turned),
        }

    def geometric_constraints(self, pose):
        return {"guide": pose.q.z - 0.1 - self.lift * pose.q.s}

    def contacts(self, pose):
        level = self.swing * pose.q.s * jnp.eye(3)[2]
        tip = jj.Contact("rod", pose.q.s * jnp.eye(3)[0] + level, jj.Plane(level))
        return {"rim": jj.wheel_contact(pose["wheel"], 0.1, 0.02), "tip": tip}


LED = {
    "slope": "a body off its ground: contact `rim`",
    "lift": "a body off its ground: contact `rim`",
    "swing": "a plane that contradicts its stated motion: the plane of contact `tip`",
    "stretch": "an orientation that is not a rotation: body `rod`",
}


@pytest.mark.parametrize("backend", ["auto", "dense"])
def test_what_goes_wrong_on_the_way_along_geometric_rows_is_refused_alone_and_a_code_elsewhere(backend):
    sound, each = Led(), 0.1 * jnp.eye(5)
    parameters = {name: each[k] for k, name in enumerate(LED)}
    lanes = jj.rollout(sound, sound.example, parameters=parameters, ts=[0.1], backend=backend)
    assert lanes.result.tolist() == [*[results.BAD_PARAMETER] * len(LED), results.SUCCESS]
    for k, (name, fault) in enumerate(LED.items()):
        wrong = sound.replace(**{name: 0.1})
        refused(fault.split("`")[1], jj.simulate, wrong, ts=[0.1], backend=backend)
        assert fault in lanes.lane(k).message
        assert int(compiled(wrong, backend)[0]) == results.BAD_PARAMETER
    assert int(compiled(sound, backend)[0]) == results.SUCCESS
