"""Jourdain's equations in independent speeds: rates of the minimal state (q, y) as scalar expressions.

    A_z z = -(A_y y + phi_0)                       dependent speeds, by elimination               (25)-(31)
    beta, gamma = d(v, omega)/dy                   a_0, alpha_0: accelerations at ydot = 0
    M = sum m beta' beta + gamma' I gamma
    f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    M ydot = f                                                                             (41), (50), (56)

Constraints that are not eliminated are kept (`multipliers.py`). `partial_velocities.py` computes beta, gamma,
a_0 and alpha_0 by one of two strategies.

`simplify_contacts` shortens the responses of switching contacts once, by normal forms; loads, events,
resets and starts then use the simplified nodes.
"""

from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from jourdain_jax.lowering.elimination import eliminate, pivots_ok, solve_symmetric
from jourdain_jax.lowering.multipliers import Accelerations, KeptRows, projected_coordinates
from jourdain_jax.lowering.partial_velocities import Kinematics
from jourdain_jax.program.derivative import matrix
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import NodeList
from jourdain_jax.program.identity_test import equal, unaffected
from jourdain_jax.program.polynomial import NormalForms, Polynomial, TooLarge
from jourdain_jax.structure.probes import generic_states
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import TracedScene, VelocityQuantities

MOST_TERMS = 60  # tuning: maximum number of terms of a normal form of contacts


def simplify_contacts(build: "AppellOnGraph") -> None:
    """Replace `responses` by shorter nodes: rows of contacts are differentiated through body velocities, and
    normal forms come before the elimination. Responses at later states are functions of earlier ones.
    """
    traced, g, at = build.traced, build.graph, build.traced.at
    state = [*traced.q.tolist(), *traced.u.tolist(), *traced.inputs.tolist()]
    first, *later = (row[len(state) :] for row in at.responses.tolist())
    count, forms = len(at.slip_turns) // 2, build._forms(MOST_TERMS)
    gaps, w, k = first[:count], first[count : 4 * count], Kinematics(build, forms, {}, None)
    put, slopes, rates, *_ = k.through_velocities()
    w[::3] = rates(gaps, at.v, at.turning.tolist(), at.orientation.reshape(-1, 9).tolist())
    rows = g.substituted([*gaps, *w, *slopes(w), *rates(w)], put)
    plain = {n: m for n in g.reachable(first) if not g.args[m := forms.simplified(n)]}
    known = plain | k.cut([(first[: len(rows)], rows)])
    found = g.substituted(first, known)
    normal = min(found, forms.all_simplified(found), key=g.operations)
    simple = put | k.cut([(first, normal)])
    for row, nodes in zip(at.responses[1:, : len(state)].tolist(), later, strict=True):
        now = dict(zip(state, g.substituted(row, simple), strict=True))
        simple |= k.cut([(nodes, g.substituted(normal, now))])
    loads = at.force, at.torque, at.direct, at.power
    for x in (*loads, at.events, at.resets, at.slip_turns, at.held, at.start):
        x[...] = np.array(g.substituted(x.ravel().tolist(), simple), np.int64).reshape(x.shape)


@dataclass(frozen=True)
class Strategy:
    """Way to build the equations. All strategies give equal values, but programs of different length."""

    explicit: bool = True  # as in `Kinematics`
    most_terms: int = 0  # maximum number of terms of a normal form; 0: no normal forms
    most_terms_of_equations: int = 0  # the same limit for entries of M and f
    by_determinants: bool = False  # accelerations by Cramer's rule, with dependent speeds as symbols
    held: tuple[int, ...] = ()  # ignorable coordinates, which have reference values in the accelerations

    @property
    def description(self) -> str:
        """Describe the strategy for the summary."""
        way = "constraints differentiated through body velocities"
        way = "dependent speeds substituted before differentiation" if self.explicit else way
        solved = "determinants in normal form" if self.by_determinants else "elimination"
        return f"{way}, accelerations by {solved}"


@dataclass
class Equations:
    """Nodes of the rates of the integrated state, and of quantities computed with them."""

    qdot: NodeList
    ydot: NodeList
    z: NodeList  # dependent speeds
    pivots: NodeList  # must not vanish
    guards: NodeList = field(default_factory=list)  # must stay positive
    power: int = 0  # rate of the integrated work (`rate_of_work`)
    events: NodeList = field(default_factory=list)  # values of the events
    resets: NodeList = field(default_factory=list)  # after each event: state, modes, energy in loads
    energies: NodeList = field(default_factory=list)  # kinetic and potential
    directions: NodeList = field(default_factory=list)  # of nonlinear constraints; must not reverse
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
            simplify_contacts(self)

    def build(self, strategy: Strategy) -> Equations:
        """Return the equations, built by the given strategy."""
        forms = self._forms(strategy.most_terms)
        held = self._at_reference(strategy.held)
        kinematics = Kinematics(self, forms, held, strategy.explicit, strategy.by_determinants)
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
            true_power = self._power(Kinematics(self, forms, {}, explicit=False), ydot)
            if not equal(self.identity_probes([power]), self.identity_probes([true_power])).all():
                power = true_power
        pivots = list(dict.fromkeys([*kinematics.pivots, *pivots, *sines]))
        return Equations(
            qdot, ydot, z, pivots, sorted(guards), power, events, resets, [T, V], directions, found.squares
        )

    def _of_state(self, resets: np.ndarray) -> NodeList:
        """Return the values after events, except those of dependent speeds, as a flat list."""
        if not resets.size:
            return []
        first = len(self.traced.q)
        return np.delete(resets, [first + k for k in self.dependent], axis=1).ravel().tolist()

    def _at_reference(self, held: tuple[int, ...]) -> dict[int, int]:
        return {int(self.traced.q[i]): self.graph.const(self.reference[i]) for i in held}

    def projection(self, most_terms: int, ignorable: tuple[int, ...]) -> tuple[NodeList, NodeList]:
        """Return the coordinates projected onto quaternion norms and geometric constraints, and the speeds
        projected onto velocity constraints (none if these are eliminated). Closed contacts count as
        constraints.
        """
        g, at, q = self.graph, self.traced.at, self.traced.q.tolist()
        redundant = {s for s in range(len(at.closure)) if s not in self.rows and s not in self.multiplied}
        closure = [int(n) for s, n in enumerate(at.closure) if s not in redundant]
        # fix only ignorable coordinates that vary, because derivatives with respect to the others are needed
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
            M, _ = self._equations(Kinematics(self, forms, {}, explicit=True), forms)
            phi = [int(at.phi[s]) for s in self.multiplied]
            speeds = self.kept.projected_speeds(M, self.traced.u.tolist(), phi, forms)
        if len(at.held):  # project onto closed contacts first
            u, (held_q, held_u) = self.traced.u.tolist(), np.split(at.held, [len(q)])
            moved = g.substituted(moved, dict(zip(q, held_q.tolist(), strict=True)))
            speeds = g.substituted(held_u.tolist(), dict(zip(u, speeds or u, strict=True)))
        return moved, speeds

    def _power(self, k: "Kinematics", ydot: NodeList) -> int:
        """Return the power of everything that changes T + V: loads without a potential, explicit time in
        potentials, constraints that do work, prescribed poses, and changing masses.

            traced power + sum (m a - F).v + (I alpha + omega x I omega - L).omega
                         + sum (mdot v.v + omega.(dI/dt omega))/2 - Q_direct.u
        """
        g, at = self.graph, k.at
        if not self.forces_work:
            return int(at.power)
        terms = [int(at.power)]
        if self.structure.varying_inertia:
            raw = [*self.traced.at.mass.tolist(), *self.traced.at.inertia.ravel().tolist()]
            rates = np.array(k.rates_along_motion(raw), np.int64)
            mass_rates, inertia_rates = np.split(rates, [len(at.mass)])
            pairs = zip(mass_rates.tolist(), inertia_rates.reshape(-1, 3, 3).tolist(), strict=True)
            for b, (rate, of_inertia) in enumerate(pairs):
                v, omega = at.v[b].tolist(), at.omega[b].tolist()
                by_mass = g.mul(rate, g.dot(v, v))
                gained = g.add(by_mass, g.dot(omega, [g.dot(row, omega) for row in of_inertia]))
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
        force = [g.mul(int(at.mass[b]), x) for x in a]
        return force, [g.add(g.dot(row, alpha), w) for row, w in zip(inertia, gyroscopic, strict=True)]

    def _solved(self, M, f, forms: NormalForms, by_determinants: bool) -> NodeList:
        if by_determinants and 1 <= len(f) <= 3:
            try:
                return forms.cramer(M, f)
            except TooLarge:
                pass
        return solve_symmetric(self.graph, M, [f]).solution[0]

    def _true_rates(
        self, kinematics: "Kinematics", forms: NormalForms
    ) -> tuple[NodeList, NodeList, NodeList]:
        """Return the dependent speeds and coordinate rates without fixed coordinates, and new pivots."""
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
        put = {u[k]: n for k, n in known.items() if k not in self.independent}
        return z, forms.all_simplified(g.substituted(at.qdot.tolist(), put)), found.pivots

    def _forms(self, most_terms: int) -> NormalForms:
        squares: dict[int, Polynomial] = {}
        for w, *xyz in self.traced.attitudes:
            squares[w] = {(): 1.0} | {(n, n): -1.0 for n in xyz}
        return NormalForms(self.graph, most_terms, self.probes.sign, squares)

    def _equations(self, k: "Kinematics", forms: NormalForms) -> tuple[list[NodeList], NodeList]:
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
            impressed = at.force[b].tolist(), at.torque[b].tolist()
            resisting = self._inertia_resultants(at, b, k.a0[b], k.alpha0[b])
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
