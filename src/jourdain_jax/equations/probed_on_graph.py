"""What is looked at of a scene at each probed state, on its scalar graph: derivatives are taken on the graph, everything is evaluated on NumPy.

    A = d phi/du,   beta = dv/du,   gamma = d omega/du,   M = sum m beta' beta + gamma' I gamma,   q <- q - G+ g(q),   G = dg/dq

A scene is traced once for it, where JAX (`probed`) traces it a dozen times through nested transformations, which takes most of the time for large scenes.
"""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.equations.probed import Probed, generic_inputs
from jourdain_jax.equations.trace import TracedScene, named_values, traced_scene
from jourdain_jax.program.derivative import derivatives, jacobian
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.scene import Scene

ITERATIONS = 25  # of Gauss-Newton, at most
_NEARLY_DEPENDENT = 1e-6  # of the triangular factor's diagonal: below, singular values decide


def probed_on_graph(scene: Scene, t, q, u, u_other) -> Probed:
    """The scene at states (t, q, u), put on the geometric rows; and its rows at `u_other`. `Unsupported` where the scene has no scalar form."""
    traced = traced_scene(scene)
    return _AtStates(traced, scene, t, q, u).probed(u_other)


class _AtStates:
    """Values on the graph at the probed states."""

    def __init__(self, traced: TracedScene, scene: Scene, t, q, u):
        self.traced, self.graph, self.scene = traced, traced.graph, scene
        self.real = jnp.result_type(float)
        self.inputs = np.tile(generic_inputs(scene), (len(t), 1))
        self.t, self.u = t, u
        self.q, self.miss = self._on_rows(q)
        self.values = self._probes(self.q, u)

    def _probes(self, q, u, which=slice(None)) -> Probes:
        named = named_values(self.scene, self.t[which], q, u[which], self.inputs[which])
        return Probes(self.graph, {name: np.asarray(value, float) for name, value in named.items()})

    def probed(self, u_other) -> Probed:
        """All that is looked at."""
        g, at, traced = self.graph, self.traced.at, self.traced
        u, count = traced.u.tolist(), len(self.t)
        flat = [*at.phi.tolist(), *at.v.ravel().tolist(), *at.omega.ravel().tolist()]
        by_speed = jacobian(g, flat, u)
        rows, parts = len(at.phi), 3 * len(at.mass)
        partial = self._matrices(self.values, by_speed[rows:], u)
        still = dict.fromkeys(u, g.zero)
        at_rest = np.split(g.substituted([*flat, *at.qdot.tolist()], still), [rows])
        weights = [*at.mass.tolist(), *at.inertia.ravel().tolist()]
        poses = [*at.position.ravel().tolist(), *at.orientation.ravel().tolist()]
        by_time = {"rows": [*at.phi.tolist(), *at.closure.tolist()], "poses": poses, "inertias": weights, "coordinate rates": at.qdot.tolist()}
        along = {traced.t: g.one} | dict(zip(traced.q.tolist(), at.qdot.tolist(), strict=True))
        changed = {n: g.mul(n, n) for n in traced.inputs.tolist()}
        return Probed(
            q=self._real(self.q),
            miss=self._real(self.miss),
            A=self._real(self._matrices(self.values, by_speed[:rows], u)),
            A_other=self._real(self._matrices(self._probes(self.q, u_other), by_speed[:rows], u)),
            M=self._real(_mass_matrix(self._at(at.mass), self._at(at.inertia), partial[:, :parts], partial[:, parts:], count)),
            phi_at_rest=self._real(self._at(at_rest[0])),
            motion_at_rest=self._real(self._at(at_rest[1])),
            timed={name: self._at(derivatives(g, nodes, {traced.t: g.one})) for name, nodes in by_time.items()}
            | jax.tree.map(self._at, traced.particulars.explicit),
            inertia_rates=self._at(derivatives(g, weights, along)),
            potential_rates=self._at(derivatives(g, traced.particulars.potentials.tolist(), changed)),
            numbers=jax.tree.map(lambda nodes: self._real(self._at(nodes)), traced.particulars.numbers),
        )

    def _at(self, nodes) -> np.ndarray:
        """Values of nodes, with a leading axis of states."""
        return _values(self.values, nodes)

    def _real(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(x, self.real)

    def _matrices(self, probes: Probes, entries: list[dict[int, int]], columns: list[int]) -> np.ndarray:
        """Matrices with these entries by row, with a leading axis of states."""
        place = {n: k for k, n in enumerate(columns)}
        found = np.zeros((probes.count, len(entries), len(columns)))
        places = [(i, place[n], node) for i, row in enumerate(entries) for n, node in row.items()]
        if places:
            i, j, nodes = zip(*places, strict=True)
            found[:, i, j] = _values(probes, nodes)
        return found

    def _on_rows(self, q) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates on geometric rows and unit norms, and how far they miss them; as `project_positions`."""
        g, q = self.graph, np.array(q, float)
        norms = []
        for first, _ in self.scene.coordinates.quaternions:
            wxyz = self.traced.q[first : first + 4].tolist()
            norms.append(g.mul(g.const(0.5), g.sub(g.dot(wxyz, wxyz), g.one)))
            if not self.traced.at.closure.size:
                length = np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
                q[:, first : first + 4] /= np.where(length == 0, 1.0, length)
        rows, columns = [*self.traced.at.closure.tolist(), *norms], self.traced.q.tolist()
        if self.traced.at.closure.size:
            entries = jacobian(g, rows, columns)
            moving = np.arange(len(q))
            for _ in range(ITERATIONS):
                probes = self._probes(q[moving], self.u, moving)
                G, residual = self._matrices(probes, entries, columns), _values(probes, rows)
                shift = _shortest(G, residual)
                q[moving] -= shift
                moving = moving[np.max(np.abs(shift), axis=1) > 4 * np.finfo(float).eps * (1 + np.max(np.abs(q[moving]), axis=1))]
                if not moving.size:
                    break
        missed = np.max(np.abs(_values(self._probes(q, self.u), rows)), axis=1, initial=0.0)
        return q, np.where(np.isfinite(missed), missed, np.inf)


def _values(probes: Probes, nodes: np.ndarray | Iterable[int]) -> np.ndarray:
    nodes = np.asarray(nodes if isinstance(nodes, np.ndarray) else list(nodes), np.int64)
    return np.moveaxis(probes(nodes.ravel().tolist()), -1, 0).reshape(probes.count, *nodes.shape)


def _mass_matrix(mass, inertia, beta, gamma, count: int) -> np.ndarray:
    """`M = sum m beta' beta + gamma' I gamma`, with a leading axis of states."""
    turned = np.einsum("sbij,sbjk->sbik", inertia, gamma.reshape(count, -1, 3, gamma.shape[-1])).reshape(gamma.shape)
    weighted = np.repeat(mass, 3, axis=1)[..., None] * beta
    return np.swapaxes(beta, 1, 2) @ weighted + np.swapaxes(gamma, 1, 2) @ turned


def _shortest(G: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """The shortest x with `G x = residual`, at every state; least squares where the rows are (nearly) dependent."""
    length = np.linalg.norm(G, axis=2)
    d = 1 / np.where(length > 0, length, 1.0)
    G, residual = d[..., None] * G, d * residual
    finite = np.all(np.isfinite(G), axis=(1, 2)) & np.all(np.isfinite(residual), axis=1)
    x = np.full((len(G), G.shape[2]), np.nan)
    Q, R = np.linalg.qr(np.swapaxes(G[finite], 1, 2))  # G = R' Q'
    diagonal = np.abs(np.diagonal(R, axis1=1, axis2=2))
    regular = np.min(diagonal, axis=1, initial=1.0) > _NEARLY_DEPENDENT if G.shape[1] <= G.shape[2] else np.zeros(len(R), bool)
    places = np.flatnonzero(finite)
    if regular.any():
        x[places[regular]] = (Q[regular] @ np.linalg.solve(np.swapaxes(R[regular], 1, 2), residual[places[regular], :, None]))[..., 0]
    for k in places[~regular]:
        x[k] = np.linalg.lstsq(G[k], residual[k], rcond=_NEARLY_DEPENDENT**1.5)[0]
    return x
