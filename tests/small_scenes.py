"""Small scenes, each with one feature that the analysis must recognise."""

import jax.numpy as jnp

import jourdain_jax as jj


def name_of(given):
    """The name of a scene's class, by which cases of tests are called; none of what is no scene."""
    return type(given).__name__ if isinstance(given, jj.Scene) else ""


class OnLine(jj.Scene):
    """A mass on the x axis, of 1 kg where a scene states no other."""

    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"mass": jj.Particle(getattr(self, "mass", 1.0), [q.x, 0.0, 0.0])}


class OnPlane(jj.Scene):
    """A mass in the plane of x and y."""

    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"mass": jj.Particle(getattr(self, "mass", 1.0), [q.x, q.y, 0.0])}


class InSpace(jj.Scene):
    """A mass in space."""

    coordinates = jj.coordinates("x y z")

    def bodies(self, t, q):
        return {"mass": jj.Particle(getattr(self, "mass", 1.0), [q.x, q.y, q.z])}


class Upright(jj.Scene):
    """A mass in the upright plane of x and z."""

    coordinates = jj.coordinates("x z")

    def bodies(self, t, q):
        return {"mass": jj.Particle(getattr(self, "mass", 1.0), [q.x, 0.0, q.z])}


class DiscWithHeightRow(jj.Scene):
    """A disc with six coordinates that rolls without slip; its height is a row."""

    mass: float = jj.parameter(1.0, unit="kg", positive=True)
    radius: float = jj.parameter(0.5, unit="m", positive=True)
    gravity: float = jj.parameter(9.81, unit="m/s^2")
    coordinates = jj.coordinates("x y z yaw lean spin")
    domain = {"yaw": (-3.2, 3.2), "lean": (-1.2, 1.2), "spin": (-3.2, 3.2)}

    def bodies(self, t, q):
        turned = jj.rot_z(q.yaw) @ jj.rot_x(q.lean) @ jj.rot_y(q.spin)
        centre = jnp.stack([q.x, q.y, q.z])
        return {
            "disc": jj.RigidBody.thin_disc(
                self.mass, self.radius, axis="y", position=centre, orientation=turned
            )
        }

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)

    def contacts(self, pose):
        return {"rim": jj.disc_contact(pose["disc"], self.radius, axis="y", height="row")}


class Bead(jj.Scene):
    """A bead on a plane."""

    mass: object = jj.parameter(1.0, unit="kg", positive=True)
    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, [q.x, q.y, 0.0])}


class BeadOnTurningWire(jj.Scene):
    """A bead on a straight wire that is turned at a given rate about the vertical: pose given as a function
    of time.
    """

    mass: float = jj.parameter(0.6, unit="kg", positive=True)
    rate: float = jj.parameter(1.7, unit="rad/s")
    damping: float = jj.parameter(0.0, unit="N s/m")
    coordinates = jj.coordinates("r")
    domain = {"r": (0.2, 1.0)}

    def bodies(self, t, q):
        angle = self.rate * t
        return {"bead": jj.Particle(self.mass, q.r * jnp.stack([jnp.cos(angle), jnp.sin(angle), 0.0]))}

    def loads(self, motion):
        return jj.generalized_force(motion, r_rate=-self.damping * motion.u.r_rate)


class DrivenPendulum(jj.Scene):
    """A pendulum whose pivot is driven sideways as a given function of time, by a prescribed coordinate;
    damped and sprung.
    """

    mass: float = jj.parameter(0.8, unit="kg", positive=True)
    length: float = jj.parameter(0.9, unit="m", positive=True)
    stiffness: float = jj.parameter(5.0, unit="N/m")
    damping: float = jj.parameter(0.3, unit="N s/m")
    gravity: float = jj.parameter(9.81, unit="m/s^2")
    coordinates = jj.coordinates("pivot angle")
    domain = {"angle": (-1.0, 1.0)}

    def bodies(self, t, q):
        hang = self.length * jnp.stack([jnp.sin(q.angle), 0.0, -jnp.cos(q.angle)])
        pivot = jnp.stack([q.pivot, 0.0, 0.0])
        return {"cart": jj.Particle(0.5 * self.mass, pivot), "bob": jj.Particle(self.mass, pivot + hang)}

    def loads(self, motion):
        bob = motion["bob"].point()
        moving_end = jj.fixed_point(
            jnp.stack([jnp.cos(motion.t), 1.0 + 0.0 * motion.t, jnp.sin(3 * motion.t)])
        )
        return (
            jj.spring(bob, moving_end, self.stiffness, 0.2),
            jj.damper(bob, jj.fixed_point((0.0, 1.0, 0.0)), self.damping),
        )

    def potential(self, pose):
        return sum(body.mass * self.gravity * body.position[2] for body in pose.bodies.values())

    def prescribed(self, t):
        return {"pivot": 0.3 * jnp.sin(2.0 * t)}


class Goursat(jj.Scene):
    """Two particles with `q2dot = q3 q1dot`, `q3dot = q4 q1dot`, ...: brackets reach one new direction at a
    time.
    """

    coordinates = jj.coordinates("q1 q2 q3 q4 q5 q6")
    privileged = ("q1_rate", "q6_rate")

    def bodies(self, t, q):
        return {"first": jj.Particle(1.0, q.array[:3]), "second": jj.Particle(1.0, q.array[3:])}

    def velocity_constraints(self, motion):
        q, u = motion.q.array, motion.u.array
        return {f"row {k}": u[k] - q[k + 1] * u[0] for k in range(1, 5)}


class AffineRows(InSpace):
    """A particle with an integrable row that is not homogeneous, and one that differs from an integrable row
    by `strength`.
    """

    strength: float = jj.parameter(0.0)

    def velocity_constraints(self, motion):
        q, u = motion.q, motion.u
        # exp(t) (dx + x dt) is the differential of x exp(t); dy - strength z dx is none, whatever its factor
        return {"growing": u.x_rate + q.x, "sheet": u.y_rate - self.strength * q.z * u.x_rate}


class Oscillator(jj.Scene):
    """`m x'' = - c x' - k x`: mass and stiffness show only in their ratio where nothing else is known."""

    mass: float = jj.parameter(2.0, positive=True)
    damping: float = jj.parameter(0.3, non_negative=True)
    stiffness: float = jj.parameter(5.0, positive=True)
    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"cart": jj.Particle(self.mass, [q.x, 0.0, 0.0])}

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=-self.damping * motion.u.x_rate - self.stiffness * motion.q.x
        )


class Cart(Oscillator):
    """`m x'' = push - c x' - k x`."""

    mass: float = jj.parameter(2.0, unit="kg", positive=True)
    damping: float = jj.parameter(0.6, unit="N s/m", non_negative=True)
    stiffness: float = jj.parameter(5.0, unit="N/m")
    inputs = jj.inputs("push")

    def loads(self, motion):
        return super().loads(motion), jj.generalized_force(motion, x_rate=motion.inputs.push)


class HoopBead(jj.Scene):
    """A bead on a hoop that turns about its vertical diameter."""

    radius: float = jj.parameter(0.5, unit="m", positive=True)
    turning: float = jj.parameter(3.0, unit="rad/s")
    coordinates = jj.coordinates("angle")
    domain = {"angle": (-3.0, 3.0)}

    def bodies(self, t, q):
        x, heading = self.radius * jnp.sin(q.angle), self.turning * t
        return {
            "bead": jj.Particle(
                0.2, jnp.stack([x * jnp.cos(heading), x * jnp.sin(heading), -self.radius * jnp.cos(q.angle)])
            )
        }

    def loads(self, motion):
        return jj.gravity(motion, 9.81)


class Twice(OnLine):
    """A particle on a spring and in a medium that both nearly give way at a place, by a closed form: twice,
    and 1 mm apart, or not at all.
    """

    push: float = jj.parameter(-0.1)
    place: float = jj.parameter(0.0123)
    apart: float = jj.parameter(1e-6)  # square of the distance
    damped: float = jj.parameter(1.0)

    def loads(self, motion):
        x = motion.q.x - self.place
        drag = self.damped + (1 - self.damped) * (12 * x**2 - 3 * self.apart)
        spring = self.damped * (x**3 - 0.75 * self.apart * x) + (1 - self.damped) * x
        return jj.generalized_force(motion, x_rate=self.push - drag * motion.u.x_rate - spring)


class DrivenSleigh(jj.models.ChaplyginSleigh):
    """A sleigh with drag, and a torque that changes its sign."""

    along: float = jj.parameter(0.15)
    turning: float = jj.parameter(0.05)
    torque: float = jj.parameter(0.6)

    def loads(self, motion):
        c, s, u = jnp.cos(motion.q.heading), jnp.sin(motion.q.heading), motion.u
        push = -self.along * (c * u.x_rate + s * u.y_rate)
        turn = self.torque * jnp.sin(2 * motion.t) - self.turning * u.heading_rate
        return jj.generalized_force(motion, x_rate=push * c, y_rate=push * s, heading_rate=turn)
