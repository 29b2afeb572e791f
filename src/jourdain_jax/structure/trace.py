"""A scene traced to a graph of scalars at velocity level: the input of Jourdain's principle before any
derivative.

    v, omega (body axes), phi, qdot      of (t, q, u)
    g                                    geometric constraints at position level
    F, L (body axes), Q_direct, power    impressed forces
    m, I                                 inertias
    c                                    stop events
    T, V                                 energies

The same graph is used for probes (`probed_on_graph`) and for lowering. Traces are cached per class and shapes
of the parameters.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Num, PyTree

from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.reals import Entries, Indices, PerRow, Scalar, is_traced, real_type
from jourdain_jax.equations.kinematics import inertias_of, motion_at, of_bodies, velocities_of
from jourdain_jax.equations.phases import At, contact_changes, contact_events, contacts_at_start, put_back
from jourdain_jax.equations.rows import (
    flatten_rows,
    names_of_bodies,
    names_of_position_rows,
    position_rows,
    velocity_rows,
)
from jourdain_jax.equations.virtual_power import (
    energies_at,
    impressed,
    loads_at,
    potential_energy,
    resultants,
    slip_turns,
)
from jourdain_jax.program.calls import interpret_with_calls
from jourdain_jax.program.graph import MOST_MULTIPLICATIONS, Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, as_nodes, effects_of, interpret
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.modes import Event
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene, state_names
from jourdain_jax.scene.user_methods import events_of, loads_of
from jourdain_jax.structure.load_power import explicit_power, stored_by_inputs
from jourdain_jax.structure.scene_numbers import Numbers, numbers_of

PerBody = Num[Entries, "bodies 3"]


class VelocityQuantities(eqx.Module):
    """Traced quantities; arrays of numbers, or of nodes."""

    v: PerBody
    omega: PerBody  # body axes
    turning: PerBody  # omega in space axes
    position: PerBody
    orientation: Num[Entries, "bodies 3 3"]
    mass: Num[Entries, "bodies"]
    inertia: Num[Entries, "bodies 3 3"]
    phi: Num[Entries, "rows"]
    closure: Num[Entries, "geometric_rows"]
    qdot: Num[Entries, "coordinates"]
    force: PerBody
    torque: PerBody  # body axes
    direct: Num[Entries, "speeds"]
    # of loads without a potential, and of potentials that depend on time or on inputs
    power: Num[Entries, ""]
    events: Num[Entries, "events"]  # sorted by name
    resets: Num[Entries, "events rows"]  # as in `event_resets`
    energies: Num[Entries, "2"]  # kinetic and potential
    slip_turns: Num[Entries, "directions"]  # rates of directions of slip, the last coordinates
    # projected onto the constraints of closed contacts; empty without switching contacts
    held: Num[Entries, "coordinates_and_speeds"]
    start: Num[Entries, "numbers"]  # `contacts_at_start`
    # for each state of switching contacts: coordinates, speeds, inputs, and the response (`ContactResponse`)
    responses: Num[Entries, "states numbers"]


class Particulars(eqx.Module):
    """Quantities for probing only; arrays of numbers, or of nodes."""

    numbers: Numbers
    potentials: Num[Entries, "loads"]  # of the loads; zero for a load without one
    explicit: dict[str, PyTree]  # rates in time of loads and potentials at fixed motion


def potentials_of(scene: Scene, motion: Motion) -> Float[Array, "loads"]:
    """Return the potential of each load; zero for a load without one."""
    stored = [
        0.0 * motion.t if load.potential is None else load.potential for load in loads_of(scene, motion)
    ]
    return jnp.stack(stored) if stored else jnp.zeros(0, motion.q.array.dtype)


def explicit_rates(scene: Scene, motion: Motion) -> dict[str, PyTree]:
    """Return the rates in time of loads and potentials at a fixed motion, including fixed poses."""

    def pieces(t):
        held = eqx.tree_at(lambda m: m.t, motion, t)
        return {
            "loads": resultants(scene, held, loads=loads_of(scene, held)),
            "potential": potential_energy(scene, held),
        }

    return jax.jvp(pieces, (motion.t,), (jnp.ones_like(motion.t),))[1]


def velocity_quantities(
    scene: Scene, motion: Motion, of_inputs: Indices = (), with_events: bool = True
) -> VelocityQuantities:
    """Return the traced quantities at a motion. `of_inputs`: indices of the loads whose potential depends on
    inputs.
    """
    at = At(scene, motion) if scene.switching.contacts else None
    # once, because a callback that is evaluated twice counts as two
    stated = loads_at(scene, motion, at.found if at else None)
    velocities, weights, loads = velocities_of(motion), inertias_of(motion), impressed(scene, motion, stated)
    return VelocityQuantities(
        velocities.linear,
        velocities.angular,
        of_bodies(motion, "angular_velocity"),
        of_bodies(motion, "position"),
        of_bodies(motion, "orientation"),
        weights.mass,
        weights.inertia,
        flatten_rows(velocity_rows(scene, motion), motion.t.dtype),
        flatten_rows(position_rows(scene, motion.pose()), motion.t.dtype),
        motion.qdot.array,
        loads.force,
        loads.torque,
        loads.direct,
        explicit_power(scene, motion, of_inputs, stated),
        event_values(scene, motion, at) if with_events else jnp.zeros(0),
        event_resets(scene, motion, of_inputs, at) if with_events else jnp.zeros((0, 0)),
        jnp.stack(energies_at(scene, motion, stated)),
        slip_turns(scene, motion, at.found) if at else jnp.zeros(0),
        jnp.concatenate(put_back(at)) if at else jnp.zeros(0),
        contacts_at_start(at) if at and with_events else jnp.zeros(0),
        jnp.stack([ravel_pytree(response)[0] for response in at.responses]) if at else jnp.zeros((0, 0)),
    )


def event_values(scene: Scene, motion: Motion, at: At | None = None) -> Float[Array, "events"]:
    """Return values of the events, sorted by name. `at`: switching contacts, if already known."""
    values = {name: event.value for name, event in events_of(scene, motion).items()}
    if scene.switching.contacts:
        values |= contact_events(at or At(scene, motion))
    return jnp.stack([values[name] for name in sorted(values)]) if values else jnp.zeros(0)


def event_resets(
    scene: Scene, motion: Motion, of_inputs: Indices, at: At | None = None
) -> Float[Array, "events rows"]:
    """Return a row for each event, sorted by name: coordinates, speeds and modes after it, and the rise of
    the stored energy of the loads `of_inputs`. Rows are empty if all events stop the motion.
    """
    every = events_of(scene, motion) | (
        contact_changes(at or At(scene, motion)) if scene.switching.contacts else {}
    )
    events = [event for _, event in sorted(every.items())]
    if all(event.stop for event in events):
        return jnp.zeros((len(events), 0))
    names = state_names(scene)
    given, modes = jnp.split(motion.inputs.array, (len(scene.inputs) - len(scene.modes.names),))
    now = jnp.concatenate([motion.q.array, motion.u.array, modes])

    def stored(state: PerRow) -> Scalar:
        q, u, after = jnp.split(state, (len(motion.q.array), len(state) - len(modes)))
        return stored_by_inputs(
            scene, motion_at(scene, motion.t, q, 0.0 * u, jnp.concatenate([given, after])), of_inputs
        )

    def after(event: Event) -> PerRow:
        state = [event.jump.get(name, value) for name, value in zip(names, now, strict=False)]
        found = jnp.stack([*state, *map(event.to.get, scene.modes.names, modes)])
        return jnp.append(found, stored(found) - stored(now) if of_inputs else 0.0)

    return jnp.stack([after(event) for event in events])


@dataclass
class Variables:
    """A graph and the inputs of a scene in it, as nodes and arrays of nodes."""

    graph: Graph
    t: int
    q: np.ndarray
    u: np.ndarray
    inputs: np.ndarray
    parameters: list[np.ndarray]  # one array per leaf of the scene


@dataclass
class TracedScene(Variables):
    """A graph with the scene's inputs and its quantities at velocity level, as arrays of nodes."""

    at: VelocityQuantities
    particulars: Particulars
    effects: str  # name of a side effect in the scene, such as printing; empty if there is none
    quaternions: Indices  # index of the first coordinate of each

    @property
    def attitudes(self) -> list[list[int]]:
        """Return the four parts of each quaternion."""
        return [self.q[first : first + 4].tolist() for first in self.quaternions]

    @property
    def closures(self) -> list[int]:
        """Return the geometric constraints, and the unit norms of quaternions as constraints."""
        g = self.graph
        return [
            *self.at.closure.tolist(),
            *(g.mul(g.const(0.5), g.sub(g.dot(wxyz, wxyz), g.one)) for wxyz in self.attitudes),
        ]

    @property
    def motion(self) -> list[np.ndarray]:
        """Return the quantities of poses and constraints whose derivatives are needed."""
        at = self.at
        return [at.v, at.omega, at.position, at.orientation, at.mass, at.inertia, at.phi, at.closure, at.qdot]


def traced_scene(scene: Scene, of_inputs: Indices = ()) -> TracedScene:
    """Return the scene as a new graph. Parts without scalar form, or with a user-defined derivative,
    become calls.

    `of_inputs`: indices of the loads whose potential depends on inputs.
    """
    found = _traced(scene, of_inputs)[1]
    if isinstance(found, str):
        raise Unsupported(found)
    graph = copy(found.graph)
    # copy its lists and the arrays of nodes as well, since both may be changed
    vars(graph).update({name: copy(x) for name, x in vars(graph).items()})
    return replace(found, graph=graph, at=jax.tree.map(np.copy, found.at))


def jaxpr_of_scene(scene: Scene, of_inputs: Indices):
    """Return a jaxpr of the scene's quantities, and their shapes. The jaxpr is a function of the parameters
    (one input per leaf), t, q, u and inputs.

    `of_inputs`: indices of the loads whose potential depends on inputs. Raises ValueError if a method reads a
    value that JAX traces elsewhere.
    """
    return _traced(scene, of_inputs)[0]


@once_per_class
def _traced(scene: Scene, of_inputs: Indices) -> tuple:
    """Return the jaxpr with its shapes, and the scene on a graph that must not be changed. If an operation
    has no scalar form, return its name in place of the graph.
    """
    closed, shape = _jaxpr(scene, of_inputs)
    try:
        return (closed, shape), _on_graph(scene, closed, shape, interpret)
    except Unsupported:
        try:
            return (closed, shape), _on_graph(scene, closed, shape, interpret_with_calls)
        except Unsupported as reason:
            return (closed, shape), str(reason)


def _jaxpr(scene: Scene, of_inputs: tuple[int, ...]):
    leaves, treedef = jax.tree.flatten(scene)
    real = real_type()
    state = [
        jax.ShapeDtypeStruct(shape, real)
        for shape in ((), (len(scene.coordinate_names),), (len(scene.speed_names),), (len(scene.inputs),))
    ]
    numbers = [jax.ShapeDtypeStruct(np.shape(x), real) for x in leaves]

    def quantities(leaves, t, q, u, inputs):
        scene = jax.tree.unflatten(treedef, leaves)
        motion = motion_at(scene, t, q, u, inputs)
        particulars = Particulars(
            numbers_of(scene, motion), potentials_of(scene, motion), explicit_rates(scene, motion)
        )
        return velocity_quantities(scene, motion, of_inputs), particulars

    closed, shape = jax.make_jaxpr(quantities, return_shape=True)(numbers, *state)
    if is_traced(closed.consts):
        raise ValueError(
            f"a method of `{type(scene).__name__}`, or a function that it calls, reads a number that JAX is "
            "tracing (jit, grad, vmap) and that is not a field of the scene; declare a field `name: float = "
            "jj.parameter(unit=...)`, and pass the number to the scene"
        )
    return needed_only(closed), shape


def _on_graph(scene: Scene, closed, shape, interpreted: Callable) -> TracedScene:
    graph = Graph(MOST_MULTIPLICATIONS, keeps_rules=True)
    leaves = jax.tree_util.tree_leaves_with_path(scene)
    parameters = [_inputs(graph, f"p{k}", np.shape(x), False) for k, (_, x) in enumerate(leaves)]
    positive = {f.name for f in fields(scene) if f.metadata.get("positive")}
    for (path, _), nodes in zip(leaves, parameters, strict=True):
        graph.positive += nodes.ravel().tolist() if path[0].name in positive else []
    sizes = {
        "t": (),
        "q": (len(scene.coordinate_names),),
        "u": (len(scene.speed_names),),
        "i": (len(scene.inputs),),
    }
    t, q, u, inputs = (_inputs(graph, name, size, True) for name, size in sizes.items())
    found = interpreted(graph, closed, [Nodes(x) for x in (*parameters, t, q, u, inputs)])
    at, particulars = jax.tree.unflatten(jax.tree.structure(shape), [as_nodes(graph, x) for x in found])
    quaternions = tuple(first for first, _ in scene.coordinates.quaternions)
    return TracedScene(
        graph, int(t), q, u, inputs, parameters, at, particulars, effects_of(closed.jaxpr), quaternions
    )


def _inputs(graph: Graph, name: str, shape, varies: bool) -> np.ndarray:
    return np.array(
        [graph.input(f"{name}_{i}", varies) for i in range(int(np.prod(shape)))], np.int64
    ).reshape(shape)


def named_values(scene: Scene, t, q, u, inputs) -> dict[str, np.ndarray]:
    """Return values of the inputs of the scene's graph by name; states may have a leading axis."""
    named = {
        f"p{k}_{i}": value
        for k, leaf in enumerate(jax.tree.leaves(scene))
        for i, value in enumerate(np.ravel(leaf))
    }
    named["t_0"] = t
    for prefix, values in zip("qui", (q, u, inputs), strict=True):
        named |= {f"{prefix}_{i}": column for i, column in enumerate(np.moveaxis(np.asarray(values), -1, 0))}
    # in double precision, whatever the motion's precision
    return {name: np.asarray(value, np.float64) for name, value in named.items()}


def owned(scene: Scene, **fields: np.ndarray) -> dict[int, str]:
    """Return node -> name of its owner, for nodes of some fields of `VelocityQuantities`; for shared nodes,
    the first owner.
    """
    of_bodies = dict.fromkeys(("position", "orientation", "v", "omega"), "pose of")
    of_bodies |= {"mass": "mass of", "inertia": "inertia of", "force": "force on", "torque": "torque on"}
    named = {
        field: [f"the {what} body `{name}`" for name in names_of_bodies(scene)]
        for field, what in of_bodies.items()
    }
    named["direct"] = [f"the force along `{name}`" for name in scene.speed_names.entries]
    named["qdot"] = [f"the rate of coordinate `{name}`" for name in scene.coordinate_names.entries]
    named["closure"] = named["phi"] = [f"constraint `{name}`" for name in names_of_position_rows(scene)]
    pairs = [pair for field, nodes in fields.items() for pair in zip(named[field], nodes, strict=False)]
    return {node: owner for owner, nodes in reversed(pairs) for node in np.ravel(nodes).tolist()}
