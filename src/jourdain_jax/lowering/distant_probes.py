"""Make probes outside the domain, with angles over full turns, because a pivot that is large in the domain
may vanish at another heading. Speeds satisfy the velocity constraints; otherwise redundant constraints would
have no solution.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from jourdain_jax.calculus.reals import largest
from jourdain_jax.lowering.pivots import turns
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.probe_projection import onto_rows
from jourdain_jax.structure.trace import TracedScene


def full_turns(probes: Probes, traced: TracedScene) -> Callable[[], Probes]:
    """Return a function that makes probes, on its first call, with coordinates up to half a turn from the
    given ones.

    Coordinates are projected onto the geometric constraints, and NaN where this does not converge.
    Quaternions are random.
    """
    return cache(lambda: _at_full_turns(probes, traced))


def _at_full_turns(probes: Probes, traced: TracedScene) -> Probes:
    coordinates = traced.q.tolist()
    # fewer probes for many coordinates
    count, generator = 96 if len(coordinates) <= 16 else 24, np.random.default_rng(3)
    places = np.arange(count) % probes.count
    inputs = {name: np.broadcast_to(value, probes.count)[places] for name, value in probes.inputs.items()}
    attitudes = {first + i for first in traced.quaternions for i in range(4)}
    for i in (i for i in range(len(coordinates)) if i not in attitudes):
        inputs[f"q_{i}"] = inputs[f"q_{i}"] + generator.uniform(-np.pi, np.pi, count)
    for first in traced.quaternions:
        wxyz = generator.normal(size=(4, count))
        inputs |= {f"q_{first + k}": part for k, part in enumerate(wxyz / np.linalg.norm(wxyz, axis=0))}
    graph = probes.graph
    for name in sorted({str(graph.value[graph.args[n][0]]) for n in range(len(graph.op)) if turns(graph, n)}):
        inputs[name] = inputs[name] + generator.uniform(-np.pi, np.pi, count)
    found = onto_rows(
        probes.with_inputs(inputs), traced.closures, {f"q_{i}": n for i, n in enumerate(coordinates)}, most=12
    )
    off = ~(largest(found.probes(traced.closures), 0) <= 1e-9)  # also true for NaN
    return found.probes.with_inputs(
        {name: np.where(off, np.nan, found.probes.inputs[name]) for name in found.moved}
    )


def on_velocity_rows(probes: Probes, traced: TracedScene) -> Probes:
    """Return the probes with speeds projected onto the velocity constraints."""
    speeds = {f"u_{k}": n for k, n in enumerate(traced.u.tolist())}
    return onto_rows(probes, traced.at.phi.tolist(), speeds).probes
