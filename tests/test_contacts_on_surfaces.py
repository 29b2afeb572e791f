"""Bodies that roll on planes, cylinders, spheres, surfaces and height maps; and what cannot be a contact,
which is refused by name.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import whipple_bicycle
from refusals import refused
from rolling_scenes import GRAVITY, GROUNDS, BallInBowl, BallInDrum, Rolls, RouthSphere, TyredBicycle
from tolerances import DRIFT, ROUND_OFF

import jourdain_jax as jj
from jourdain_jax.program.eager import eval_numpy

# Bodies that roll on planes, cylinders, spheres, surfaces and height maps: where they touch, how they move,
# and what presses them.


SHAPES = ("ball", "ellipsoid", "disc", "wheel")


def poses(scene, count):
    """Random coordinates of a free body; near the ground, but not on it."""
    random = np.random.default_rng(7)
    place = random.uniform(-1, 1, (count, 3))
    if scene.shape_of_ground == "plane":
        place = 0.1 * place
    elif "cylinder" in scene.shape_of_ground or "sphere" in scene.shape_of_ground:
        axis = np.array([2.0, 1.0, 2.0]) / 3 if "cylinder" in scene.shape_of_ground else np.zeros(3)
        radial = place - np.outer(place @ axis, axis)
        radial *= (0.52 if scene.shape_of_ground.startswith("on") else 0.43) / np.linalg.norm(radial, axis=1)[
            :, None
        ]
        place = radial + 0.2 * np.outer(random.uniform(-1, 1, count), axis)
    elif scene.shape_of_ground == "on a hill":
        place = place * np.array([0.3, 0.3, 0.02]) + np.array([0.0, 0.0, 0.13])
    else:
        place *= 0.55 / np.linalg.norm(place, axis=1)[:, None]
    return np.hstack([place, random.normal(size=(count, 4))])


def rolling(ground, shape):
    scene = Rolls(make_ground=GROUNDS[ground], shape=shape, moments=(0.3, 0.4, 0.35))
    object.__setattr__(scene, "shape_of_ground", ground)
    return scene


def outside(scene, place, R, point):
    """A function that is zero on the body's surface and grows outwards, at a point; of a disc: off its edge,
    and off its plane.
    """
    x, y, z = R.T @ (point - place)
    a = scene.radius
    if scene.shape == "ball":
        return x**2 + y**2 + z**2 - a**2
    if scene.shape == "ellipsoid":
        return x**2 / a**2 + y**2 / (0.8 * a) ** 2 + z**2 / (0.6 * a) ** 2 - 1
    r = scene.tyre if scene.shape == "wheel" else 0.0
    return (jnp.sqrt(x**2 + z**2) - (a - r)) ** 2 + y**2 - r**2


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("ground", GROUNDS)
def test_body_and_ground_are_nearest_where_their_normals_are_opposite(ground, shape):
    scene = rolling(ground, shape)

    @eval_numpy  # compiling it takes seconds
    @jax.vmap
    def miss(q):
        pose = jj.pose_at(scene, 0.0, q)
        contact, earth, body = scene.contacts(pose)["touch"], scene.make_ground(scene, pose), pose["body"]
        n, foot = contact.plane.normal, contact.point - contact.gap() * contact.plane.normal
        slope = jax.grad(earth.value)(foot)
        of_body = lambda p: outside(scene, body.position, body.orientation, p)
        outward = jax.grad(of_body)(contact.point)
        outward = outward / jnp.sqrt(outward @ outward)
        if shape == "disc":  # an edge has normals all round: nothing along the edge
            arm = contact.point - body.position
            outward, off = (
                -n,
                jnp.stack(
                    [
                        arm @ arm - scene.radius**2,
                        arm @ body.orientation[:, 1],
                        n @ jnp.cross(body.orientation[:, 1], arm),
                        (n @ arm > 0) + 0.0,
                    ]
                ),
            )
        else:
            off = of_body(contact.point)[None]
        axes = contact.plane.axes
        parts = [
            earth.value(foot)[None],
            n - slope / jnp.sqrt(slope @ slope),
            outward + n,
            off,
            (axes.T @ axes - jnp.eye(3)).ravel(),
            jnp.linalg.det(axes)[None] - 1,
        ]
        return jnp.concatenate(parts), contact.gap()

    error, gap = miss(poses(scene, 8))
    assert np.max(np.abs(error)) <= ROUND_OFF
    assert np.all(np.isfinite(gap))
    assert np.max(np.abs(gap)) > 1e-3


MOVING = [(ground, "ball") for ground in GROUNDS if "hill" not in ground and "egg" not in ground] + [
    ("within a sphere", "wheel"),
    ("plane", "ellipsoid"),
]
MOVING += [("on a hill", "ball")]  # by Newton's method: its derivatives take long to compile
MOVING += [
    ("within a cylinder", "wheel"),
    ("on a hill", "disc"),
    ("on an egg", "ball"),
    ("on an egg", "ellipsoid"),
]


@pytest.mark.parametrize("spin", [0.0, 12.0])
def test_a_ball_circles_in_a_bowl_at_the_rate_of_its_slope_and_spin(spin):
    # (1 + k) l cos(theta) W^2 + k a w_n W = g, k = 2/5: Routh's equations with n turning at W
    bowl = BallInBowl()
    a, length, theta = float(bowl.radius), float(bowl.bowl - bowl.radius), 0.3
    W = np.roots([1.4 * length * np.cos(theta), 0.4 * a * spin, -GRAVITY]).max()
    x, normal = length * np.sin(theta), np.array([-np.sin(theta), 0.0, np.cos(theta)])
    velocity = np.array([0.0, W * x, 0.0])
    turn = np.cross(normal, velocity) / a + spin * normal
    motion = jj.simulate(
        bowl,
        {"x": x, "y_rate": velocity[1], "attitude_omega": turn},
        ts=np.linspace(0.0, 2.0, 9),
        rtol=1e-11,
        atol=1e-11,
    )
    assert np.allclose(motion["x"], x * np.cos(W * motion.ts), atol=1e-8)
    assert np.allclose(motion["y"], x * np.sin(W * motion.ts), atol=1e-8)
    # N: weight and the acceleration to the middle of the circle, along n
    force = motion.contact_forces()["bowl"]
    assert np.allclose(
        force.normal, bowl.mass * (GRAVITY * np.cos(theta) + W**2 * x * np.sin(theta)), rtol=1e-8
    )


def test_a_ball_in_an_upright_cylinder_rises_again_with_the_rate_of_the_golf_ball():
    # z = -5 g/(2 W^2) (1 - cos(sqrt(2/7) W t)): the ball sinks and comes back up
    W = 6.0
    drum = BallInDrum()
    turn = -W * (drum.drum - drum.radius) / drum.radius  # about the axis: the wall does not slip
    motion = jj.simulate(
        drum,
        {"angle": 0.4, "angle_rate": W, "attitude_omega": (0.0, 0.0, float(-turn))},
        ts=np.linspace(0.0, 4.0, 9),
        rtol=1e-11,
        atol=1e-11,
    )
    expected = -5 * GRAVITY / (2 * W**2) * (1 - np.cos(np.sqrt(2 / 7) * W * np.asarray(motion.ts)))
    assert np.allclose(motion["along"], expected, atol=1e-8)
    assert np.allclose(
        motion.contact_forces()["wall"].normal, drum.mass * W**2 * (drum.drum - drum.radius), rtol=1e-8
    )


def test_rouths_sphere_keeps_the_integrals_of_jellett_and_routh():
    motion = jj.simulate(
        RouthSphere(),
        {"attitude": jj.quaternion_from_axis_angle((0.6, 0.8, 0.0), 0.9), "attitude_omega": (1.0, 2.0, 9.0)},
        t1=3.0,
        rtol=1e-11,
        atol=1e-11,
    )
    drifts = jj.diagnose(motion).invariant_drifts
    assert max(float(drift) for drift in drifts.values()) <= DRIFT
    assert jj.diagnose(motion).energy_drift <= DRIFT


def test_a_bicycle_with_tyres_is_the_whipple_bicycle_whose_wheels_widen():
    # a tyre adds r N lean^2/2 of its wheel to the potential: K0 + N_R r_R (1, 0)(1, 0)' + N_F r_F (1, sin
    # lam)(1, sin lam)'
    loads, v, across = whipple_bicycle.WHEEL_LOADS, 5.0, np.array([1.0, np.sin(np.pi / 10)])
    for rear, front in ((0.0, 0.0), (0.03, 0.02), (0.1, 0.06)):
        K0 = whipple_bicycle.K0 + loads["rear"] * rear / 9.81 * np.diag([1.0, 0.0])
        K0 += loads["front"] * front / 9.81 * np.outer(across, across)
        expected = np.linalg.eigvals(whipple_bicycle.state_matrix(v, k0=K0))
        bicycle = TyredBicycle(rear_tyre=rear, front_tyre=front)
        found = np.asarray(
            jj.linearize(bicycle, bicycle.upright(v), coordinates=("lean", "steer")).eigenvalues()
        )
        nearest = np.min(np.abs(expected[:, None] - found[None, :]), axis=1)
        assert np.max(nearest) <= 1e-8 * np.max(np.abs(expected))


# What cannot be a contact is refused by name: where it is known at once, otherwise when a scene is looked at.


@pytest.mark.parametrize(
    ("ground", "sentence"),
    [
        (
            lambda scene, pose: jj.Plane(
                normal=jnp.stack([0.0 * scene.size, 0.0 * scene.size, 2.4 * scene.size])
            ),
            "the normal of contact `touch` of `Rolls` has a length that differs from 1 by 0.2",
        ),
        (
            lambda scene, pose: jj.Sphere(0.09 * scene.size, side="inside"),
            "a ball is larger than its hollow cylinder or sphere",
        ),
    ],
    ids=["normal", "room"],
)
def test_what_turns_out_to_be_no_ground_is_named_when_its_scene_is_looked_at(ground, sentence):
    refused(sentence, jj.structure_of, Rolls(make_ground=ground))


class BesideTheBowl(BallInBowl):
    """A ball whose coordinates keep it at a wrong height above the bowl."""

    def bodies(self, t, q):
        ball = super().bodies(t, q)["ball"]
        return {
            "ball": jj.RigidBody.ball(
                ball.mass,
                self.radius,
                position=ball.position + jnp.array([0.0, 0.0, 0.01]),
                orientation=ball.orientation,
            )
        }


class TooLarge(BallInBowl):
    """A ball that is larger than its bowl."""

    def contacts(self, pose):
        return {
            "bowl": jj.ball_contact(
                pose["ball"], self.radius, ground=jj.Sphere(0.9 * self.radius, side="inside")
            )
        }


class OnACusp(BallInBowl):
    """A ball at a point of a surface where its gradient vanishes."""

    def contacts(self, pose):
        point = pose["ball"].position
        return {
            "bowl": jj.Contact(
                pose["ball"], point, jj.Surface(lambda x, y, z: (z - point[2]) ** 3).plane_at(point)
            )
        }


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (
            TooLarge(),
            (
                "contact `bowl` of `TooLarge` has no point where body and ground touch at any probed state;"
                " make a ball smaller"
            ),
        ),
        (OnACusp(), "contact `bowl` of `OnACusp` (finds no point|has a length that differs from 1)"),
    ],
)
def test_a_contact_that_touches_nowhere_is_named(scene, sentence):
    refused(sentence, jj.structure_of, scene)


def test_coordinates_that_do_not_keep_a_body_on_its_ground_are_named():
    refused(
        r'contact `bowl` of `BesideTheBowl` has height="coordinates", but at a probed state its body is'
        r" -?0.0.* m off",
        jj.simulate,
        BesideTheBowl(),
        {},
        t1=0.1,
    )


def test_a_plane_turned_by_a_rotation_is_the_plane_of_its_normal():
    def parts(angle):
        for turn in (jj.rot_x, jj.rot_y, jj.rot_z):
            R = turn(angle) @ jj.rot_y(0.2)
            yield [
                (plane.normal, plane.tangents, plane.axes)
                for plane in (jj.Plane(tilt=R), jj.Plane(normal=R[:, 2], along=R[:, 0]))
            ]

    for turned, by_normal in eval_numpy(lambda angle: list(parts(angle)))(0.4):
        for part, expected in zip(turned, by_normal, strict=True):
            assert np.allclose(part, expected, atol=1e-15)


def test_the_tangents_of_any_normal_are_a_right_handed_frame():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.vstack([normals / np.linalg.norm(normals, axis=1)[:, None], np.eye(3), -np.eye(3)])
    axes = eval_numpy(jax.vmap(lambda n: jj.Plane(normal=n).axes))(normals)
    assert np.allclose(np.swapaxes(axes, 1, 2) @ axes, np.eye(3), atol=1e-14)
    assert np.allclose(np.linalg.det(axes), 1.0)
    assert np.allclose(axes[:, :, 2], normals)
