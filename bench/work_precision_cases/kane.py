"""Two scenes in SymPy's `KanesMethod`, in speeds that leave no row over, as an expert of it would choose
them.

The equations come as `M(q) udot = f(q, u)` with `qdot(q, u)`. Source of the method: T. R. Kane and D. A.
Levinson, Dynamics (1985).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

try:
    import sympy as sp
    import sympy_systems
    from sympy.physics import mechanics as me
except ImportError:
    sp = me = None


@dataclass(frozen=True)
class KaneEquations:
    """Expressions of SymPy, numbers of the parameters, and the change of speeds from and to the engine's
    minimal state.
    """

    q: list
    kane: object  # `u`, `mass_matrix`, `forcing`
    qdot: list
    parameters: dict  # symbol -> number
    from_minimal: Callable
    to_minimal: Callable


def tilting_disc(scene) -> KaneEquations:
    """Speeds: components of the disc's angular velocity along the heading, the axle and the radius to the
    contact.
    """
    kane, _, _ = sympy_systems.rolling_disc()
    kane.kanes_equations()
    x, y = me.dynamicsymbols("x y")
    yaw, _, spin = kane.q
    rates = kane.kindiffdict()
    m, a, g = (getattr(sympy_systems, name) for name in "mrg")
    forward = a * rates[spin.diff()]
    along = forward * sp.cos(yaw), forward * sp.sin(yaw)
    numbers = {m: float(scene.mass), a: float(scene.radius), g: float(scene.gravity)}

    def from_minimal(s):
        yaw_rate, lean_rate, spin_rate = s[5:]
        return np.concatenate(
            [s[:5], [lean_rate, spin_rate + yaw_rate * np.sin(s[3]), yaw_rate * np.cos(s[3])]]
        )

    def to_minimal(s):
        yaw_rate = s[7] / np.cos(s[3])
        return np.concatenate([s[:5], [yaw_rate, s[5], s[6] - yaw_rate * np.sin(s[3])]])

    qdot = [*along, *(rates[angle.diff()] for angle in kane.q)]
    return KaneEquations([x, y, *kane.q], kane, qdot, numbers, from_minimal, to_minimal)


def chaplygin_sleigh(scene) -> KaneEquations:
    """Speeds: of the blade along itself, and the turn rate."""
    x, y, turn, v, w = me.dynamicsymbols("x y turn v w")
    m, inertia, a = sp.symbols("m I a", positive=True)
    space = me.ReferenceFrame("S")
    body_frame = space.orientnew("B", "Axis", [turn, space.z])
    body_frame.set_ang_vel(space, w * space.z)
    blade = me.Point("P")
    blade.set_vel(space, v * body_frame.x)
    centre = blade.locatenew("C", a * body_frame.x)
    centre.v2pt_theory(blade, space, body_frame)
    body = me.RigidBody("sleigh", centre, body_frame, m, (me.inertia(body_frame, 0, 0, inertia), centre))
    kane = me.KanesMethod(space, [turn], [v, w], [turn.diff() - w])
    kane.kanes_equations([body])
    c, s = sp.cos(turn), sp.sin(turn)
    qdot = [v * c - a * w * s, v * s + a * w * c, w]
    offset = float(scene.offset)
    numbers = {m: float(scene.mass), inertia: float(scene.inertia), a: offset}

    def from_minimal(z):  # x, y, heading, x_rate, y_rate
        c, s = np.cos(z[2]), np.sin(z[2])
        return np.array([*z[:3], c * z[3] + s * z[4], (c * z[4] - s * z[3]) / offset])

    def to_minimal(z):
        c, s = np.cos(z[2]), np.sin(z[2])
        return np.array([*z[:3], z[3] * c - offset * z[4] * s, z[3] * s + offset * z[4] * c])

    return KaneEquations([x, y, turn], kane, qdot, numbers, from_minimal, to_minimal)


SCENES = {"tilting-disc": tilting_disc, "chaplygin-sleigh": chaplygin_sleigh}
