"""Detect kinks and jumps of loads and masses, from relations (`<`, `abs`, `floor`, ...) in the traced scene.
No lowered program is needed.

Kinks inside a JAX call (`jnp.interp`, a callback) are not detected.
"""

import numpy as np

from jourdain_jax.lowering.relations import AGREE, branches, jumps, switches
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.probes import looked_at
from jourdain_jax.structure.structure import structure_whatever_its_faults
from jourdain_jax.structure.trace import TracedScene, named_values, owned


def loads_have_relations(scene: Scene) -> bool:
    """Return whether relations decide between branches of loads or masses."""
    traced = looked_at(scene).traced
    return bool(switches(traced.graph, _loads(scene, traced)))


def loads_may_jump(scene: Scene) -> bool:
    """Return whether loads or masses jump at some state or parameter. Jumps at fixed times do not count,
    because derivatives are correct there.
    """
    scene = with_reference_parameters(scene)
    traced = looked_at(scene).traced
    graph, loads = traced.graph, list(_loads(scene, traced))
    moving = [
        *traced.q.tolist(),
        *traced.u.tolist(),
        *(n for leaf in traced.parameters for n in leaf.ravel().tolist()),
    ]
    numbers = [n for n in switches(graph, loads) if depend_on(graph, [n], moving)[0]]
    return bool(numbers) and bool(jumps(graph, numbers, loads, _probes(scene, traced)))


def bent_load(scene: Scene, t, q, u, inputs) -> str:
    """Return the name of a load or mass that has no derivative at this state; empty if all have one."""
    try:
        traced = looked_at(scene).traced
    except Unsupported:
        return ""
    graph, named = traced.graph, _loads(scene, traced)
    loads, numbers = list(named), switches(graph, named)
    if not numbers:
        return ""
    at = np.concatenate([np.ravel(x).astype(float) for x in (q, u, inputs)])
    # 1e-6 away from the state, relative for entries larger than one
    step = np.diag(1e-6 * np.maximum(1.0, np.abs(at)))
    q, u, inputs = np.split(
        np.concatenate([at + step, at - step]), np.cumsum([np.size(q), np.size(u)]), axis=1
    )
    beside = Probes(graph, named_values(scene, t, q, u, inputs))
    size, bent = np.nanmax(np.abs(_probes(scene, traced)(loads)), axis=1), np.zeros(len(loads), bool)
    for number, nodes in numbers.items():
        if not beside.sign(number):
            above, below = branches(graph, nodes, loads)
            bent |= np.any(np.abs(beside(above) - beside(below)) > AGREE * size[:, None], axis=1)
    return named[loads[int(np.argmax(bent))]] if np.any(bent) else ""


def _probes(scene: Scene, traced: TracedScene) -> Probes:
    """Return probes at the states used to determine the scene's structure, with random speeds and inputs."""
    known, generator = structure_whatever_its_faults(scene), np.random.default_rng(7)
    u, inputs = (
        generator.normal(size=(len(known.times), len(names)))
        for names in (scene.speed_names.entries, scene.inputs)
    )
    return Probes(traced.graph, named_values(scene, known.times, known.coordinates, u, inputs))


def _loads(scene: Scene, traced: TracedScene) -> dict[int, str]:
    """Return the names of loads and masses, by node."""
    names = "force", "torque", "mass", "inertia", "direct"
    return owned(scene, **{name: getattr(traced.at, name) for name in names})
