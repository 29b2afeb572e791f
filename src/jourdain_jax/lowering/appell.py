"""Jourdain's equations in independent speeds: rates of the minimal state (q, y) as scalar expressions.

    A_z z = -(A_y y + phi_0)                         dependent speeds, by elimination                     (25)-(31)
    v, omega;  beta, gamma = d(v, omega)/dy;  a_0, alpha_0 along the motion at ydot = 0
    M = sum m beta' beta + gamma' I gamma,   f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    M ydot = f                                                                                             (41), (50), (56)

Constraints that are not eliminated are kept (`kept_rows.py`). There are two strategies.
*Explicit*: substitute z(q, y) into the velocities before differentiating them, best if z is simple.
*Implicit*: differentiate the velocities as they are, with zdot from the differentiated constraints.
"""

from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from jourdain_jax.lowering.contact_forms import simplify_contacts
from jourdain_jax.lowering.elimination import eliminate, pivots_ok, solve_symmetric
from jourdain_jax.lowering.kept_rows import KeptRows
from jourdain_jax.lowering.multipliers import Accelerations, projected_coordinates
from jourdain_jax.program.derivative import columns, derivatives, directional_derivative, jacobian, matrix
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import NodeList
from jourdain_jax.program.identity_test import equal, unaffected
from jourdain_jax.program.polynomial import NormalForms, Polynomial, TooLarge
from jourdain_jax.structure.probes import generic_states
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import TracedScene, VelocityQuantities


@dataclass(frozen=True)
class Strategy:
    """Strategy for building the equations; all strategies give equal values."""

    explicit: bool = True
    most_terms: int = 0  # limit of a normal form; 0: no normal forms
    most_terms_of_equations: int = 0  # the same for the entries of M and f
    by_determinants: bool = False  # accelerations by Cramer's rule, with dependent speeds as symbols
    held: tuple[int, ...] = ()  # ignorable coordinates, fixed at the reference in the accelerations

    @property
    def description(self) -> str:
        """Describe the strategy for the summary."""
        way = (
            "dependent speeds substituted before differentiation"
            if self.explicit
            else "constraints differentiated through body velocities"
        )
        solved = (
            "accelerations by determinants in normal form"
            if self.by_determinants
            else "accelerations by elimination"
        )
        return f"{way}, {solved}"


@dataclass
class Equations:
    """Nodes of the rates of the minimal state."""

    qdot: NodeList
    ydot: NodeList
    z: NodeList  # dependent speeds
    pivots: NodeList  # must not vanish
    guards: NodeList = field(default_factory=list)  # must stay positive
    power: int = 0  # `rate_of_work`
    events: NodeList = field(default_factory=list)  # values of the stop events
    resets: NodeList = field(default_factory=list)  # after each event: state, modes, energy in loads
    energies: NodeList = field(default_factory=list)  # kinetic and potential
    directions: NodeList = field(default_factory=list)  # of nonlinear constraints, by speed: must not reverse
    squares: NodeList = field(default_factory=list)  # of constraints with multipliers (`Accelerations`)


class AppellOnGraph:
    """Builder of the equations of one scene."""

    def __init__(
        self, traced: TracedScene, structure: Structure, kept: KeptRows | None, probes: Probes, far, reference
    ):
        self.traced, self.graph, self.structure, self.probes = traced, traced.graph, structure, probes
        rows_work = not (structure.affine and structure.homogeneous)
        self.forces_work = rows_work or structure.driven or structure.varying_inertia
        every, rows = range(len(traced.u)), list(structure.kept_rows)
        self.independent = list(every) if kept or not rows else list(structure.independent)
        self.dependent = [k for k in every if k not in self.independent]
        self.kept, self.rows, self.multiplied = kept, *(([], rows) if kept else (rows, []))
        self.reference, self.far, self.identity_probes = reference, far, generic_states(traced, probes)
        if len(traced.at.responses):
            simplify_contacts(traced, self._forms)

    def build(self, strategy: Strategy) -> Equations:
        """Return the equations built by one strategy."""
        forms = self._forms(strategy.most_terms)
        held = self._at_reference(strategy.held)
        kinematics = _Kinematics(self, forms, held, strategy.explicit, strategy.by_determinants)
        forms_of_equations = self._forms(strategy.most_terms_of_equations)
        M, f = self._equations(kinematics, forms_of_equations)
        if self.kept and self.multiplied:
            found = self.kept.accelerations(M, f, *kinematics.rows_along_motion(self.multiplied), forms)
        else:
            found = Accelerations(self._solved(M, f, forms_of_equations, strategy.by_determinants), [], [])
        ydot, sines, directions = found.udot, found.sines, [n for row in found.directions for n in row]
        z, qdot, pivots = self._true_rates(kinematics, forms) if held else (kinematics.z, kinematics.qdot, [])
        guards = forms.guards | forms_of_equations.guards | set(found.margins)
        power = self._power(kinematics, ydot)
        if strategy.by_determinants:
            *ydot, power = self.graph.substituted([*ydot, power], kinematics.known)
            qdot = self.graph.substituted(qdot, kinematics.known)
        true_z = {int(self.traced.u[k]): n for k, n in zip(self.dependent, z, strict=True)}
        at = self.traced.at
        of_state = self._of_state(at.resets)
        outputs = iter(
            self.graph.substituted(
                [*at.slip_turns.tolist(), *at.events.tolist(), *of_state, *at.energies.tolist()], true_z
            )
        )
        turns, events, resets, (T, V) = (
            list(islice(outputs, n)) for n in (len(at.slip_turns), len(at.events), len(of_state), 2)
        )
        qdot = [*qdot[: len(qdot) - len(turns)], *turns]
        if not self.forces_work:
            (power,) = self.graph.substituted([int(self.traced.at.power)], true_z)
        elif held:
            true_power = self._power(_Kinematics(self, forms, {}, explicit=False), ydot)
            power = (
                power
                if equal(self.identity_probes([power]), self.identity_probes([true_power])).all()
                else true_power
            )
        pivots = list(dict.fromkeys([*kinematics.pivots, *pivots, *sines]))
        return Equations(
            qdot, ydot, z, pivots, sorted(guards), power, events, resets, [T, V], directions, found.squares
        )

    def _of_state(self, resets: np.ndarray) -> NodeList:
        """Return the state changes at events, without dependent speeds."""
        first = len(self.traced.q)
        return (
            np.delete(resets, [first + k for k in self.dependent], axis=1).ravel().tolist()
            if resets.size
            else []
        )

    def _at_reference(self, held: tuple[int, ...]) -> dict[int, int]:
        return {int(self.traced.q[i]): self.graph.const(self.reference[i]) for i in held}

    def projection(self, most_terms: int, ignorable: tuple[int, ...]) -> tuple[NodeList, NodeList]:
        """Return coordinates projected onto quaternion norms and geometric constraints, and speeds projected
        onto velocity constraints (empty if eliminated). Closed contacts count as constraints.
        """
        g, at, q = self.graph, self.traced.at, self.traced.q.tolist()
        redundant = {s for s in range(len(at.closure)) if s not in self.rows and s not in self.multiplied}
        closure = [int(n) for s, n in enumerate(at.closure) if s not in redundant]
        # constraints fix the others, but have derivatives with respect to them
        varying = tuple(i for i in ignorable if self.identity_probes.varies(str(g.value[q[i]])))
        closure = g.substituted(
            closure, unaffected(self.identity_probes, closure, self._at_reference(varying))
        )
        moved = list(q)
        if closure:
            moved = projected_coordinates(g, q, [*closure, *self.traced.closures[len(at.closure) :]])
        else:
            for first, wxyz in zip(self.traced.quaternions, self.traced.attitudes, strict=True):
                n = g.dot(wxyz, wxyz)
                moved[first : first + 4] = [g.div(part, g.call("sqrt", n)) for part in wxyz]
        speeds: NodeList = []
        if self.kept and self.multiplied:
            forms = self._forms(most_terms)
            M, _ = self._equations(_Kinematics(self, forms, {}, explicit=True), forms)
            phi = [int(at.phi[s]) for s in self.multiplied]
            speeds = self.kept.projected_speeds(M, self.traced.u.tolist(), phi, forms)
        if len(at.held):  # closed contacts first
            u, (held_q, held_u) = self.traced.u.tolist(), np.split(at.held, [len(q)])
            moved = g.substituted(moved, dict(zip(q, held_q.tolist(), strict=True)))
            speeds = g.substituted(held_u.tolist(), dict(zip(u, speeds or u, strict=True)))
        return moved, speeds

    def _power(self, k: "_Kinematics", ydot: NodeList) -> int:
        """Return the power of loads without a potential, of explicit time in potentials, of constraints that
        do work, of prescribed poses, and of changing masses.

        `sum (m a - F).v + (I alpha + omega x I omega - L).omega - Q_direct.u + (mdot v.v + omega.(dI/dt
        omega))/2`
        """
        g, at = self.graph, k.at
        if not self.forces_work:
            return int(at.power)
        terms = [int(at.power)]
        if self.structure.varying_inertia:
            raw = [*self.traced.at.mass.tolist(), *self.traced.at.inertia.ravel().tolist()]
            mass_rates, inertia_rates = np.split(
                np.array(k.rates_along_motion(raw), np.int64), [len(at.mass)]
            )
            for b, (rate, of_inertia) in enumerate(
                zip(mass_rates.tolist(), inertia_rates.reshape(-1, 3, 3).tolist(), strict=True)
            ):
                v, omega = at.v[b].tolist(), at.omega[b].tolist()
                gained = g.add(
                    g.mul(rate, g.dot(v, v)), g.dot(omega, [g.dot(row, omega) for row in of_inertia])
                )
                terms.append(g.mul(g.const(0.5), gained))
        for b in range(len(at.mass)):
            a = [g.add(a0, g.dot([beta[b][i] for beta in k.beta], ydot)) for i, a0 in enumerate(k.a0[b])]
            alpha = [
                g.add(a0, g.dot([gamma[b][i] for gamma in k.gamma], ydot)) for i, a0 in enumerate(k.alpha0[b])
            ]
            force, torque = self._inertia_resultants(at, b, a, alpha)
            for i in range(3):
                terms.append(g.mul(g.sub(force[i], int(at.force[b][i])), int(at.v[b][i])))
                terms.append(g.mul(g.sub(torque[i], int(at.torque[b][i])), int(at.omega[b][i])))
        u = dict(zip(self.dependent, k.z, strict=True)) | dict(zip(self.independent, k.y, strict=True))
        return g.sub(g.total(terms), g.total(g.mul(int(at.direct[i]), n) for i, n in u.items()))

    def _inertia_resultants(
        self, at: VelocityQuantities, b: int, a: NodeList, alpha: NodeList
    ) -> tuple[NodeList, NodeList]:
        """Return `m a` and `I alpha + omega x I omega` of body b."""
        g, inertia, omega = self.graph, at.inertia[b].tolist(), at.omega[b].tolist()
        momentum = [g.dot(row, omega) for row in inertia]
        gyroscopic = [
            g.sub(g.mul(omega[i - 2], momentum[i - 1]), g.mul(omega[i - 1], momentum[i - 2]))
            for i in range(3)
        ]
        return [g.mul(int(at.mass[b]), x) for x in a], [
            g.add(g.dot(row, alpha), w) for row, w in zip(inertia, gyroscopic, strict=True)
        ]

    def _solved(self, M, f, forms: NormalForms, by_determinants: bool) -> NodeList:
        if by_determinants and 1 <= len(f) <= 3:
            try:
                return forms.cramer(M, f)
            except TooLarge:
                pass
        return solve_symmetric(self.graph, M, [f]).solution[0]

    def _true_rates(
        self, kinematics: "_Kinematics", forms: NormalForms
    ) -> tuple[NodeList, NodeList, NodeList]:
        """Return dependent speeds and coordinate rates with no coordinate fixed, and new pivots."""
        g, at, u = self.graph, self.traced.at, self.traced.u.tolist()
        phi = [int(at.phi[s]) for s in self.rows]
        phi = g.substituted(phi, unaffected(self.identity_probes, [*phi, *at.qdot.tolist()], kinematics.held))
        A = matrix(g, phi, u)
        phi_0 = g.substituted(phi, dict.fromkeys(u, g.zero))
        y = {k: u[k] for k in self.independent}

        def solved(columns, known):
            right = [
                [g.neg(g.add(rest, g.total(g.mul(row[k], n) for k, n in known.items())))]
                for row, rest in zip(A, phi_0, strict=True)
            ]
            return eliminate(g, [[row[k] for k in columns] for row in A], right, self.probes, self.far)

        whole = solved(self.dependent, y)
        generic = self.identity_probes
        same = equal(
            generic(kinematics.z),
            generic([row[0] for row in whole.solution]),
            pivots_ok(whole.pivots, generic),
        )
        known = y | {k: n for k, n, s in zip(self.dependent, kinematics.z, same, strict=True) if s}
        left = [k for k in self.dependent if k not in known]
        A, phi_0 = [forms.all_simplified(row) for row in A], forms.all_simplified(phi_0)
        found = solved(left, known)
        known |= {k: row[0] for k, row in zip(left, map(forms.all_simplified, found.solution), strict=True)}
        z = [known[k] for k in self.dependent]
        return (
            z,
            forms.all_simplified(
                g.substituted(
                    at.qdot.tolist(), {u[k]: n for k, n in known.items() if k not in self.independent}
                )
            ),
            found.pivots,
        )

    def _forms(self, most_terms: int) -> NormalForms:
        squares: dict[int, Polynomial] = {}
        for w, *xyz in self.traced.attitudes:
            squares[w] = {(): 1.0} | {(n, n): -1.0 for n in xyz}
        return NormalForms(self.graph, most_terms, self.probes.sign, squares)

    def _equations(self, k: "_Kinematics", forms: NormalForms) -> tuple[list[NodeList], NodeList]:
        g, at = self.graph, k.at
        freedoms = range(len(self.independent))
        inertia = at.inertia.tolist()
        M = [[g.zero] * len(freedoms) for _ in freedoms]
        f = [g.zero] * len(freedoms)
        for i in freedoms:
            f[i] = g.total(
                [
                    int(at.direct[self.independent[i]]),
                    *(g.mul(row[i], int(at.direct[d])) for row, d in zip(k.B, self.dependent, strict=True)),
                ]
            )
        for b, mass in enumerate(at.mass.tolist()):
            beta, gamma = [k.beta[i][b] for i in freedoms], [k.gamma[i][b] for i in freedoms]
            impressed, resisting = (
                (at.force[b].tolist(), at.torque[b].tolist()),
                self._inertia_resultants(at, b, k.a0[b], k.alpha0[b]),
            )
            force, torque = (
                [g.sub(F, ma) for F, ma in zip(*pair, strict=True)]
                for pair in zip(impressed, resisting, strict=True)
            )
            moving = [i for i in freedoms if any(n != g.zero for n in (*beta[i], *gamma[i]))]
            for i in moving:
                f[i] = g.total([f[i], g.dot(beta[i], force), g.dot(gamma[i], torque)])
                turned = [g.dot(row, gamma[i]) for row in inertia[b]]
                for j in moving[: moving.index(i) + 1]:
                    M[i][j] = g.total(
                        [M[i][j], g.mul(mass, g.dot(beta[i], beta[j])), g.dot(gamma[j], turned)]
                    )
        for i in freedoms:
            f[i] = forms.simplified(f[i])
            for j in range(i + 1):
                M[i][j] = M[j][i] = forms.simplified(M[i][j])
        return M, f


class _Kinematics:
    """Velocities, partial velocities and accelerations at ydot = 0, with some coordinates fixed."""

    def __init__(
        self,
        build: AppellOnGraph,
        forms: NormalForms,
        held: dict[int, int],
        explicit: bool,
        free_z: bool = False,
    ):
        self.build, self.graph, self.forms, self.held, self.free_z = build, build.graph, forms, held, free_z
        self._simple = forms.all_simplified
        self.u, self.y = build.traced.u.tolist(), [int(build.traced.u[k]) for k in build.independent]
        self.phi = [int(build.traced.at.phi[s]) for s in build.rows]
        (self._explicitly if explicit else self._implicitly)()

    # Explicit: substitute the dependent speeds into the velocities, then differentiate.

    def _explicitly(self) -> None:
        A = [
            list(row)
            for row in zip(
                *(self._at(column) for column in columns(self.graph, self.phi, self.u)), strict=True
            )
        ]
        self._solve(A, self._at(self.graph.substituted(self.phi, dict.fromkeys(self.u, self.graph.zero))))
        unheld = self.known if not self.held else _Kinematics(self.build, self.forms, {}, True).known
        raw, simple = self._velocities(unheld)
        self._quantities()
        partial = [self._simple(column) for column in columns(self.graph, simple, self.y)]
        self._shape(simple, partial, self._along(simple, raw, self.qdot))

    # Implicit: differentiate the velocities as they are, and the constraints through body velocities.

    def _implicitly(self) -> None:
        g, build, at = self.graph, self.build, self.build.traced.at
        raw, simple = self._velocities({})
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
        levels = [
            (at.v, value[0]),
            (at.turning, omega),
            (at.orientation, [np.reshape(R, (3, 3)).tolist() for R in rotation]),
        ]
        put = self._cut(levels)
        self._put = put

        # velocities are replaced in every direction, and change in few of them
        directions: dict = {
            None: self._cut([(at.v, None), (at.turning, None), (at.orientation, None), (at.position, None)])
        }
        for k, column in enumerate(by_speed):
            parts = self._parts(column)
            direction = self._cut([(at.v, parts[0]), (at.turning, turn(parts))])
            directions[k] = {n: rate for n, rate in direction.items() if rate != g.zero} | {self.u[k]: g.one}
        A = [
            [row.get(k, g.zero) for k in range(len(self.u))]
            for row in directional_derivative(g, self.phi, directions)
        ]
        A = np.reshape(
            self._at(g.substituted([n for row in A for n in row], put)), (len(A), len(self.u))
        ).tolist()
        phi_0 = self._at(g.substituted(self.phi, dict.fromkeys(self.u, g.zero)))
        self._solve(A, phi_0)
        parts = self._parts(at_fixed_speeds)
        spun = [
            [
                [
                    g.sub(g.mul(w[i - 2], R[3 * (i - 1) + j]), g.mul(w[i - 1], R[3 * (i - 2) + j]))
                    for j in range(3)
                ]
                for i in range(3)
            ]
            for w, R in zip(omega, rotation, strict=True)
        ]
        direction = self._cut(
            [(at.v, parts[0]), (at.turning, turn(parts)), (at.orientation, spun), (at.position, value[0])]
        )
        moving = {int(n): r for n, r in zip(build.traced.q, qdot, strict=True)}
        drift = self._at(
            g.substituted(derivatives(g, self.phi, moving | direction | {build.traced.t: g.one}), put)
        )
        put_z = {} if self.free_z else self.known
        known = lambda nodes: self._simple(g.substituted(nodes, put_z))
        drift, at_fixed_speeds = known(drift), known(at_fixed_speeds)
        zdot = self._simple(
            [
                row[0]
                for row in eliminate(
                    g, self._A_z, [[g.neg(d)] for d in drift], build.probes, build.far
                ).solution
            ]
        )
        moved = [
            [
                (j, column[n])
                for j, column in enumerate(by_speed[k] for k in build.dependent)
                if column[n] != g.zero
            ]
            for n in range(len(simple))
        ]
        through_z = lambda z, n: g.total(g.mul(z[j], by_z) for j, by_z in moved[n])
        columns_of_B = list(zip(*self.B, strict=True)) if self.B else [() for _ in build.independent]
        partial = [
            self._simple([g.add(d, through_z(B, n)) for n, d in enumerate(by_speed[y])])
            for y, B in zip(build.independent, columns_of_B, strict=True)
        ]
        rates = self._simple([g.add(a, through_z(zdot, n)) for n, a in enumerate(at_fixed_speeds)])
        self._quantities()
        self._shape(known(simple), partial, rates)

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
        """Return the Jacobian (by speeds) and the drift of some constraints, at the fixed coordinates."""
        raw = [int(self.build.traced.at.phi[s]) for s in rows]
        simple = self._at(raw)
        by_speed = [self._simple(column) for column in columns(self.graph, simple, self.u)]
        return [list(row) for row in zip(*by_speed, strict=True)], self._along(simple, raw, self.qdot)

    def rates_along_motion(self, raw: NodeList) -> NodeList:
        """Return rates of traced nodes along the motion, at the fixed coordinates."""
        return self._along(self._at(raw), raw, self.qdot)

    # helpers

    def _at(self, nodes) -> NodeList:
        """Return nodes at the fixed coordinates, simplified."""
        return self._simple(self.graph.substituted(nodes, self.held))

    def _turned(self, R, w) -> NodeList:
        if all(n == self.graph.zero for n in w):
            return list(w)
        return [self.graph.dot(R[3 * i : 3 * i + 3], w) for i in range(3)]

    def _smaller(self, a, b) -> NodeList:
        return a if self.graph.operations(a) <= self.graph.operations([*b]) else b

    def _cut(self, levels) -> dict[int, int]:
        """Return traced nodes -> replacements (zero if none is given); constants are excluded."""
        pairs: dict[int, int] = {}
        for nodes, values in levels:
            flat = np.ravel(nodes).tolist()
            new = (
                [self.graph.zero] * len(flat)
                if values is None
                else np.ravel(np.array(values, np.int64)).tolist()
            )
            for n, v in zip(flat, new, strict=True):
                if self.graph.op[n] == "neg":
                    n, v = self.graph.args[n][0], self.graph.neg(v)
                if self.graph.varies[n]:
                    pairs[n] = v
        return pairs

    def _along(self, nodes, raw, qdot) -> NodeList:
        """Return the rate of `nodes` along the motion; `raw`: the nodes before fixing coordinates."""
        g, traced = self.graph, self.build.traced
        moving = {int(n): rate for n, rate in zip(traced.q, qdot, strict=True)}
        rates = derivatives(
            g, nodes, {traced.t: g.one} | {n: r for n, r in moving.items() if n not in self.held}
        )
        for k, by_held in enumerate(jacobian(g, raw, list(self.held)) if self.held else ()):
            slopes = self._at([by_held[n] for n in self.held if n in by_held])
            rates[k] = g.total(
                [
                    rates[k],
                    *(
                        g.mul(moving[n], d)
                        for n, d in zip((n for n in self.held if n in by_held), slopes, strict=True)
                    ),
                ]
            )
        return self._simple(rates)

    def _velocities(self, replacement) -> tuple[NodeList, NodeList]:
        """Return v and omega of all bodies in one list, raw and simplified at the fixed coordinates."""
        at = self.build.traced.at
        raw = self.graph.substituted([*at.v.ravel().tolist(), *at.omega.ravel().tolist()], replacement)
        return raw, self._at(raw)

    def _quantities(self) -> None:
        """Evaluate all traced quantities at the dependent speeds and the fixed coordinates."""
        at, g = self.build.traced.at, self.graph

        def put(nodes):
            flat = self._at(g.substituted(nodes.ravel().tolist(), {} if self.free_z else self.known))
            return np.array(flat, np.int64).reshape(nodes.shape)

        self.at = VelocityQuantities(
            *(put(getattr(at, name)) for name in VelocityQuantities.__dataclass_fields__)
        )
        self.qdot = self.at.qdot.tolist()

    def _parts(self, nodes) -> tuple[list, list]:
        """Return linear and angular parts per body."""
        rows = np.array(nodes, np.int64).reshape(2, len(self.build.traced.at.mass), 3).tolist()
        return rows[0], rows[1]

    def _shape(self, velocities, partial, rates) -> None:
        self.at.v[...], self.at.omega[...] = self._parts(velocities)
        self.beta, self.gamma = [self._parts(p)[0] for p in partial], [self._parts(p)[1] for p in partial]
        self.a0, self.alpha0 = self._parts(rates)
