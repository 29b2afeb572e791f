"""Scenes of bodies that roll on any ground, for the tests of contacts: free bodies with height rows, and
carts on balls.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj

GRAVITY = 9.81
PLACE = {"x": (-0.3, 0.3), "y": (-0.3, 0.3), "z": (-0.3, 0.3)}


class Rolls(jj.Scene):
    """A free body that rolls on a ground which `make_ground` gives for this scene, with a height row.
    `shape`: "ball", "ellipsoid", "disc" or "wheel".
    """

    mass: object = jj.parameter(1.3)
    radius: object = jj.parameter(0.05)
    tyre: object = jj.parameter(0.01)
    moments: object = jj.parameter((0.4, 0.4, 0.4))  # over m a^2
    size: object = jj.parameter(0.5)  # of the ground
    shape: str = eqx.field(static=True, default="ball")
    make_ground: object = eqx.field(static=True, default=None)

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))
    domain = PLACE

    def bodies(self, t, q):
        moments = self.moments * self.mass * self.radius**2
        return {
            "body": jj.RigidBody(self.mass, moments, [q.x, q.y, q.z], jj.quaternion_to_matrix(q.attitude))
        }

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def contacts(self, pose):
        return {"touch": self.contact(pose, self.make_ground(self, pose))}

    def contact(self, pose, ground, height="row"):
        body, a = pose["body"], self.radius
        if self.shape == "ball":
            return jj.ball_contact(body, a, ground=ground, height=height)
        if self.shape == "ellipsoid":
            return jj.ellipsoid_contact(body, a * jnp.array([1.0, 0.8, 0.6]), ground=ground, height=height)
        if self.shape == "disc":
            return jj.disc_contact(body, a, ground=ground, height=height)
        return jj.wheel_contact(body, a, self.tyre, ground=ground, height=height)


def hill(x, y):
    """Height (m) of a smooth hill."""
    return 0.06 * jnp.cos(2.0 * x) + 0.04 * jnp.sin(3.0 * y + 0.4) + 0.03 * x * y


def egg(x, y, z):
    """Positive outside of an ellipsoid with one blunt end."""
    return x**2 / 0.25 + y**2 / 0.2 + z**2 / 0.16 + 0.4 * z * x**2 - 1.0


AXIS = np.array([2.0, 1.0, 2.0]) / 3.0
GROUNDS = {
    "plane": lambda scene, pose: jj.Plane(normal=jnp.array([1.0, 2.0, 2.0]) / 3.0),
    "within a cylinder": lambda scene, pose: jj.Cylinder(scene.size, AXIS, side="inside"),
    "on a cylinder": lambda scene, pose: jj.Cylinder(scene.size, AXIS, side="outside"),
    "within a sphere": lambda scene, pose: jj.Sphere(scene.size, side="inside"),
    "on a sphere": lambda scene, pose: jj.Sphere(scene.size, side="outside"),
    "on a hill": lambda scene, pose: jj.HeightMap(hill),
    "on an egg": lambda scene, pose: jj.Surface(egg),
}


class Cart(jj.Scene):
    """A chassis on balls that roll on a plane, kept level by its coordinates; pushed at a point of the
    chassis.
    """

    places: object = jj.parameter(((0.5, 0.3), (0.5, -0.3), (-0.4, 0.0)))  # m, of the balls in the chassis
    load: object = jj.parameter(
        (0.05, 0.02, 0.3)
    )  # m, mass centre of the chassis above the plane of the balls' centres
    mass: object = jj.parameter(10.0)
    slope: object = jj.parameter(0.2)
    push: object = jj.parameter((3.0, -2.0, 1.0))  # N
    radius: object = jj.parameter(0.1)
    balls: int = eqx.field(static=True, default=3)

    coordinates = jj.coordinates("x y heading", *(jj.quaternion(f"ball{i}") for i in range(3)))

    def chassis(self, q):
        return jnp.stack([q.x, q.y, self.radius + 0.0 * q.x]), jj.rot_z(q.heading)

    def bodies(self, t, q):
        at, frame = self.chassis(q)
        made = {"chassis": jj.RigidBody(self.mass, jnp.array([0.5, 0.8, 1.0]), at + frame @ self.load, frame)}
        for i in range(self.balls):
            centre = at + frame @ jnp.append(self.places[i], 0.0)
            made[f"ball{i}"] = jj.RigidBody.ball(
                1.0, self.radius, position=centre, orientation=jj.quaternion_to_matrix(q[f"ball{i}"])
            )
        return made

    def loads(self, motion):
        down = jnp.stack([jnp.sin(self.slope), 0.0, -jnp.cos(self.slope)])
        return jj.gravity(motion, GRAVITY, down), jj.point_force(
            motion["chassis"].point((0.1, 0.2, 0.1)), self.push
        )

    def contacts(self, pose):
        return {
            f"ball{i}": jj.ball_contact(pose[f"ball{i}"], self.radius, height="coordinates")
            for i in range(self.balls)
        }


class BallInBowl(jj.Scene):
    """A ball in a spherical bowl, in the level coordinates of its centre; the height is built in."""

    mass: object = jj.parameter(0.7)
    radius: object = jj.parameter(0.05)
    bowl: object = jj.parameter(0.4)
    gravity: object = jj.parameter(GRAVITY)

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"))
    domain = {"x": (-0.15, 0.15), "y": (-0.15, 0.15)}

    def bodies(self, t, q):
        z = self.bowl - jnp.sqrt((self.bowl - self.radius) ** 2 - q.x**2 - q.y**2)
        return {
            "ball": jj.RigidBody.ball(
                self.mass,
                self.radius,
                position=[q.x, q.y, z],
                orientation=jj.quaternion_to_matrix(q.attitude),
            )
        }

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)

    def contacts(self, pose):
        o = 0.0 * self.bowl
        bowl = jj.Sphere(self.bowl, side="inside", origin=jnp.stack([o, o, self.bowl]))
        return {"bowl": jj.ball_contact(pose["ball"], self.radius, ground=bowl)}


class BallInDrum(jj.Scene):
    """A ball within an upright cylinder: angle around the axis, place along it; the gap is built in."""

    mass: object = jj.parameter(0.7)
    radius: object = jj.parameter(0.05)
    drum: object = jj.parameter(0.4)

    coordinates = jj.coordinates("angle along", jj.quaternion("attitude"))

    def bodies(self, t, q):
        arm = self.drum - self.radius
        centre = jnp.stack([arm * jnp.sin(q.angle), arm * jnp.cos(q.angle), q.along])
        return {
            "ball": jj.RigidBody.ball(
                self.mass, self.radius, position=centre, orientation=jj.quaternion_to_matrix(q.attitude)
            )
        }

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def contacts(self, pose):
        return {
            "wall": jj.ball_contact(
                pose["ball"], self.radius, ground=jj.Cylinder(self.drum, (0.0, 0.0, 1.0), side="inside")
            )
        }


class RouthSphere(jj.Scene):
    """A ball on a plane, its mass centre off its middle, along the axis of its inertia."""

    mass: object = jj.parameter(1.2)
    radius: object = jj.parameter(0.3)
    off: object = jj.parameter(0.08)
    moments: object = jj.parameter((0.03, 0.03, 0.05))

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"))

    def bodies(self, t, q):
        R = jj.quaternion_to_matrix(q.attitude)
        middle = jnp.stack([q.x, q.y, self.radius + 0.0 * q.x])
        return {"ball": jj.RigidBody(self.mass, self.moments, middle - self.off * R[:, 2], R)}

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def contacts(self, pose):
        return {"floor": jj.ball_contact(pose["ball"], self.radius, centre=jnp.stack([0.0, 0.0, self.off]))}

    def invariants(self, motion):
        # Jellett's and Routh's: L.r and w3 sqrt(A C + m r.I r), r from the contact to the mass centre
        ball = motion["ball"]
        r = ball.orientation.T @ (ball.position - self.contacts(motion.pose())["floor"].point)
        w, I = ball.angular_velocity_body, self.moments
        return {
            "Jellett": (I * w) @ r,
            "Routh": w[2] * jnp.sqrt(I[0] * I[2] + self.mass * jnp.sum(I * r * r)),
        }


class TyredBicycle(jj.models.WhippleBicycle):
    """The Whipple bicycle with tyres of circular section; x, y under the circle within the rear tyre."""

    rear_tyre: object = jj.parameter(0.0)
    front_tyre: object = jj.parameter(0.0)

    def bodies(self, t, q):
        up = (jj.rot_z(q.yaw) @ jj.rot_x(q.lean))[:, 2]
        raised = self.rear_tyre * (jnp.stack([0.0, 0.0, 1.0 + 0.0 * q.x]) - up)
        return {
            name: eqx.tree_at(lambda b: b.position, body, body.position + raised)
            for name, body in super().bodies(t, q).items()
        }

    def contacts(self, pose):
        return {
            "rear": jj.wheel_contact(pose["rear wheel"], self.rR, self.rear_tyre),
            "front": jj.wheel_contact(pose["front wheel"], self.rF, self.front_tyre, height="row"),
        }
