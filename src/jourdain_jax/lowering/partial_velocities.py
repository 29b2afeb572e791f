"""Derive scalar expressions for the velocities v, omega of the bodies, their partial velocities beta, gamma,
and their accelerations a_0, alpha_0 at ydot = 0.

*Explicit*: substitute the dependent speeds z(q, y) into the velocities, then differentiate. Best if z is
simple. *Implicit*: differentiate the velocities as functions of all speeds, and compute zdot from the
derivative of the constraints.
"""

from dataclasses import replace

import numpy as np

from jourdain_jax.lowering.elimination import eliminate
from jourdain_jax.program.derivative import columns, derivatives, directional_derivative, jacobian
from jourdain_jax.program.graph import NodeList
from jourdain_jax.program.polynomial import NormalForms

IN_EQUATIONS = ("mass", "inertia", "qdot", "force", "torque", "direct", "power")


class Kinematics:
    """Velocities, partial velocities and accelerations at ydot = 0. Coordinates in `held` are fixed."""

    def __init__(
        self,
        build,  # the `AppellOnGraph` of the scene
        forms: NormalForms,
        held: dict[int, int],
        explicit: bool | None,  # None: neither
        free_z: bool = False,
    ):
        self.build, self.graph, self.forms, self.held, self.free_z = build, build.graph, forms, held, free_z
        self._simple = forms.all_simplified
        self.u, self.y = build.traced.u.tolist(), [int(build.traced.u[k]) for k in build.independent]
        self.phi = [int(build.traced.at.phi[s]) for s in build.rows]
        if explicit is not None:
            (self._explicitly if explicit else self._implicitly)()

    # Explicit: substitute the dependent speeds into the velocities, then differentiate.

    def _explicitly(self) -> None:
        by_speed = [self._at(column) for column in columns(self.graph, self.phi, self.u)]
        A = [list(row) for row in zip(*by_speed, strict=True)]
        self._solve(A, self._at(self.graph.substituted(self.phi, dict.fromkeys(self.u, self.graph.zero))))
        unheld = self.known if not self.held else Kinematics(self.build, self.forms, {}, True).known
        raw, simple = self._velocities(unheld)
        self._quantities()
        partial = [self._simple(column) for column in columns(self.graph, simple, self.y)]
        self._shape(simple, partial, self._along(simple, raw, self.qdot))

    # Implicit: differentiate the velocities with respect to all speeds, and the constraints through body
    # velocities.

    def _implicitly(self) -> None:
        g, build = self.graph, self.build
        put, slopes, rates, simple, by_speed, at_fixed_speeds = self.through_velocities()
        A = self._at(g.substituted(slopes(self.phi), put))
        A = np.reshape(A, (len(self.phi), len(self.u))).tolist()
        self._solve(A, self._at(g.substituted(self.phi, dict.fromkeys(self.u, g.zero))))
        drift = self._at(g.substituted(rates(self.phi), put))
        put_z = {} if self.free_z else self.known
        known = lambda nodes: self._simple(g.substituted(nodes, put_z))
        drift, at_fixed_speeds = known(drift), known(at_fixed_speeds)
        found = eliminate(g, self._A_z, [[g.neg(d)] for d in drift], build.probes, build.far)
        zdot = self._simple([row[0] for row in found.solution])
        by_dependent = [by_speed[k] for k in build.dependent]
        moved = [
            [(j, column[n]) for j, column in enumerate(by_dependent) if column[n] != g.zero]
            for n in range(len(simple))
        ]
        through_z = lambda z, n: g.total(g.mul(z[j], by_z) for j, by_z in moved[n])
        columns_of_B = list(zip(*self.B, strict=True)) if self.B else [() for _ in build.independent]
        partial = [
            self._simple([g.add(d, through_z(B, n)) for n, d in enumerate(by_speed[y])])
            for y, B in zip(build.independent, columns_of_B, strict=True)
        ]
        along = self._simple([g.add(a, through_z(zdot, n)) for n, a in enumerate(at_fixed_speeds)])
        self._quantities()
        self._shape(known(simple), partial, along)

    def through_velocities(self) -> tuple:
        """Return six parts: replacements of traced velocities and orientations by short nodes; two functions
        that differentiate rows, with respect to the speeds and along the motion (at constant speeds); the
        simplified velocities, their derivatives with respect to the speeds, and their rates at constant
        speeds.
        """
        g, traced = self.graph, self.build.traced
        at, (raw, simple) = traced.at, self._velocities({})
        qdot = self._at(at.qdot.tolist())
        by_speed = [self._simple(column) for column in columns(g, simple, self.u)]
        at_fixed_speeds = self._along(simple, raw, qdot)
        value = self._parts(simple)
        rotation = [self._simple(self._at(R.ravel().tolist())) for R in at.orientation]
        turn = lambda parts: [self._turned(R, w) for R, w in zip(rotation, parts[1], strict=True)]
        omega = [
            self._smaller(direct, turned)
            for direct, turned in zip([self._at(w.tolist()) for w in at.turning], turn(value), strict=True)
        ]

        def slopes(rows: NodeList) -> NodeList:
            # velocities are replaced for all directions, but change along few of them
            directions: dict = {
                None: self.cut(
                    [(at.v, None), (at.turning, None), (at.orientation, None), (at.position, None)]
                )
            }
            for k, column in enumerate(by_speed):
                parts = self._parts(column)
                direction = self.cut([(at.v, parts[0]), (at.turning, turn(parts))]).items()
                directions[k] = {n: rate for n, rate in direction if rate != g.zero} | {self.u[k]: g.one}
            found = directional_derivative(g, rows, directions)
            return [row.get(k, g.zero) for row in found for k in range(len(self.u))]

        def rates(rows: NodeList, v=value[0], omega=omega, rotation=rotation) -> NodeList:
            parts = self._parts(at_fixed_speeds)
            spun = [
                g.sub(g.mul(w[i - 2], R[3 * (i - 1) + j]), g.mul(w[i - 1], R[3 * (i - 2) + j]))
                for w, R in zip(omega, rotation, strict=True)
                for i in range(3)
                for j in range(3)
            ]
            direction = self.cut(
                [(at.v, parts[0]), (at.turning, turn(parts)), (at.orientation, spun), (at.position, v)]
            )
            moving = {int(n): r for n, r in zip(traced.q, qdot, strict=True)}
            return derivatives(g, rows, moving | direction | {traced.t: g.one})

        put = self.cut([(at.v, value[0]), (at.turning, omega), (at.orientation, rotation)])
        return put, slopes, rates, simple, by_speed, at_fixed_speeds

    def _solve(self, A, phi_0) -> None:
        """Solve `A_z z = -(A_y y + phi_0)` for `z = B y + b`."""
        g, build = self.graph, self.build
        right = [
            [*(g.neg(row[i]) for i in build.independent), g.neg(rest)]
            for row, rest in zip(A, phi_0, strict=True)
        ]
        self._A_z = [[row[d] for d in build.dependent] for row in A]
        eliminated = eliminate(g, self._A_z, right, build.probes, build.far)
        self.pivots = eliminated.pivots
        solution = [self._simple(row) for row in eliminated.solution]
        self.B, self.b = [row[:-1] for row in solution], [row[-1] for row in solution]
        self.z = self._simple([g.add(g.dot(B, self.y), b) for B, b in zip(self.B, self.b, strict=True)])
        self.known = dict(zip([self.u[d] for d in build.dependent], self.z, strict=True))

    def rows_along_motion(self, rows: NodeList) -> tuple[list[NodeList], NodeList]:
        """Return the Jacobian with respect to the speeds and the drift of some constraints, with the fixed
        coordinates.
        """
        raw = [int(self.build.traced.at.phi[s]) for s in rows]
        simple = self._at(raw)
        by_speed = [self._simple(column) for column in columns(self.graph, simple, self.u)]
        return [list(row) for row in zip(*by_speed, strict=True)], self._along(simple, raw, self.qdot)

    def rates_along_motion(self, raw: NodeList) -> NodeList:
        """Return the rates of traced nodes along the motion, with the fixed coordinates."""
        return self._along(self._at(raw), raw, self.qdot)

    # helpers

    def _at(self, nodes) -> NodeList:
        """Substitute the fixed coordinates into nodes, and simplify them."""
        return self._simple(self.graph.substituted(nodes, self.held))

    def _turned(self, R, w) -> NodeList:
        if all(n == self.graph.zero for n in w):
            return list(w)
        return [self.graph.dot(R[3 * i : 3 * i + 3], w) for i in range(3)]

    def _smaller(self, a, b) -> NodeList:
        return a if self.graph.operations(a) <= self.graph.operations([*b]) else b

    def cut(self, levels) -> dict[int, int]:
        """Return replacements for those traced nodes that vary, by node. Values None mean zero."""
        pairs: dict[int, int] = {}
        for nodes, values in levels:
            flat = np.ravel(nodes).tolist()
            new = [self.graph.zero] * len(flat)
            new = new if values is None else np.ravel(np.array(values, np.int64)).tolist()
            for n, v in zip(flat, new, strict=True):
                if self.graph.op[n] == "neg":
                    n, v = self.graph.args[n][0], self.graph.neg(v)
                if self.graph.varies[n]:
                    pairs[n] = v
        return pairs

    def _along(self, nodes, raw, qdot) -> NodeList:
        """Return the rates of `nodes` along the motion. `raw`: the same nodes without fixed coordinates."""
        g, traced = self.graph, self.build.traced
        moving = {int(n): rate for n, rate in zip(traced.q, qdot, strict=True)}
        rates = derivatives(
            g, nodes, {traced.t: g.one} | {n: r for n, r in moving.items() if n not in self.held}
        )
        for k, by_held in enumerate(jacobian(g, raw, list(self.held)) if self.held else ()):
            used = [n for n in self.held if n in by_held]
            slopes = self._at([by_held[n] for n in used])
            terms = (g.mul(moving[n], d) for n, d in zip(used, slopes, strict=True))
            rates[k] = g.total([rates[k], *terms])
        return self._simple(rates)

    def _velocities(self, replacement) -> tuple[NodeList, NodeList]:
        """Return v and omega of all bodies in one list, first as traced, then simplified with the fixed
        coordinates.
        """
        at = self.build.traced.at
        raw = self.graph.substituted([*at.v.ravel().tolist(), *at.omega.ravel().tolist()], replacement)
        return raw, self._at(raw)

    def _quantities(self) -> None:
        """Substitute the dependent speeds and the fixed coordinates into the quantities of the equations."""
        at, g = self.build.traced.at, self.graph

        def put(nodes):
            flat = self._at(g.substituted(nodes.ravel().tolist(), {} if self.free_z else self.known))
            return np.array(flat, np.int64).reshape(nodes.shape)

        self.at = replace(at, **{name: put(getattr(at, name)) for name in IN_EQUATIONS})
        self.qdot = self.at.qdot.tolist()

    def _parts(self, nodes) -> tuple[list, list]:
        """Split a list into the linear and the angular parts of all bodies."""
        rows = np.array(nodes, np.int64).reshape(2, len(self.build.traced.at.mass), 3).tolist()
        return rows[0], rows[1]

    def _shape(self, velocities, partial, rates) -> None:
        v, omega = np.array(self._parts(velocities), np.int64)
        self.at = replace(self.at, v=v, omega=omega)
        self.beta, self.gamma = [self._parts(p)[0] for p in partial], [self._parts(p)[1] for p in partial]
        self.a0, self.alpha0 = self._parts(rates)
