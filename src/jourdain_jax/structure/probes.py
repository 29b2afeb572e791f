"""A scene probed on its scalar graph: derivatives on the graph, evaluation on NumPy at all probed states.

    A = d phi/du,   beta = dv/du,   gamma = d omega/du,   M = sum m beta' beta + gamma' I gamma
    q <- q - G+ g(q),   G = dg/dq,           u <- u - M^-1 A' (A M^-1 A')+ phi(u)

The graph is traced once per class. The probed quantities are its nodes, the parameters its inputs.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Entries, real_type, static
from jourdain_jax.calculus.roots import nearest_root, shortest
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.equations.virtual_power import mass_matrix
from jourdain_jax.program.derivative import derivatives, jacobian
from jourdain_jax.program.evaluate import CALLS, NONANALYTIC, Probes, decided_by, depend_on, passes
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.identity_test import IdentityProbes, identity_probes, is_combination, on_rows
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import (
    Assembled,
    assemble,
    coordinate_bounds,
    speed_scales,
    typical_lengths,
)
from jourdain_jax.structure.scene_numbers import Numbers
from jourdain_jax.structure.trace import TracedScene, named_values, traced_scene

SparseRows = list[dict[int, int]]  # by row: variable -> node of the derivative

TIMED = ("rows", "poses", "inertias", "coordinate rates", "loads", "potential")

# Quantities of poses and constraints. If JAX calls compute them, distant states are probed too; quantities of
# loads that calls compute count as nonzero.
_MOTION = frozenset(
    (
        "rows",
        "poses",
        "inertias",
        "coordinate rates",
        "rows at rest",
        "motion at rest",
        "inertia",
        "nonlinear",
    )
)


class Probed(eqx.Module):
    """Probed quantities at one state, or at many with a leading axis. Some are trees of arrays."""

    q: Float[Entries, "*states coordinates"]  # on the geometric constraints
    position_error: Float[Entries, "*states"]  # as in `Assembled`
    error: Float[Entries, "*states"]  # as in `Assembled`
    outside: Float[Entries, "*states"]  # as in `Assembled`
    G: Float[Entries, "*states closures coordinates"]
    A: Float[Entries, "*states rows speeds"]
    A_other: Float[Entries, "*states rows speeds"]  # at other speeds
    A_beyond: Float[Entries, "*states rows speeds"]  # before projection onto the geometric constraints
    M: Float[Entries, "*states speeds speeds"]
    vanishing: dict[str, Float[Entries, "*states entries"]]  # as in `LookedAt`
    numbers: Numbers
    # quantities that may be nonzero away from the probes
    unproved: frozenset[str] = static(default=frozenset())
    # quantities of poses and constraints computed by calls of JAX
    in_calls: frozenset[str] = static(default=frozenset())


def generic_inputs(scene: Scene) -> np.ndarray:
    """Return values of inputs at which no term happens to vanish."""
    return np.linspace(0.5, 1.0, len(scene.inputs))


@dataclass(frozen=True)
class LookedAt:
    """The graph of a class of scenes, with the probed quantities as nodes."""

    traced: TracedScene
    rows: SparseRows  # d phi/du, each row by the nodes of the speeds
    velocities: SparseRows  # d (v, omega)/du
    closures: list[int]  # geometric constraints and unit norms
    of_closures: SparseRows  # their derivatives with respect to q
    # Quantities that may be zero everywhere, by name. "rows at rest": residuals at u = 0; "motion at rest":
    # velocities and coordinate rates at u = 0; names of `TIMED`: rates in time at fixed coordinates, speeds
    # and inputs, for loads and potentials at fixed motion; "inertia": rates of masses and inertias along the
    # motion; "rows of inputs", "potential 0", ...: rates of constraints and of each load's potential along a
    # generic change of the inputs
    vanishing: dict[str, list[int]]
    in_calls: frozenset[str]  # quantities that depend on calls of JAX
    nonanalytic: frozenset[str]  # quantities that depend on an operation that is not analytic

    @property
    def graph(self) -> Graph:
        """Return the graph of the traced scene."""
        return self.traced.graph


@partial(once_per_class, most=64)
def looked_at(scene: Scene) -> LookedAt:
    """Return the probed quantities of a class of scenes."""
    traced = traced_scene(scene)
    g, at, u = traced.graph, traced.at, traced.u.tolist()
    flat = [*at.phi.tolist(), *at.v.ravel().tolist(), *at.omega.ravel().tolist()]
    by_speed, rows = jacobian(g, flat, u), len(at.phi)
    at_rest = g.substituted([*flat, *at.qdot.tolist()], dict.fromkeys(u, g.zero))
    weights = _flat([at.mass, at.inertia])
    by_time = {
        "rows": [at.phi, at.closure],
        "poses": [at.position, at.orientation],
        "inertias": weights,
        "coordinate rates": at.qdot,
    }
    along_motion = {traced.t: g.one} | dict(zip(traced.q.tolist(), at.qdot.tolist(), strict=True))
    changed = {n: g.mul(n, n) for n in traced.inputs.tolist()}
    potentials = derivatives(g, traced.particulars.potentials.tolist(), changed)
    vanishing = {name: derivatives(g, _flat(nodes), {traced.t: g.one}) for name, nodes in by_time.items()}
    vanishing |= {name: _flat(nodes) for name, nodes in traced.particulars.explicit.items()}
    vanishing |= {"rows at rest": at_rest[:rows], "motion at rest": at_rest[rows:]}
    vanishing |= {"inertia": derivatives(g, weights, along_motion)}
    vanishing |= {"rows of inputs": derivatives(g, at.phi.tolist(), changed)}
    vanishing |= {f"potential {k}": [rate] for k, rate in enumerate(potentials)}
    closures = traced.closures
    return LookedAt(
        traced=traced,
        rows=by_speed[:rows],
        velocities=by_speed[rows:],
        closures=closures,
        of_closures=jacobian(g, closures, traced.q.tolist()),
        vanishing=vanishing,
        in_calls=_passing(CALLS, traced, vanishing, by_speed[:rows]),
        nonanalytic=_passing(NONANALYTIC, traced, vanishing, by_speed[:rows]),
    )


@once_per_class
def coordinates_on_rows(scene: Scene) -> np.ndarray:
    """Return which coordinates the geometric constraints or unit norms depend on, (coordinates,)."""
    nodes = looked_at(scene)
    return np.isin(nodes.traced.q, [n for row in nodes.of_closures for n in row])


def _passing(kinds, traced: TracedScene, vanishing: dict[str, list[int]], rows: SparseRows) -> frozenset[str]:
    """Return the quantities in which operations of the given `kinds` occur, by name: as in `vanishing`,
    "rank" for the Jacobian of the constraints, and "nonlinear" for its dependence on the speeds.
    """
    g, u = traced.graph, traced.u.tolist()
    entries = [node for row in rows for node in row.values()]
    passing = passes(g, entries, kinds)
    bent = any(a and b for a, b in zip(depend_on(g, entries, u), passing, strict=True))
    found = {name for name, nodes in vanishing.items() if any(passes(g, nodes, kinds))}
    found |= {"rank"} if any(passing) or "rows at rest" in found else set()
    bent = bent or decided_by(g, traced.at.phi.tolist(), u, kinds)
    return frozenset(found | ({"nonlinear"} if bent else set()))


def probed_on_graph(scene: Scene, t, q, u, u_other, generic, **limits: int) -> Probed:
    """Probe the scene at states (t, q, u), projected onto the geometric constraints, and its constraints also
    at `u_other`. `generic`: which states are random.

    `limits`: as in `assemble`. Raises `Unsupported` for a call without a derivative in JAX.
    """
    at = _AtStates(looked_at(scene), scene, t, q, u, generic_inputs(scene), generic, **limits)
    return at.probed(u_other)


def projected(scene: Scene, t, q) -> Assembled:
    """Return the configurations on the geometric constraints nearest to q, without repeated searches."""
    still, every = np.zeros((len(t), len(scene.speed_names.entries))), np.ones(len(t), bool)
    return _AtStates(looked_at(scene), scene, t, q, still, np.zeros(len(scene.inputs)), every, tries=0).found


def sampled_on_graph(scene: Scene, t, q, u) -> tuple[np.ndarray, np.ndarray, Assembled]:
    """Return projected coordinates and speeds, and the errors of the coordinates."""
    at = _AtStates(looked_at(scene), scene, t, q, u, np.zeros(len(scene.inputs)), np.ones(len(q), bool))
    return at.real(at.q), at.real(at.speeds_on_rows()), at.found


def follow_from_others(scene: Scene, t, q, u, rows: Sequence[int]) -> bool:
    """Return whether the velocity constraints `rows` are combinations of the others at all states on the
    geometric constraints, at generic parameters.

    Row s is a combination of the kept rows k if `(A_s, phi_s(0)) = x' (A_k, phi_k(0))` has a solution x up
    to round-off.
    """
    at = _AtStates(looked_at(scene), scene, t, q, u, generic_inputs(scene), np.ones(len(t), bool))
    graph, traced = at.graph, at.traced
    generic = generic_states(traced, at.values)
    columns_of_rows = [[row.get(n, graph.zero) for row in at.nodes.rows] for n in traced.u.tolist()]
    columns_of_rows.append(at.nodes.vanishing["rows at rest"])
    found = generic([n for column in columns_of_rows for n in column])
    shape = len(columns_of_rows), len(traced.at.phi), -1
    A, E = (np.moveaxis(np.reshape(x, shape), (2, 1), (0, 1)) for x in (np.asarray(found), found.error))
    kept = [s for s in range(len(traced.at.phi)) if s not in rows]
    return all(is_combination(A[:, s], E[:, s], A[:, kept], E[:, kept]) for s in rows)


def generic_states(traced: TracedScene, near: Probes) -> IdentityProbes:
    """Return generic states on the geometric constraints, at generic parameters, by projection from
    `near`.
    """
    coordinates = {f"q_{i}": n for i, n in enumerate(traced.q.tolist())}
    attitudes = [f"q_{first + i}" for first in traced.quaternions for i in range(4)]
    return on_rows(identity_probes(near, attitudes), near, traced.closures, coordinates)


class _AtStates:
    """Evaluation of the graph at the probed states."""

    def __init__(self, nodes: LookedAt, scene: Scene, t, q, u, inputs, generic, **limits: int):
        self.nodes, self.traced, self.graph, self.scene = nodes, nodes.traced, nodes.graph, scene
        self.inputs = np.tile(inputs, (len(t), 1))
        self.t, self.u, self.generic, self.limits = t, u, generic, limits
        self.q_beyond, self.found = np.array(q, float), self._assembled(q)
        self.q = self.found.q
        self.values = self._probes(self.q, u)

    def _probes(self, q, u, which=slice(None)) -> Probes:
        """Return the graph evaluated at coordinates and speeds of the states with indices `which`."""
        return Probes(self.graph, named_values(self.scene, self.t[which], q, u, self.inputs[which]))

    def probed(self, u_other) -> Probed:
        """Return all probed quantities."""
        nodes = self.nodes
        return Probed(
            q=self.real(self.q),
            error=self.found.error,
            position_error=self.found.position_error,
            outside=self.found.outside,
            G=self.real(self._matrices(self.values, nodes.of_closures, self.traced.q.tolist())),
            A=self.real(self._row_matrices(self.values)),
            A_beyond=self.real(self._row_matrices(self._probes(self.q_beyond, self.u))),
            A_other=self.real(self._row_matrices(self._probes(self.q, u_other))),
            M=self.real(self._mass_matrix()),
            vanishing={name: self._at(nodes) for name, nodes in nodes.vanishing.items()},
            numbers=jax.tree.map(lambda of: self.real(self._at(of)), self.traced.particulars.numbers),
            unproved=nodes.nonanalytic | (nodes.in_calls - _MOTION),
            in_calls=nodes.in_calls & _MOTION,
        )

    def _at(self, nodes) -> np.ndarray:
        """Return values of nodes, with a leading axis of states."""
        return _values(self.values, nodes)

    def real(self, x: np.ndarray) -> np.ndarray:
        """Return numbers in the current precision; probes are computed in double precision."""
        return np.asarray(x, real_type())

    def _matrices(self, probes: Probes, entries: SparseRows, columns: list[int]) -> np.ndarray:
        """Return matrices with the given `entries`, listed by row; they have a leading axis of states."""
        place = {n: k for k, n in enumerate(columns)}
        found = np.zeros((probes.count, len(entries), len(columns)))
        places = [(i, place[n], node) for i, row in enumerate(entries) for n, node in row.items()]
        if places:
            i, j, nodes = zip(*places, strict=True)
            found[:, i, j] = _values(probes, nodes)
        return found

    def _row_matrices(self, probes: Probes) -> np.ndarray:
        """Return A at the given `probes`."""
        return self._matrices(probes, self.nodes.rows, self.traced.u.tolist())

    def _mass_matrix(self) -> np.ndarray:
        """Return `M = sum m beta' beta + gamma' I gamma`."""
        mass, inertia = self._at(self.traced.at.mass), self._at(self.traced.at.inertia)
        partial = self._matrices(self.values, self.nodes.velocities, self.traced.u.tolist())
        beta, gamma = np.moveaxis(partial.reshape(len(partial), 2, *self.traced.at.v.shape, -1), 1, 0)
        return mass_matrix(mass, inertia, beta, gamma)

    def speeds_on_rows(self) -> np.ndarray:
        """Return speeds projected onto the constraints, `u <- u - M^-1 A' (A M^-1 A')+ phi` in scaled speeds;
        NaN where constraints are NaN.
        """
        at, u = self.traced.at, np.array(self.u, float)
        if not at.phi.size:
            return u
        M = self._mass_matrix()
        c = speed_scales(M)
        scaled = c[:, :, None] * M * c[:, None]
        metric = c[:, :, None] * np.stack([_inverse_root(m) for m in scaled])  # C L'^-1

        def moved(x, which):
            return u[which] + np.einsum("sij,sj->si", metric[which], x)

        def look(x, which):
            probes = self._probes(self.q[which], moved(x, which), which)
            return _values(probes, at.phi), self._row_matrices(probes) @ metric[which]

        still, every = np.zeros(u.shape), np.arange(len(u))
        typical = typical_lengths(np.linalg.norm(look(still, every)[1], axis=2))
        x, last = nearest_root(look, lambda G, g: shortest(G, g, typical), still)
        return moved(np.where(np.isfinite(last)[:, None], x, np.nan), every)

    def _assembled(self, q) -> Assembled:
        """Return coordinates projected onto geometric constraints and unit norms, inside the domain if
        possible.
        """
        q = np.array(q, float)
        for first, _ in self.scene.coordinates.quaternions:
            length = np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
            q[:, first : first + 4] /= np.where(length == 0, 1.0, length)
        if not self.traced.at.closure.size:
            return Assembled(q, *np.zeros((3, len(q))))
        rows, entries = self.nodes.closures, self.nodes.of_closures
        place = {n: k for k, n in enumerate(self.traced.q.tolist())}
        places = [(i, place[n]) for i, row in enumerate(entries) for n in row]
        pattern = Pattern.of(places, (len(rows), len(place)))
        slopes = [node for row in entries for node in row.values()]

        def look(q, which):
            probes = self._probes(q, self.u[which], which)
            return _values(probes, rows), _values(probes, slopes)

        return assemble(look, pattern, q, *coordinate_bounds(self.scene), self.generic, **self.limits)


def _flat(nodes) -> list[int]:
    return [int(n) for part in jax.tree.leaves(nodes) for n in np.ravel(part)]


def _values(probes: Probes, nodes: np.ndarray | Iterable[int]) -> np.ndarray:
    nodes = np.asarray(nodes if isinstance(nodes, np.ndarray) else list(nodes), np.int64)
    return np.moveaxis(probes(nodes.ravel().tolist()), -1, 0).reshape(probes.count, *nodes.shape)


def _inverse_root(M: np.ndarray) -> np.ndarray:
    """Return `L'^-1` with `M = L L'`. For a singular M return the identity: a projection is then Euclidean in
    scaled speeds.
    """
    try:
        root = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        return np.eye(len(M))
    definite = np.min(np.diagonal(root), initial=1.0) ** 2 > 16 * len(M) * np.finfo(float).eps
    return np.linalg.inv(root).T if definite else np.eye(len(M))
