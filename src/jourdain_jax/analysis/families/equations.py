"""Equations of steady motions as one scalar program, with their slopes.

    R(z) = ( g,  phi,  dy/dt,  dq_j/dt ) = 0,      J = dR/dz        z: coordinates that matter, all speeds, and maybe one parameter of the scene

y: the independent speeds of the scalar program; j: the coordinates that must rest. Coordinates on which nothing of this depends, a heading say, stay out.
Unknowns are measured in units of their size, rows in SI units. Small motions about a steady one:

    x = (dq, dy) = E s,   ds/dt = A s,   A = E' F E        E: orthonormal, spans the x that the rows allow, C x = 0;   F = d(dq/dt, dy/dt)/d(q, y)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jourdain_jax.build.assembling import coordinate_bounds
from jourdain_jax.build.row_program import row_program
from jourdain_jax.build.sampling import sample_states
from jourdain_jax.dynamics.reduced import DEPENDS, PROBES
from jourdain_jax.lowering.lower import lower
from jourdain_jax.lowering.lowered import Lowered, NotLowered
from jourdain_jax.motion.native.called import nodes_called
from jourdain_jax.motion.native.values_of_nodes import values_of_nodes
from jourdain_jax.native import ffi
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.derivative import derivatives, jacobian
from jourdain_jax.program.emit import run
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.identity import once_per_class, once_per_values
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene

Vector = Float[np.ndarray, "unknowns"]


@dataclass(frozen=True)
class Look:
    """The equations at one point, in units of rows and unknowns."""

    R: Float[np.ndarray, "rows"]
    J: Float[np.ndarray, "rows unknowns"]
    F: Float[np.ndarray, "states states"]  # of (q, y), SI units
    C: Float[np.ndarray, "rows_of_states states"]  # rows that (dq, dy) meet


class SteadyProgram:
    """One graph of rows and rates of a class of scenes, with slopes; functions of all numbers in a row: parameters, t, q, u, inputs."""

    def __init__(self, scene: Scene, program: Lowered, kept: tuple[int, ...], resting: tuple[int, ...], places: tuple[int, ...]) -> None:
        rows = row_program(scene)
        if rows is None:
            raise NotLowered(f"the rows of `{type(scene).__name__}` have no scalar program, which its families of steady motions need")
        graph, of, n = Graph(), program.traced, len(program.coordinates)
        parameters = sum(np.size(leaf) for leaf in jax.tree.leaves(scene))
        every = [graph.input(f"x{k}", True) for k in range(parameters + 1 + n + len(program.speeds) + len(scene.inputs))]
        new = graph.copied([*program.qdot, *program.ydot, *program.guards], program.graph, _known((of.parameters, of.t, of.q, of.u, of.inputs), every))
        new_rows = graph.copied([*rows.g, *rows.phi], rows.graph, _known((rows.parameters, rows.t, rows.q, rows.u, rows.inputs), every))
        g, phi = [new_rows[n] for n in rows.g], [new_rows[n] for n in rows.phi]
        qdot, ydot, guards = ([new[n] for n in nodes] for nodes in (program.qdot, program.ydot, program.guards))
        held = [*g, *phi, *ydot, *(qdot[k] for k in resting)]
        rates = [*(qdot[k] for k in kept), *ydot]
        states = [*(every[parameters + 1 + k] for k in kept), *(every[parameters + 1 + n + k] for k in program.independent)]
        self.in_states = [*range(len(kept)), *(len(kept) + k for k in program.independent)]
        of_states = [*g, *(phi if len(program.independent) == len(program.speeds) else [])]
        self.rows, self.rates = len(held), len(held) + len(rates)  # where they end among the results of `_moved`
        self.entries, nodes = {}, list(held)
        for name, outputs, variables in (("J", held, [every[k] for k in places]), ("F", rates, states), ("C", of_states, states)):
            column = {x: k for k, x in enumerate(variables)}
            entries = [(i, column[x], node) for i, row in enumerate(jacobian(graph, outputs, variables)) for x, node in row.items()]
            where = np.array([entry[:2] for entry in entries], int).reshape(-1, 2).T
            self.entries[name] = (len(outputs), len(variables)), tuple(where), slice(len(nodes), len(nodes) + len(entries))
            nodes += [node for *_, node in entries]
        self.guards = slice(len(nodes), None)
        self.values = _evaluated(graph, [*nodes, *guards], every)
        direction = [graph.input(f"a{k}", True) for k in range(len(states))]
        moved = [*held, *derivatives(graph, [*rates, *of_states], dict(zip(states, direction, strict=True))), *guards]
        self._moved, self._defined = _differentiable(graph, moved, [*every, *direction]), len(moved) - len(guards)
        self._pulled = jax.jit(jax.jacrev(self._weighted))

    def along(self, numbers: Float[Array, "numbers"], directions: Float[Array, "directions states"]) -> tuple[Array, Array, Array]:
        """R, and F a and C a for each direction a of (q, y), as JAX differentiates them."""
        found = self._along(numbers, directions)
        found = jnp.where(jnp.all(found[:, self._defined :] > 0), found[:, : self._defined], jnp.nan)
        return found[0, : self.rows], found[:, self.rows : self.rates], found[:, self.rates :]

    def _along(self, numbers, directions) -> Float[Array, "directions results"]:
        return jax.vmap(lambda a: self._moved(jnp.concatenate([numbers, a])))(directions)

    def _weighted(self, numbers, directions, of_rows, of_rates) -> Float[Array, "2"]:
        real, imag = self._along(numbers, directions)
        total = of_rows @ real[: self.rows] + of_rates @ (real + 1j * imag)[self.rows : self.rates]
        return jnp.stack([total.real, total.imag])

    def pulled(self, numbers: np.ndarray, directions: np.ndarray, of_rows: np.ndarray, of_rates: np.ndarray) -> Complex[np.ndarray, "numbers"]:
        """Derivatives of `of_rows . R + of_rates . F (a + i b)` by all numbers, given the directions a and b."""
        real, imag = np.asarray(self._pulled(numbers, directions, of_rows, of_rates))
        return real + 1j * imag


@once_per_class
def _steady_program(scene: Scene, *parts) -> SteadyProgram:
    return SteadyProgram(scene, *parts)


class SteadyEquations:
    """R, J, F and the rows of (q, y) of one scene as functions of z."""

    def __init__(self, scene: Scene, guess: tuple[float, np.ndarray, np.ndarray], inputs: np.ndarray, vary: str | None) -> None:
        self.scene, self.vary, (self.t, q, u) = scene, vary, guess
        self.names = (*scene.coordinate_names.entries, *scene.speed_names.entries)
        leaves = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(scene)]
        self.given = np.concatenate([*leaves, [self.t], q, u, inputs])
        self._counts = sum(map(len, leaves)), len(q), len(u)
        program = lower(scene)
        kept, resting = _coordinates(scene, program)
        first, n = self._counts[0] + 1, len(q)
        self.places = np.array([*(first + k for k in kept), *range(first + n, first + n + len(u)), *self._place_of(vary)], int)
        self.unknowns = (*(self.names[k] for k in kept), *scene.speed_names.entries, *([] if vary is None else [vary]))
        self.size = _sizes(scene, kept, self.given[self.places])
        self.program = _steady_program(scene, program, tuple(kept), tuple(resting), tuple(self.places.tolist()))

    @property
    def start(self) -> Vector:
        """The guess, in units of the unknowns' sizes."""
        return self.given[self.places] / self.size

    def index(self, name: str) -> int:
        """Number of an unknown; a ValueError with the nearest names where there is none."""
        if name not in self.unknowns:
            raise ValueError(f"`{name}` is no unknown of the steady motions of `{type(self.scene).__name__}`; {nearest(name, self.unknowns)}")
        return self.unknowns.index(name)

    def _place_of(self, vary: str | None) -> list[int]:
        """The place of a parameter among all numbers of the scene."""
        if vary is None:
            return []
        place = 0
        for path, leaf in jax.tree_util.tree_flatten_with_path(self.scene)[0]:
            if path == (jax.tree_util.GetAttrKey(vary),) and np.ndim(leaf) == 0:
                return [place]
            place += np.size(leaf)
        advice = nearest(vary, [name for name, value, _ in parameters_of(self.scene) if np.ndim(value) == 0])
        raise ValueError(f"`vary` names `{vary}`, expected a parameter of `{type(self.scene).__name__}` that is one number; {advice}")

    def __call__(self, z: Vector) -> Look:
        """The equations at z."""
        program, values = self.program, self.program.values(self.at(z))
        if np.any(values[program.guards] <= 0):
            values = np.full(len(values), np.nan)  # where the rates are not defined
        matrices = {}
        for name, (shape, where, here) in program.entries.items():
            matrices[name] = np.zeros(shape)
            matrices[name][where] = values[here]
        return Look(values[: program.rows], matrices["J"] * self.size, matrices["F"], matrices["C"])

    def at(self, z: Vector) -> np.ndarray:
        """All numbers, those of the unknowns by z."""
        given = self.given.copy()
        given[self.places] = z * self.size
        return given

    def in_states(self, directions: Float[np.ndarray, "unknowns directions"]) -> Float[np.ndarray, "states directions"]:
        """Directions of z, without a parameter, as ones of (q, y) in SI units."""
        return (directions * self.size[: len(directions), None])[self.program.in_states]

    def value_at_start(self, name: str) -> float:
        """The value of a coordinate or speed that is no unknown."""
        return float(self.given[self._counts[0] + 1 + self.names.index(name)])

    def place(self, point) -> Vector:
        """z of what has the values of the unknowns by name."""
        return np.array([point[name] for name in self.unknowns]) / self.size

    def split(self, numbers):
        """q, u and the parameter that varies (or NaN)."""
        parameters, n, m = self._counts
        q, u = (numbers[first : first + length] for first, length in ((parameters + 1, n), (parameters + 1 + n, m)))
        return q, u, numbers[self.places[-1]] if self.vary else 0 * numbers[0] + np.nan


def _coordinates(scene: Scene, program: Lowered) -> tuple[list[int], list[int]]:
    """Numbers of the coordinates that are unknowns, and of those that must rest: accelerations depend on them."""
    on_rows, ignorable = _on_rows(scene), [name in program.held for name in program.coordinates]
    every = range(len(ignorable))
    return [k for k in every if not ignorable[k] or on_rows[k]], [k for k in every if not ignorable[k]]


@once_per_values
def _on_rows(scene: Scene) -> np.ndarray:
    """Which coordinates geometric rows depend on, at some state of the domain."""
    rows = row_program(scene)
    t, q, u = (np.asarray(x, float) for x in sample_states(scene, PROBES))
    columns = [*[np.full(PROBES, x) for leaf in jax.tree.leaves(scene) for x in np.ravel(leaf)], t, *q.T, *u.T, *[np.zeros(PROBES)] * len(scene.inputs)]
    nodes = [*_flat(rows.parameters), rows.t, *rows.q, *rows.u, *rows.inputs]
    at = Probes(rows.graph, {rows.graph.value[n]: column for n, column in zip(nodes, columns, strict=True) if n >= 0})
    depends = np.zeros(len(scene.coordinate_names.entries), bool)
    for (_, k), node in rows.G.items():
        depends[k] |= np.max(np.abs(at([node]))) > DEPENDS
    return depends


def _sizes(scene: Scene, kept: Sequence[int], values: np.ndarray) -> np.ndarray:
    low, high = coordinate_bounds(scene)
    of_coordinates = [high[k] - low[k] if high[k] > low[k] else 1.0 for k in kept]
    of_speeds = [10.0] * len(scene.speed_names.entries)  # SI units
    of_parameter = [abs(x) if x else 1.0 for x in values[len(of_coordinates) + len(of_speeds) :]]
    return np.array([*of_coordinates, *of_speeds, *of_parameter])


def _flat(parts) -> list[int]:
    return [int(n) for part in parts for n in np.ravel(part)]


def _known(variables, inputs: Sequence[int]) -> dict[int, int]:
    """Inputs of a graph in the place of a program's variables: parameters by leaf, t, q, u, inputs."""
    parameters, *rest = variables
    return {n: x for n, x in zip([*_flat(parameters), *_flat(rest)], inputs, strict=True) if n >= 0}


def _evaluated(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> Callable[[np.ndarray], np.ndarray]:
    """Values of nodes as a function of those of the variables: by machine code where it is made, otherwise by NumPy, operation by operation."""
    if jax.config.jax_enable_x64 and _is_made(graph, nodes):
        kernel = jax.jit(nodes_called(graph, nodes, variables, effort=0))
        return lambda given: np.asarray(kernel(given))
    return lambda given: Probes(graph, dict(zip([graph.value[n] for n in variables], given[:, None], strict=True)))(nodes)[:, 0]


def _differentiable(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> Callable[[Array], Array]:
    """Values of nodes as a function that JAX differentiates: by machine code where it is made, otherwise by XLA."""
    if _is_made(graph, nodes):
        return values_of_nodes(graph, dict(enumerate(nodes)), len(nodes), variables)
    return lambda x: jnp.stack([jnp.asarray(value, x.dtype) for value in run(graph, nodes, dict(zip(variables, x, strict=True)))])


def _is_made(graph: Graph, nodes: Sequence[int]) -> bool:
    return not ffi.reason_against() and not unsupported(graph, nodes)
