"""Systems of SymPy's mechanics for the tests of `from_sympy`, each with its origin and the values of its
constants.
"""

from sympy import Function, cos, sin, symbols
from sympy.physics.mechanics import (
    KanesMethod,
    Particle,
    Point,
    ReferenceFrame,
    RigidBody,
    cross,
    dot,
    dynamicsymbols,
    inertia,
)

m, length, g, r, k, c = symbols("m l g r k c", positive=True)
VALUES = {m: 1.3, length: 0.6, g: 9.81, r: 0.4, k: 7.0, c: 0.2}


def of(*symbols_used):
    """The values of some constants."""
    return {symbol: VALUES[symbol] for symbol in symbols_used}


def pendulum(load=None, mass=m, **changes):
    """A particle on a rod, with a torque on the rod that is an input, a damper, and a pivot moved by a given
    force; or with another load on the particle alone, `load(q, N)`.
    """
    q, u, torque = dynamicsymbols("q u torque")
    N, O = ReferenceFrame("N"), Point("O")
    A = N.orientnew("A", "Axis", [q, N.y])
    P = O.locatenew("P", -length * A.z)
    O.set_vel(N, 0)
    loads = [(P, -m * g * N.z), (A, (torque - c * q.diff() + sin(2 * dynamicsymbols._t)) * A.y)]
    options = {
        "kd_eqs": [q.diff() - u],
        "bodies": [Particle("bob", P, mass)],
        "forcelist": [(P, load(q, N))] if load else loads,
    }
    return KanesMethod(N, [q], [u], **(options | changes)), O, of(m, length, *(() if load else (g, c)))


pendulum_with = pendulum


def moved_pivot():
    """A particle that slides on a rail, which itself moves as nobody says."""
    q, u, pivot = dynamicsymbols("q u pivot")
    N, O = ReferenceFrame("N"), Point("O")
    P = O.locatenew("P", q * N.x + pivot * N.z)
    P.set_vel(N, u * N.x)
    return (
        KanesMethod(
            N, [q], [u], [q.diff() - u], bodies=[Particle("bob", P, m)], forcelist=[(P, -m * g * N.z)]
        ),
        O,
        of(m, g),
    )


def double_pendulum():
    """Two rods whose hinges are at right angles, with a spring on a tip that is no mass centre; a speed is no
    rate of a coordinate.
    """
    q1, q2, u1, u2 = dynamicsymbols("q1 q2 u1 u2")
    N, O = ReferenceFrame("N"), Point("O")
    A = N.orientnew("A", "Axis", [q1, N.x])
    B = A.orientnew("B", "Axis", [q2, A.y])
    G1, E = O.locatenew("G1", -length / 2 * A.z), O.locatenew("E", -length * A.z)
    G2, tip = E.locatenew("G2", -length / 2 * B.z), E.locatenew("tip", -length * B.z)
    O.set_vel(N, 0)
    rods = [
        RigidBody(
            f"rod {n}",
            G,
            F,
            m,
            (inertia(F, m * length**2 / 12, m * length**2 / 10, m * length**2 / 100, 0.01 * m), G),
        )
        for n, (F, G) in enumerate(((A, G1), (B, G2)), 1)
    ]
    pull = -k * tip.pos_from(O)
    loads = [
        (tip, pull),
        (G1, -m * g * N.z),
        (G2, -m * g * N.z),
        (B, -c * B.ang_vel_in(A)),
        (A, c * B.ang_vel_in(A)),
    ]
    kinematic = [q1.diff() - u1, q2.diff() * (2 + cos(q1)) - u2 - u1]
    return (
        KanesMethod(N, [q1, q2], [u1, u2], kinematic, bodies=rods, forcelist=loads),
        O,
        of(m, length, g, k, c),
    )


def _leaning(q1, q2):
    N = ReferenceFrame("N")
    Y = N.orientnew("Y", "Axis", [q1, N.z])
    return N, Y, Y.orientnew("L", "Axis", [q2, Y.x])


def _disc(G, R, L):
    return RigidBody("disc", G, R, m, (inertia(L, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4), G))


def rolling_disc():
    """A disc whose contact point has no velocity and no coordinates; the speeds are components of its angular
    velocity.
    """
    q1, q2, q3, u1, u2, u3 = dynamicsymbols("q1 q2 q3 u1 u2 u3")
    N, Y, L = _leaning(q1, q2)
    R = L.orientnew("R", "Axis", [q3, L.y])
    by_angles = R.ang_vel_in(N)
    R.set_ang_vel(N, u1 * L.x + u2 * L.y + u3 * L.z)
    C = Point("C")
    C.set_vel(N, 0)
    G = C.locatenew("G", r * L.z)
    G.v2pt_theory(C, N, R)
    kinematic = [dot(by_angles - R.ang_vel_in(N), axis) for axis in L]
    return (
        KanesMethod(
            N, [q1, q2, q3], [u1, u2, u3], kinematic, bodies=[_disc(G, R, L)], forcelist=[(G, -m * g * Y.z)]
        ),
        C,
        of(m, g, r),
    )


def slipping_disc():
    """A disc with two dependent speeds of the contact point, held at zero by rows; its spin has a speed and
    no angle.
    """
    q1, q2, u1, u2, u3, u4, u5 = dynamicsymbols("q1 q2 u1 u2 u3 u4 u5")
    N, Y, L = _leaning(q1, q2)
    R = ReferenceFrame("R")
    R.set_ang_vel(L, u3 * L.y)
    C = Point("C")
    C.set_vel(N, u4 * Y.x + u5 * cross(Y.z, L.x))
    G = C.locatenew("G", r * L.z)
    G.set_vel(N, C.vel(N) + cross(R.ang_vel_in(N), r * L.z))
    kinematic = [q1.diff() - u1, q2.diff() - u2]
    rows = [C.vel(N).dot(Y.x), C.vel(N).dot(Y.y)]
    options = {
        "u_dependent": [u4, u5],
        "velocity_constraints": rows,
        "bodies": [_disc(G, R, L)],
        "forcelist": [(G, -m * g * Y.z)],
    }
    return KanesMethod(N, [q1, q2], [u1, u2, u3], kinematic, **options), C, of(m, g, r)


def four_bar():
    """Three rods from one pivot to another: two geometric rows, and their rates, which SymPy wants as
    velocity rows.
    """
    q = dynamicsymbols("q1 q2 q3")
    u = dynamicsymbols("u1 u2 u3")
    N, O = ReferenceFrame("N"), Point("O")
    O.set_vel(N, 0)
    bodies, loads, end = [], [], O
    for n, (angle, factor) in enumerate(zip(q, (1, 2, 1.5), strict=True), 1):
        F = N.orientnew(f"F{n}", "Axis", [angle, N.z])
        G = end.locatenew(f"G{n}", factor * length / 2 * F.x)
        end = end.locatenew(f"E{n}", factor * length * F.x)
        bodies.append(
            RigidBody(
                f"rod{n}",
                G,
                F,
                m,
                (inertia(F, 0, m * (factor * length) ** 2 / 12, m * (factor * length) ** 2 / 12), G),
            )
        )
        loads.append((G, -m * g * N.y))
    rows = [end.pos_from(O).dot(N.x) - 2 * length, end.pos_from(O).dot(N.y)]
    options = {
        "q_dependent": q[1:],
        "configuration_constraints": rows,
        "u_dependent": u[1:],
        "velocity_constraints": [row.diff(dynamicsymbols._t) for row in rows],
    }
    kinematic = [angle.diff() - speed for angle, speed in zip(q, u, strict=True)]
    return (
        KanesMethod(N, q[:1], u[:1], kinematic, bodies=bodies, forcelist=loads, **options),
        O,
        of(m, length, g),
    )


def sleigh():
    """A blade with its mass centre ahead, whose velocity is stated without the part that the row holds at
    zero.
    """
    x, y, heading, u1, u2, u3 = dynamicsymbols("x y heading u1 u2 u3")
    N, O = ReferenceFrame("N"), Point("O")
    A = N.orientnew("A", "Axis", [heading, N.z])
    O.set_vel(N, 0)
    blade = O.locatenew("blade", x * N.x + y * N.y)
    G = blade.locatenew("G", length * A.x)
    forward = u1 * cos(heading) + u2 * sin(heading)
    blade.set_vel(N, forward * A.x)
    G.set_vel(N, forward * A.x + u3 * length * A.y)
    body = RigidBody("sleigh", G, A, m, (inertia(A, m, m, m * length**2), G))
    kinematic = [x.diff() - u1, y.diff() - u2, heading.diff() - u3]
    options = {
        "u_dependent": [u2],
        "velocity_constraints": [u2 * cos(heading) - u1 * sin(heading)],
        "bodies": [body],
    }
    return (
        KanesMethod(N, [x, y, heading], [u1, u3], kinematic, forcelist=[(blade, k * N.x)], **options),
        O,
        of(m, length, k),
    )


def given_function(q, N):
    """A load by a function that nobody knows."""
    return Function("f")(q) * N.x


SYSTEMS = {
    f.__name__.replace("_", "-"): f
    for f in (pendulum, double_pendulum, rolling_disc, slipping_disc, sleigh, four_bar)
}
