"""Which loads and masses bend or jump at a state, and whether any jump at all: relations of the traced scene, with or without a scalar program of its rates.

What a call of JAX hides (`jnp.interp`, a callback) is not seen.
"""

import numpy as np

from jourdain_jax.build.probed_on_graph import looked_at
from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.build.structure import structure_whatever_its_faults
from jourdain_jax.build.trace import TracedScene, named_values
from jourdain_jax.equations.listed import names_of_bodies
from jourdain_jax.lowering.relations import AGREE, branches, jumps, switches
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.scene import Scene


def loads_have_relations(scene: Scene) -> bool:
    """Return whether relations decide between branches of loads or masses."""
    traced = looked_at(scene).traced
    return bool(switches(traced.graph, _loads(scene, traced)))


def loads_may_jump(scene: Scene) -> bool:
    """Return whether loads or masses jump at a state or parameter; a jump at a fixed time leaves derivatives right."""
    scene = with_reference_parameters(scene)
    traced = looked_at(scene).traced
    graph, loads = traced.graph, list(_loads(scene, traced))
    moving = [*traced.q.tolist(), *traced.u.tolist(), *(n for leaf in traced.parameters for n in leaf.ravel().tolist())]
    numbers = [n for n in switches(graph, loads) if depend_on(graph, [n], moving)[0]]
    return bool(numbers) and bool(jumps(graph, numbers, loads, _probes(scene, traced)))


def bent_load(scene: Scene, t, q, u, inputs) -> str:
    """Return in words which load or mass has no derivative with respect to the state at a state; empty where none is seen."""
    try:
        traced = looked_at(scene).traced
    except Unsupported:
        return ""
    graph, named = traced.graph, _loads(scene, traced)
    loads, numbers = list(named), switches(graph, named)
    if not numbers:
        return ""
    at = np.concatenate([np.ravel(x).astype(float) for x in (q, u, inputs)])
    # 1e-6 off a state, relative to entries larger than one
    step = np.diag(1e-6 * np.maximum(1.0, np.abs(at)))
    q, u, inputs = np.split(np.concatenate([at + step, at - step]), np.cumsum([np.size(q), np.size(u)]), axis=1)
    beside = Probes(graph, {name: np.asarray(x, float) for name, x in named_values(scene, t, q, u, inputs).items()})
    size, bent = np.nanmax(np.abs(_probes(scene, traced)(loads)), axis=1), np.zeros(len(loads), bool)
    for number, nodes in numbers.items():
        if not beside.sign(number):
            above, below = branches(graph, nodes, loads)
            bent |= np.any(np.abs(beside(above) - beside(below)) > AGREE * size[:, None], axis=1)
    return named[loads[int(np.argmax(bent))]] if np.any(bent) else ""


def _probes(scene: Scene, traced: TracedScene) -> Probes:
    """Return the states at which the structure of the scene was found, with random speeds and inputs."""
    known, generator = structure_whatever_its_faults(scene), np.random.default_rng(7)
    u, inputs = (generator.normal(size=(len(known.times), len(names))) for names in (scene.speed_names.entries, scene.inputs))
    values = named_values(scene, known.times, known.coordinates, u, inputs)
    return Probes(traced.graph, {name: np.asarray(x, float) for name, x in values.items()})


def _loads(scene: Scene, traced: TracedScene) -> dict[int, str]:
    """Return the nodes of loads and masses, with the name of each."""
    bodies, at = names_of_bodies(scene), traced.at
    named = {f"the {what} body `{name}`": x for what, of in _OF_BODIES.items() for name, x in zip(bodies, getattr(at, of), strict=True)}
    named |= {f"the force along `{name}`": x for name, x in zip(scene.speed_names.entries, at.direct, strict=True)}
    return {n: name for name, nodes in reversed(named.items()) for n in np.ravel(nodes).tolist()}


_OF_BODIES = {"force on": "force", "torque on": "torque", "mass of": "mass", "inertia of": "inertia"}
