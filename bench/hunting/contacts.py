"""Contacts with friction: one body in space that flies, rolls, slips and strikes on a ground that may move,
against `tests/oracles/body_on_ground.py`.
"""

import jax.numpy as jnp
from oracles.body_on_ground import MOST, axes, followed

import jourdain_jax as jj
from hunting.family import Ask, Family, G, drawn, one_by_one, one_of


class Thrown(jj.Scene):
    """A body of unit mass, pushed along x and turned about its axle; a ground that turns and heaves, and is a
    belt where it is plane.
    """

    i_x: object = jj.parameter(0.002)
    i_y: object = jj.parameter(0.002)
    i_z: object = jj.parameter(0.002)
    c_x: object = jj.parameter(0.0)
    c_y: object = jj.parameter(0.0)
    c_z: object = jj.parameter(0.0)
    a: object = jj.parameter(0.1)
    b: object = jj.parameter(0.1)
    c: object = jj.parameter(0.1)
    friction: object = jj.parameter(0.3)
    bounce: object = jj.parameter(0.0)
    push: object = jj.parameter(0.0)
    torque: object = jj.parameter(0.0)
    slope: object = jj.parameter(0.0)
    belt: object = jj.parameter(0.0)
    spin: object = jj.parameter(0.0)
    heave: object = jj.parameter(0.0)
    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))
    shape, ground, impact = "ball", "plane", "moreau"

    def bodies(self, t, q):
        inertia, R = jnp.stack([self.i_x, self.i_y, self.i_z]), jj.quaternion_to_matrix(q.attitude)
        return {"body": jj.RigidBody(1.0, inertia, jnp.stack([q.x, q.y, q.z]), R)}

    def loads(self, motion):
        turns = {"attitude_omega_y": self.torque * jnp.cos(2 * motion.t)}
        push = jj.generalized_force(motion, x_rate=self.push * jnp.sin(3 * motion.t), **turns)
        return jj.gravity(motion, G), push

    def contacts(self, pose):
        up, along, axis = axes(self, jnp)
        lift, rise = self.heave * jnp.sin(5 * pose.t), 5 * self.heave * jnp.cos(5 * pose.t)
        moves = {"origin": lift * up, "velocity": rise * up, "angular_velocity": self.spin * axis}
        side = self.ground.split()[0] + "side"
        if self.ground == "plane":
            moves["velocity"] += self.belt * along
            ground = jj.Plane(tilt=self.slope, **moves)
        elif "cylinder" in self.ground:
            ground = jj.Cylinder(1.0, axis, side=side, **moves)
        else:
            ground = jj.Sphere(1.0, side=side, **moves)
        law = {"friction": self.friction, "restitution": self.bounce, "impact": self.impact}
        law |= {"ground": ground, "height": "row", "centre": jnp.stack([self.c_x, self.c_y, self.c_z])}
        sizes = {"ellipsoid": [jnp.stack([self.a, self.b, self.c])], "wheel": [self.a, self.b / 4]}
        contact = getattr(jj, f"{self.shape}_contact")
        return {"c": contact(pose["body"], *sizes.get(self.shape, [self.a]), **law)}


HEIGHTS = {"plane": (0.3, 0.5), "in": (-0.7, -0.5), "out": (1.3, 1.5)}
EITHER = one_of(0.0, (-0.02, 0.02))
LAW = {
    "x": 0.0, "a": (0.07, 0.15), "b": (0.07, 0.15), "c": (0.07, 0.15), "i_x": (0.002, 0.0035),
    "i_y": (0.002, 0.0035), "i_z": (0.002, 0.0035), "friction": one_of(0.0, (0.05, 0.5), (0.3, 1.5)),
    "bounce": one_of(0.0, (0.1, 0.8)), "push": one_of(0.0, (-6, 6)), "torque": EITHER, "t0": 0.0,
    "slope": one_of(0.0, (-0.3, 0.3)), "belt": one_of(0.0, (-1, 1)), "heave": one_of(0.0, (0.0, 0.04)),
    "x_rate": (-1.5, 1.5), "z_rate": (-0.5, 0.5), "attitude_omega_y": one_of((-2, 2), (-15, 15)),
    "attitude_w": (-1, 1), "attitude_y": (-1, 1), "c_x": EITHER, "c_z": EITHER,
    "span": one_of(0.7, (0.5, 1.2)),
}  # fmt: skip
ASIDE = {
    "y": (-0.2, 0.2), "y_rate": (-1.5, 1.5), "attitude_x": (-1, 1), "attitude_z": (-1, 1), "c_y": EITHER,
    "attitude_omega_x": (-15, 15), "attitude_omega_z": (-15, 15), "spin": one_of(0.0, (-3, 3)),
}  # fmt: skip


def _drawn(shape, ground, impact):
    """Draws. Unless impacts are Moreau's, balls are alike all around and discs stay upright: slip keeps its
    line.
    """
    more = ASIDE if impact == "moreau" or shape == "ball" else dict.fromkeys(ASIDE, 0.0)
    alike = {"i_y": lambda r, n: n.i_x, "i_z": lambda r, n: n.i_x} | dict.fromkeys(("c_x", "c_y", "c_z"), 0.0)
    alike = alike if impact != "moreau" and shape == "ball" else {}
    return drawn(**LAW | more | alike | {"z": HEIGHTS[ground.split()[0]]})


def _attitude(n):
    q = {x: getattr(n, f"attitude_{x}") for x in "wxyz"}
    return {f"attitude_{x}": value / sum(v**2 for v in q.values()) ** 0.5 for x, value in q.items()}


WAYS = ("simulate", "jit", "vmap", "rollout")
KINDS = (
    ("ball", "plane", "moreau", 8),
    ("disc", "plane", "moreau", 8),
    ("ellipsoid", "plane", "moreau", 8),
    ("ball", "in a sphere", "poisson", 6),
    ("ball", "out of a sphere", "moreau", 8),
    ("disc", "in a sphere", "moreau", 6),
    ("wheel", "out of a sphere", "moreau", 6),
    ("ball", "in a cylinder", "energetic", 6),
    ("ball", "out of a cylinder", "newton", 8),
    ("disc", "plane", "poisson", 6),
    ("disc", "plane", "energetic", 6),
)


def _family(shape, ground, impact, cases):
    scene = type(shape, (Thrown,), {"shape": shape, "ground": ground, "impact": impact})

    def follow(n, ts):
        return followed(n, ts, shape, ground, impact)

    return Family(
        name=f"{shape}, {ground}, {impact}", what=f"{shape} with friction, {ground}; impacts: {impact}",
        scene=scene, truth=one_by_one(follow), start=_attitude,
        draw=_drawn(shape, ground, impact),
        names=" ".join((*Thrown.coordinates.names.entries, *Thrown.coordinates.default_speeds.entries)),
        asks=tuple(
            Ask(WAYS[(i + len(ground)) % 4], (1, 33)[i % 2], (1e-6, 1e-8)[i % 2], {"max_transitions": MOST})
            for i in range(4)
        ),
        cases=cases,
    )  # fmt: skip


FAMILIES = tuple(_family(*kind) for kind in KINDS)
