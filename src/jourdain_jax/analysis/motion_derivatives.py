"""Compute rates and constraints at one instant and their derivatives, for linearisation, steady motions and
families.

    v = (dq/dt, du/dt, g, phi),    D = dv/d(t, q, u, f, p)        g: closures;  p: varying parameters

The scalar program of a class of scenes gives du/dt of its independent speeds and of requested dependent
speeds; for other speeds du/dt is set to zero. Rates depend only on t, q and the independent speeds; dependent
speeds enter only phi. Scenes without such a program use dense matrices.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Entries, Indices, array_module, largest, real_type
from jourdain_jax.dynamics.accelerations import reduced_at
from jourdain_jax.dynamics.reduced import DEPENDS, ignorable_coordinates
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.reductions import Privileged
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows
from jourdain_jax.integrate.loop.value_kernels import nodes_called, values_of_nodes
from jourdain_jax.kernels import ffi
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.lowering.lower import lower
from jourdain_jax.lowering.lowered_equations import Lowered, NotLowered
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.program.derivative import matrix as dense_jacobian
from jourdain_jax.program.emit import run
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.row_program import row_program
from jourdain_jax.structure.structure import check_bodies, structure_of, usual_rows

Slopes = tuple[Float[Entries, "values"], Float[Entries, "values columns"], Float[Entries, "_ _"]]
Nodes = Int[np.ndarray, "_ _"]


class Places(NamedTuple):
    """Indices of the parts of v and of the columns of D. In g, geometric constraints precede unit norms."""

    qdot: np.ndarray
    udot: np.ndarray
    g: np.ndarray
    phi: np.ndarray
    t: np.ndarray
    q: np.ndarray
    u: np.ndarray
    f: np.ndarray
    geometric: np.ndarray


def places_of(scene: Scene) -> Places:
    """Return the indices of the parts of v and of the columns of D, for a scene."""
    n = len(scene.coordinate_names.entries)
    m = len(scene.speed_names.entries)
    geometric = len(names_of_position_rows(scene))
    of_rows = _ranges(n, m, geometric + len(scene.coordinates.quaternions), len(names_of_rows(scene)))
    return Places._make([*of_rows, *_ranges(1, n, m, len(scene.inputs)), of_rows[2][:geometric]])


def _ranges(*counts: int) -> list[np.ndarray]:
    return np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])


class Sloped:
    """Function of a vector of numbers that returns the nodes v, their Jacobian D and optionally a matrix of
    other nodes. Concrete numbers are evaluated by machine code or NumPy, traced ones by machine code or XLA.
    """

    def __init__(
        self,
        graph: Graph,
        v: Sequence[int],
        columns: Sequence[int],
        given: Sequence[int],
        guards: Sequence[int],
        matrix: Nodes | None = None,
    ) -> None:
        matrix = np.zeros((0, 0), int) if matrix is None else matrix
        D = dense_jacobian(graph, v, columns)
        parts = [np.array(part, int) for part in (v, D, matrix, guards)]
        nodes = np.unique(np.concatenate([*map(np.ravel, parts)])).tolist()
        self._which = [np.searchsorted(nodes, part) for part in parts]
        self._values, self.is_made = node_values(graph, nodes, given), not unsupported(graph, nodes)

    def __call__(self, numbers: Float[Entries, "numbers"]) -> Slopes:
        """Return v, D and the matrix, if there is one. All are NaN if a guard is not positive."""
        xp, found = array_module(numbers), self._values(numbers)
        *values, guards = (found[which] for which in self._which)
        v, D, matrix = (xp.where(xp.all(guards > 0), x, xp.nan) for x in values)
        return v, D, matrix


class ByProgram:
    """Scalar program for the rates and constraints v of a class of scenes, their Jacobian D, and the mass
    matrix unless it is too large. Its argument is a vector of all numbers: parameters, t, q, u, inputs.
    """

    def __init__(self, scene: Scene, program: Lowered, asked: Indices, varied: Indices = ()) -> None:
        rows = row_program(scene)
        if rows is None:
            raise NotLowered(f"the constraints of `{type(scene).__name__}` have no scalar program")
        graph, of, n, m = Graph(), program.traced, len(program.coordinates), len(program.speeds)
        first = sum(np.size(leaf) for leaf in jax.tree.leaves(scene))
        given = [graph.input(f"x{k}", True) for k in range(first + 1 + n + m + len(scene.inputs))]
        t, q, u = given[first], given[first + 1 :][:n], given[first + 1 + n :][:m]
        of_rates = [program.qdot, program.ydot, program.z if asked else (), program.guards]
        qdot, ydot, z, self.guards = _copied(
            graph, of_rates, program.graph, (of.parameters, of.t, of.q, of.u, of.inputs), given
        )
        M, self.has_masses = rows.M or {}, rows.M is not None
        g, phi, of_masses = _copied(
            graph,
            [rows.g, rows.phi, M.values()],
            rows.graph,
            (rows.parameters, rows.t, rows.q, rows.u, rows.inputs),
            given,
        )
        udot = dict(zip(program.independent, ydot, strict=True))
        if asked:
            motion = (
                {t: graph.one} | dict(zip(q, qdot, strict=True)) | {u[k]: node for k, node in udot.items()}
            )
            dependent = dict(zip(program.dependent, z, strict=True))
            udot |= dict(zip(asked, derivatives(graph, [dependent[k] for k in asked], motion), strict=True))
        self.graph, self.given, self.program, self.states = graph, given, program, (first + 1, n, m)
        self.v = [*qdot, *(udot.get(k, graph.zero) for k in range(m)), *g, *phi]
        self.columns = [*given[first:], *(given[k] for k in varied)]
        matrix = np.full((m, m), graph.zero)
        for (i, k), node in zip(M, of_masses, strict=True):
            matrix[i, k] = matrix[k, i] = node
        self.of = Sloped(graph, self.v, self.columns, given, self.guards, matrix)

    def __call__(self, scene: Scene, t, q, u, f) -> Slopes:
        """Return v, D and the mass matrix of a scene at an instant."""
        return self.of(numbers_of(scene, t, q, u, f))


def numbers_of(scene: Scene, t, q, u, f) -> Float[Entries, "numbers"]:
    """Return all numbers as one vector: parameters, t, q, u, inputs."""
    xp = array_module((scene, t, q, u, f))
    parts = [*jax.tree.leaves(scene), t, q, u, f]
    return xp.concatenate([xp.ravel(xp.asarray(x, real_type())) for x in parts])


@dataclass(frozen=True)
class ByMatrices:
    """Function for v, D and the mass matrix from dense matrices, differentiated by JAX. `constant`: indices
    of the speeds taken as independent, whose accelerations v contains.
    """

    constant: Indices

    @compiled_quickly
    def __call__(self, scene: Scene, t, q, u, f) -> Slopes:
        """Return v, D and the mass matrix of a scene at an instant."""
        at = places_of(scene)

        def instant(x):
            t, q, u, f = x[at.t[0]], x[at.q], x[at.u], x[at.f]
            found, equations, rows = reduced_at(
                scene, t, q, u, f, Privileged(self.constant), None, usual_rows(scene)
            )
            v = [coordinate_rates(scene, t, q, u), found.udot, closure_residual(scene, t, q), rows.phi]
            return jnp.concatenate(v), equations.M

        x = jnp.hstack([t, q, u, f])
        v, slope, M = jax.linearize(instant, x, has_aux=True)
        return v, jax.vmap(slope, out_axes=1)(jnp.eye(len(x), dtype=x.dtype)), M


def instant_of(scene: Scene | BuiltFor, constant: Indices, masses: bool = False) -> "ByProgram | ByMatrices":
    """Return the function that evaluates the rates and constraints v of a scene and their Jacobian D at an
    instant. `constant`: indices of the speeds whose accelerations are needed; `masses`: whether the mass
    matrix is needed.
    """
    check_bodies(as_scene(scene))
    if ffi.reason_against() or (isinstance(scene, BuiltFor) and scene.backend == "xla"):
        return ByMatrices(constant)
    try:
        program = lower(scene)
        found = by_program(
            as_scene(scene), program, tuple(k for k in constant if k not in program.independent)
        )
    except NotLowered:
        return ByMatrices(constant)
    return found if found.of.is_made and (found.has_masses or not masses) else ByMatrices(constant)


def steadiness(scene: Scene, v, D, y: np.ndarray) -> tuple:
    """Return the largest magnitudes of dy/dt and of d2y/dt2 along the motion; both are zero in a steady
    motion. `y`: places of the independent accelerations in v.
    """
    at, xp = places_of(scene), array_module(v)
    along = xp.concatenate([np.ones(1, v.dtype), v[at.qdot], v[at.udot], np.zeros(len(at.f), v.dtype)])
    return largest(v[y]), largest(D[y] @ along)


def unseen(instant: "ByProgram | ByMatrices", scene: Scene) -> set[str]:
    """Return the names of ignorable coordinates, which do not affect accelerations; for a quaternion, the
    names of its components.
    """
    return entries_of(
        scene, instant.program.held if isinstance(instant, ByProgram) else ignorable_coordinates(scene)
    )


def entries_of(scene: Scene, names: Iterable[str]) -> set[str]:
    """Return the names, with each quaternion or angular velocity replaced by its components."""
    groups = {
        group: scene.coordinate_names.entries[first : first + length]
        for group, first, length in scene.coordinate_names.groups
    }
    return {entry for name in names for entry in groups.get(name, (name,))}


by_program = once_per_class(ByProgram)  # raises `NotLowered` if there is no scalar program


def on_rows(scene: Scene) -> np.ndarray:
    """Return a mask of the coordinates on which geometric constraints and unit norms depend at some probed
    state. A coordinate that occurs in the graph but cancels is not among them.
    """
    return np.any(np.abs(structure_of(scene).closure_slopes) > DEPENDS, axis=(0, 1))


def _copied(
    graph: Graph, parts: Sequence, of: Graph, variables: tuple, given: Sequence[int]
) -> list[list[int]]:
    """Copy lists of nodes from another graph. `given` replaces the variables: parameters (by leaf), t, q, u
    and inputs.
    """
    parameters, *rest = variables
    places = [int(n) for part in (*parameters, *rest) for n in np.ravel(part)]
    new = graph.copied(
        [n for part in parts for n in part], of, {n: x for n, x in zip(places, given, strict=True) if n >= 0}
    )
    return [[new[n] for n in part] for part in parts]


def node_values(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> Callable[[Entries], Entries]:
    """Return a function from variables to values of nodes, which JAX can differentiate: by machine code if
    possible, otherwise known numbers by NumPy and traced ones by XLA.
    """
    if made := not (ffi.reason_against() or unsupported(graph, nodes)):
        traced = values_of_nodes(graph, nodes, variables)
    else:
        named = lambda x: dict(zip(variables, x, strict=True))
        traced = lambda x: jnp.stack([jnp.asarray(y, x.dtype) for y in run(graph, nodes, named(x))])
    if made and jax.config.jax_enable_x64:
        known = jax.jit(nodes_called(graph, nodes, variables, effort=0))
    else:
        inputs = [graph.value[n] for n in variables]
        known = lambda x: Probes(graph, dict(zip(inputs, x[:, None], strict=True)))(nodes)[:, 0]
    return lambda x: traced(x) if array_module(x) is jnp else np.asarray(known(x))
