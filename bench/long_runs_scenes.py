"""Scenes for long runs: nonholonomic oscillators with integrals that are known exactly. Unit masses,
stiffnesses and frequencies throughout.

Sources: R. McLachlan and M. Perlmutter, J. Nonlinear Sci. 16 (2006) 283 (contact oscillator, chaotic
oscillator); K. Modin and O. Verdier, What makes nonholonomic integrators work?, Numer. Math. 145 (2020) 405,
arXiv 1707.04514 (the twin, the transmission: its numbers here are our own choice).
"""

import jax.numpy as jnp

import jourdain_jax as jj


class Point(jj.Scene):
    """A unit particle in space."""

    coordinates = jj.coordinates("x y z")

    def bodies(self, t, q):
        return {"particle": jj.Particle(1.0, q.array)}


class ContactOscillator(Point):
    """A unit particle with the row `xdot + y zdot = 0` and V = (x^2 + y^2 + z^2 + strength x^2 z^2)/2.

    y feels neither the row nor the coupling: it swings by itself, and (y^2 + ydot^2)/2 is an integral for
    every strength.
    """

    strength: object = jj.parameter(0.3, about="eps, of the coupling of x and z")

    privileged = ("y_rate", "z_rate")
    example = {"x": 1.0, "y": 1.0, "z": 0.0, "y_rate": 0.3, "z_rate": 0.5}
    example_span = 10.0

    def potential(self, pose):
        q = pose.q
        return (q.x**2 + q.y**2 + q.z**2 + self.strength * q.x**2 * q.z**2) / 2

    def velocity_constraints(self, motion):
        return {"contact": motion.u.x_rate + motion.q.y * motion.u.z_rate}

    def invariants(self, motion):
        return {"driver": (motion.q.y**2 + motion.u.y_rate**2) / 2}


class GaugeTwin(ContactOscillator):
    """The contact oscillator with L = T - V - d(cos z)/dt: the same motion, another Lagrangian."""

    def gauge(self, pose):
        return jnp.cos(pose.q.z)


class ChaoticOscillator(jj.Scene):
    """n = 3 contact oscillators on one row `xdot + sum y_i zdot_i = 0`, V = (|q|^2 + z1^2 z2^2 + sum y_i^2
    z_i^2)/2; the start is our choice.
    """

    coordinates = jj.coordinates("x y1 y2 y3 z1 z2 z3")
    privileged = ("y1_rate", "y2_rate", "y3_rate", "z1_rate", "z2_rate", "z3_rate")
    example = {"x": 1.0, "y1": 0.6, "y2": 0.4, "y3": 0.2, "z1": 1.0, "z2": 1.0, "z3": 1.0}
    example |= {"y1_rate": 0.8, "z2_rate": 0.3}
    example_span = 10.0

    def bodies(self, t, q):
        places = {"first": q.array[:3], "second": q.array[3:6], "third": [q.z3, 0.0, 0.0]}
        return {name: jj.Particle(1.0, place) for name, place in places.items()}

    def potential(self, pose):
        q = pose.q.array
        y, z = q[1:4], q[4:]
        return (q @ q + z[0] ** 2 * z[1] ** 2 + (y**2) @ (z**2)) / 2

    def velocity_constraints(self, motion):
        q, u = motion.q.array, motion.u.array
        return {"contact": u[0] + q[1:4] @ u[4:]}


class Transmission(Point):
    """A pendulum y that drives a continuously variable transmission `xdot + f(y) zdot = 0` between two
    oscillators x, z.

    V = (x^2 + z^2)/2 + 1 - cos y - asymmetry sin(2y)/2, f = y + bend y^2. The energies of the pendulum and of
    the oscillators are both integrals. With asymmetry or bend no reflection of y helps an integrator that is
    only symmetric in time.
    """

    asymmetry: object = jj.parameter(0.2)
    bend: object = jj.parameter(0.3)

    privileged = ("y_rate", "z_rate")
    example = {"x": 1.0, "y": 1.2, "z": 0.0, "z_rate": 0.5}
    example_span = 10.0

    def potential(self, pose):
        q = pose.q
        return (q.x**2 + q.z**2) / 2 + self._driver(q.y)

    def velocity_constraints(self, motion):
        y = motion.q.y
        return {"transmission": motion.u.x_rate + (y + self.bend * y**2) * motion.u.z_rate}

    def invariants(self, motion):
        return {"driver": motion.u.y_rate**2 / 2 + self._driver(motion.q.y)}

    def _driver(self, y):
        return 1 - jnp.cos(y) - self.asymmetry * jnp.sin(2 * y) / 2
