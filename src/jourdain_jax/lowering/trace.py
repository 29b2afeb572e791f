"""A scene at the level of velocities, traced to a graph of scalars: what Jourdain's principle needs, before any derivative is taken.

v, omega (body axes), phi, qdot      of (t, q, u)
g                                    geometric rows at the level of positions
F, L (body axes), Q_direct, power    impressed forces
m, I                                 inertias
c                                    stop events
"""

from dataclasses import dataclass
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jourdain_jax.equations.kinematics import inertias_of, motion_at, velocities_of
from jourdain_jax.equations.power import explicit_power
from jourdain_jax.equations.rows import flatten_rows, position_rows, velocity_rows
from jourdain_jax.equations.virtual_power import impressed
from jourdain_jax.program.graph import Graph
from jourdain_jax.program.interpret import Nodes, Unsupported, as_nodes, interpret
from jourdain_jax.scene.answers import events_of
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene

Entries: TypeAlias = Array | np.ndarray


class VelocityQuantities(eqx.Module):
    """What is traced; arrays of numbers, or of nodes."""

    v: Num[Entries, "bodies 3"]
    omega: Num[Entries, "bodies 3"]  # body axes
    turning: Num[Entries, "bodies 3"]  # omega in space axes
    position: Num[Entries, "bodies 3"]
    orientation: Num[Entries, "bodies 3 3"]
    mass: Num[Entries, "bodies"]
    inertia: Num[Entries, "bodies 3 3"]
    phi: Num[Entries, "rows"]
    closure: Num[Entries, "geometric_rows"]
    qdot: Num[Entries, "coordinates"]
    force: Num[Entries, "bodies 3"]
    torque: Num[Entries, "bodies 3"]  # body axes
    direct: Num[Entries, "speeds"]
    power: Num[Entries, ""]  # of loads without a potential, and of potentials that depend on time or on inputs
    events: Num[Entries, "events"]  # sorted by name


def velocity_quantities(scene: Scene, t, q, u, inputs, of_inputs: tuple[int, ...] = (), with_events: bool = True) -> VelocityQuantities:
    """The same on numbers; `of_inputs`: numbers of the loads whose potential depends on inputs."""
    motion = motion_at(scene, t, q, u, inputs)
    velocities, weights, loads = velocities_of(motion), inertias_of(motion), impressed(scene, motion)
    return VelocityQuantities(
        velocities.linear,
        velocities.angular,
        jnp.stack([body.angular_velocity for body in motion.bodies.values()]),
        jnp.stack([body.position for body in motion.bodies.values()]),
        jnp.stack([body.orientation for body in motion.bodies.values()]),
        weights.mass,
        weights.inertia,
        flatten_rows(velocity_rows(scene, motion), q.dtype),
        flatten_rows(position_rows(scene, motion.pose()), q.dtype),
        motion.qdot.array,
        loads.force,
        loads.torque,
        loads.direct,
        explicit_power(scene, motion, of_inputs),
        event_values(scene, motion) if with_events else jnp.zeros(0),
    )


def event_values(scene: Scene, motion: Motion) -> Float[Array, "events"]:
    """Values of the stop events, sorted by name."""
    events = events_of(scene, motion)
    return jnp.stack([events[name] for name in sorted(events)]) if events else jnp.zeros(0)


@dataclass
class TracedScene:
    """A graph with the scene's inputs and its quantities at the level of velocities, as arrays of nodes."""

    graph: Graph
    t: int
    q: np.ndarray
    u: np.ndarray
    inputs: np.ndarray
    parameters: list[np.ndarray]  # nodes, one array per leaf of the scene
    at: VelocityQuantities


def traced_scene(scene: Scene, of_inputs: tuple[int, ...] = ()) -> TracedScene:
    """The scene as a graph, without its stop events where these alone cannot be; `Unsupported` where it cannot be.

    `of_inputs`: numbers of the loads whose potential depends on inputs.
    """
    try:
        return _traced(scene, of_inputs, True)
    except Unsupported:
        return _traced(scene, of_inputs, False)


def _traced(scene: Scene, of_inputs: tuple[int, ...], with_events: bool) -> TracedScene:
    leaves, treedef = jax.tree.flatten(scene)
    real = jnp.result_type(float)
    state = [jax.ShapeDtypeStruct(shape, real) for shape in ((), (len(scene.coordinate_names),), (len(scene.speed_names),), (len(scene.inputs),))]
    numbers = [jax.ShapeDtypeStruct(np.shape(x), real) for x in leaves]

    def quantities(leaves, t, q, u, inputs):
        return velocity_quantities(jax.tree.unflatten(treedef, leaves), t, q, u, inputs, of_inputs, with_events)

    try:
        closed, shape = jax.make_jaxpr(quantities, return_shape=True)(numbers, *state)
    except (ValueError, NotImplementedError) as error:  # the power of potentials takes a derivative of all loads, which nothing else may need
        raise Unsupported(f"a function that JAX cannot differentiate ({str(error).split('.')[0]})") from None
    graph = Graph()
    parameters = [_inputs(graph, f"p{k}", np.shape(x), False) for k, x in enumerate(leaves)]
    t, q, u, inputs = (_inputs(graph, name, s.shape, True) for name, s in zip("tqui", state, strict=True))
    found = interpret(graph, closed, [Nodes(x) for x in (*parameters, t, q, u, inputs)])
    at = jax.tree.unflatten(jax.tree.structure(shape), [as_nodes(graph, x) for x in found])
    return TracedScene(graph, int(t), q, u, inputs, parameters, at)


def _inputs(graph: Graph, name: str, shape, varies: bool) -> np.ndarray:
    return np.array([graph.input(f"{name}_{i}", varies) for i in range(int(np.prod(shape)))], np.int64).reshape(shape)


def named_values(scene: Scene, t, q, u, inputs) -> dict[str, np.ndarray]:
    """Values of the inputs of the scene's graph by name; states may have a leading axis."""
    named = {f"p{k}_{i}": np.asarray(value) for k, leaf in enumerate(jax.tree.leaves(scene)) for i, value in enumerate(np.ravel(leaf))}
    named["t_0"] = np.asarray(t)
    for prefix, values in zip("qui", (q, u, inputs), strict=True):
        named |= {f"{prefix}_{i}": column for i, column in enumerate(np.moveaxis(np.asarray(values), -1, 0))}
    return named
