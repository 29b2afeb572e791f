"""Lowered equations of a scene: the scalar program, its outputs, and its execution in JAX."""

import functools
import importlib.util
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jourdain_jax.calculus.reals import PerLane
from jourdain_jax.lowering import export
from jourdain_jax.program.derivative import differentiable
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import ARRAYS, Graph
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.trace import Variables

Nodes = tuple[int, ...]  # node indices

# fields of a program that contain nodes, except `power`
NODES = (
    *("qdot", "ydot", "pivots", "directions", "squares", "guards", "events", "resets", "energies"),
    *("projected_q", "projected_u", "relations", "event_relations", "sided"),
)


class NotLowered(Exception):
    """Error raised if a scene cannot be lowered, with the reason."""


@dataclass(frozen=True)
class Stage:
    """Step of lowering, for the summary."""

    name: str
    operations: int


@dataclass(frozen=True, eq=False)
class Lowered:
    """Scalar program for the rates of the minimal state (q, y), or of the full state (y = u), of a class of
    scenes. Its inputs include the parameters.

    Programs are compared by identity, so that they can be static arguments of compiled functions.
    """

    traced: Variables
    scene_name: str
    parameters: Labels  # names of the scene's leaves
    units: Labels  # of the parameters, empty if not stated
    conventions: str  # the scene's description of its axes
    coordinates: Labels
    speeds: Labels
    inputs: Labels
    independent: Nodes
    dependent: Nodes
    qdot: Nodes
    ydot: Nodes
    z: Nodes  # dependent speeds
    # relative to their size at a probe; must keep their signs. Divisors of coordinate rates come first
    pivots: Nodes
    divisors: int  # number of these divisors
    directions: Nodes  # of constraints nonlinear in the speeds, one entry per speed; must not reverse
    # for each constraint with a multiplier: its remainder after elimination of the earlier ones, and its
    # size; the ratio is a squared sine
    squares: Nodes
    guards: Nodes  # must stay positive
    power: int  # `rate_of_work`: d(T + V)/dt at constant inputs, or the part of it that is integrated
    events: Nodes  # values of the events, sorted by name; empty if they have no scalar form
    # values after each event: coordinates, speeds of the state, modes, and the gain of the energy stored in
    # loads; empty if all events stop the motion
    resets: Nodes
    stops: tuple[bool, ...]  # whether each event stops the motion
    energies: Nodes  # kinetic and potential
    relations: Nodes  # numbers whose signs decide between branches of the rates (`lowering/relations.py`)
    event_relations: Nodes  # further such numbers, of the events
    sided: Nodes  # such numbers whose branches are both defined beyond the zero (`lowering/sides.py`)
    projected_q: Nodes  # coordinates projected onto norms and geometric constraints, one step of Gauss-Newton
    projected_u: Nodes  # all speeds projected onto the constraints; empty if dependent speeds are eliminated
    at_start: Nodes  # switching contacts at the start of a motion (`contacts_at_start`)
    by_partition: bool  # all speeds are in the state, but the accelerations come from independent ones
    left_out: Labels  # redundant constraints
    held: Labels  # ignorable coordinates, which have reference values in the accelerations
    stages: tuple[Stage, ...]
    way: str  # description of the strategy with the fewest operations
    seconds: float  # duration of lowering
    fixed: Nodes  # nodes that depend only on parameters, computed once per motion
    # whether each relation has integer sides (`floor`, `ceil`); relations are the last modes and events
    sides: tuple[bool, ...]

    @property
    def graph(self) -> Graph:
        """Return the graph of all nodes."""
        return self.traced.graph

    @property
    def operations(self) -> int:
        """Return the number of operations per evaluation of all rates."""
        return self.graph.operations([*self.qdot, *self.ydot])

    def summary(self) -> str:
        """Return a text: numbers of operations, omitted parts, JAX calls, independent speeds, pivots and
        guards.
        """
        return export.summary(self)

    def __str__(self) -> str:
        return self.summary()

    def python_source(self) -> str:
        """Return the program as readable Python, in SI units and radians: `fixed(parameters)` and
        `rates(fixed, t, state)`.
        """
        return export.python_source(self)

    def c_source(self, name: str = "rates") -> str:
        """Return the program as a C function `name`, in SI units and radians, with a comment on its
        arguments.
        """
        return export.c_source(self, name)

    def expressions(self) -> "dict[str, Any]":
        """Return SymPy expressions of all rates, by name. Requires SymPy. For large scenes, expressions fill
        many pages.
        """
        return export.expressions(self)

    def latex(self) -> str:
        """Return one equation per rate for an `align` environment, with numbers of six digits. Requires
        SymPy.
        """
        return export.latex(self)

    def _repr_latex_(self) -> str | None:
        """Return the equations for display in a notebook. For more than 100 operations, or without SymPy,
        return None, so that the summary is displayed.
        """
        if self.operations > 100 or importlib.util.find_spec("sympy") is None:
            return None
        return "$$\\begin{aligned}\n" + self.latex() + "\n\\end{aligned}$$"

    def fixed_values(self, scene: Scene) -> tuple[Num[Array, "..."], ...]:
        """Return the values that depend only on parameters, for the parameters of `scene`. They are computed
        once per motion.
        """
        place = {
            int(n): (k, i)
            for k, nodes in enumerate(self.traced.parameters)
            for i, n in enumerate(np.ravel(nodes))
        }
        leaves = [jnp.reshape(leaf, -1) for leaf in jax.tree.leaves(scene)]
        known: dict = {}
        for n in self.graph.reachable(self.fixed):
            args = self.graph.args[n]
            whole = self.graph.op[n] == "array" and all(a in place for a in args)
            owners = {place[a][0] for a in args} if whole else ()
            if len(owners) == 1:  # read all entries of one parameter in one operation
                entries = leaves[owners.pop()][np.array([place[a][1] for a in args])]
                known[n] = entries.reshape(self.graph.value[n][0])
        for n in self.graph.needed(self.fixed, known):
            if n in place:
                leaf, i = place[n]
                known[n] = leaves[leaf][i]
        return tuple(jnp.asarray(x) for x in run(self.graph, self.fixed, known))

    def rates(
        self, fixed, t, q: Sequence, y: Sequence, inputs, with_power: bool = False
    ) -> tuple[tuple, tuple, PerLane | None]:
        """Return `qdot` and `ydot`, tuples of scalars, and the power (W) if `with_power`. The first entry of
        `qdot` is NaN if a guard is not positive.

        `fixed`: result of `fixed_values`; `q`, `y`: coordinates and independent speeds, one scalar (or batch)
        each; `inputs`: a vector.
        """
        return self.rates_and_pivots(fixed, t, q, y, inputs, with_power)[:3]

    def rates_and_pivots(self, fixed, t, q: Sequence, y: Sequence, inputs, with_power: bool = False) -> tuple:
        """Return the results of `rates`, the pivots, the directions of constraints, and a sine: the smallest
        sine of the angle between a constraint with multiplier and the span of the earlier ones (None without
        multipliers). Pivots must keep their signs. Only the rates have derivatives.

        `fixed`, `t` (s), `q`, `y`, `inputs`, `with_power`: as in `rates`.
        """
        found = iter(_program_of_rates(self, with_power)(*self._known(fixed, t, q, y, inputs).values()))
        taken = lambda nodes: tuple(itertools.islice(found, len(nodes)))
        (first, *qdot), ydot, power = taken(self.qdot), taken(self.ydot), next(found) if with_power else None
        for guard in taken(self.guards):
            first = jnp.where(guard > 0, first, jnp.nan)
        pivots, directions = taken(self.pivots), taken(self.directions)
        ratios = [left / size for left, size in zip(found, found, strict=True)]
        sine = jnp.sqrt(jnp.maximum(functools.reduce(jnp.minimum, ratios), 0.0)) if ratios else None
        return (first, *qdot), ydot, power, pivots, directions, sine

    @property
    def variables(self) -> list[int]:
        """Return all input nodes."""
        traced = self.traced
        state = [*traced.q.tolist(), *(int(traced.u[k]) for k in self.independent)]
        return [*self.fixed, traced.t, *state, *map(int, traced.inputs)]

    def speeds_and_pivot(self, *state) -> tuple[Float[Array, "speeds *lanes"], PerLane | None]:
        """Return all speeds and the smallest pivot, which changes its sign where the elimination fails.
        `state`: arguments of `rates`.
        """
        return self.all_speeds(*state), smallest_pivot(self.values(self.pivots, *state))

    def all_speeds(self, fixed, t, q: Sequence, y: Sequence, inputs) -> Float[Array, "speeds *lanes"]:
        """Return all speeds, integrated and dependent. `fixed`, `q`, `y`, `inputs`: as in `rates`."""
        y = tuple(y)  # split the vector into entries once
        every = [*y, *self.values(self.z, fixed, t, q, y, inputs)]
        return jnp.stack([every[i] for i in np.argsort([*self.independent, *self.dependent])])

    def energies_at(self, fixed, t, q: Sequence, y: Sequence, inputs) -> Float[Array, "2 *lanes"]:
        """Return the kinetic and potential energy (J), which have no derivatives. `fixed`, `q`, `y`,
        `inputs`: as in `rates`.
        """
        return self.values(self.energies, *jax.lax.stop_gradient((fixed, t, q, y, inputs)))

    def projected(self, fixed, t, q: Sequence, y: Sequence, inputs, affine: bool) -> tuple[tuple, tuple]:
        """Project coordinates and integrated speeds onto the constraints. `affine`: constraints are affine in
        the speeds, so that one step is exact.

        `fixed`, `q`, `y`, `inputs`: as in `rates`.
        """
        real, y = jnp.result_type(*q), tuple(y)

        def step(nodes, q, y):
            return tuple(
                jnp.broadcast_to(jnp.asarray(x, real), jnp.shape(q[0]))
                for x in run(self.graph, nodes, self._known(fixed, t, q, y, inputs))
            )

        # two steps suffice: the deviation after an integration step is small, and its square is round-off
        q = jax.lax.scan(lambda q, _: (step(self.projected_q, q, y), None), tuple(q), length=2)[0]
        if not self.projected_u:
            return q, y
        steps = 1 if affine else 2
        return q, jax.lax.scan(lambda y, _: (step(self.projected_u, q, y), None), y, length=steps)[0]

    def watched(self, has_events: bool) -> Nodes:
        """Return the nodes whose signs are monitored: those that decide relations in the rates and, with
        `has_events`, in the events.
        """
        return (*self.relations, *(self.event_relations if has_events else ()))

    def values(
        self, nodes: Sequence[int], fixed, t, q: Sequence, y: Sequence, inputs
    ) -> Float[Array, "nodes *lanes"]:
        """Return the values of `nodes`. `fixed`, `t`, `q`, `y`, `inputs`: as in `rates`."""
        out, like = run(self.graph, nodes, self._known(fixed, t, q, y, inputs)), q[0]
        if not nodes:
            return jnp.zeros((0, *like.shape), like.dtype)
        return jnp.stack([jnp.broadcast_to(jnp.asarray(c, like.dtype), jnp.shape(like)) for c in out])

    def _known(self, fixed, t, q, y, inputs) -> dict[int, PerLane]:
        def lanes_last(n, x):
            is_array = self.graph.op[n] in ARRAYS
            return jnp.moveaxis(x, 0, -1) if is_array and x.ndim > len(self.graph.value[n][-2]) else x

        fixed = map(lanes_last, self.fixed, fixed)
        return dict(zip(self.variables, (*fixed, t, *q, *y, *inputs), strict=True))

    @property
    def calls(self) -> Labels:
        """Return the reason for each JAX call in the rates and events: a part of a load or event that has no
        scalar form.
        """
        calls = self.graph.calls([*self.qdot, *self.ydot, *self.events])
        return tuple(self.graph.value[n].reason for n in calls)


@functools.lru_cache(maxsize=64)
def _program_of_rates(program: Lowered, with_power: bool) -> Callable[..., tuple]:
    outputs = [*program.qdot, *program.ydot, *([program.power] if with_power else []), *program.guards]
    monitored = *program.pivots, *program.directions, *program.squares
    return differentiable(
        program.graph, outputs, program.variables, like=len(program.fixed) + 1, monitored=monitored
    )


def smallest_pivot(pivots: Float[Array, "pivots *lanes"]) -> PerLane | None:
    """Return the smallest of 1 and the magnitudes of all pivots, with the sign of the product of the pivots;
    None if there are no pivots.
    """
    if not len(pivots):
        return None
    pivots = jax.lax.stop_gradient(pivots)
    return jnp.prod(jnp.sign(pivots), axis=0) * jnp.min(jnp.abs(pivots), axis=0, initial=1.0)
