"""Probes outside the domain. Angles take any value, since a pivot that is large in the domain may vanish at another heading. Speeds lie on the velocity
rows, since dependent rows have a solution only there.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from jourdain_jax.build.trace import TracedScene
from jourdain_jax.lowering.pivots import turns
from jourdain_jax.program.derivative import columns
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.identity_test import slopes_by_entries

MANY, FEW = 96, 24  # probes; the latter where there are more coordinates than
LARGE = 16
STEPS, CLOSED = 12, 1e-9  # of Newton's method


def full_turns(probes: Probes, traced: TracedScene) -> Callable[[], Probes]:
    """Probes with coordinates up to half a turn away from those given, put onto the geometric rows where Newton's method arrives; made when first asked for.

    Quaternions are drawn anew.
    """
    return cache(lambda: _at_full_turns(probes, traced))


def _at_full_turns(probes: Probes, traced: TracedScene) -> Probes:
    coordinates = traced.q.tolist()
    count, generator = MANY if len(coordinates) <= LARGE else FEW, np.random.default_rng(3)
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
    return _on_rows(probes.with_inputs(inputs), traced.closures, coordinates)


def _on_rows(probes: Probes, rows: list[int], coordinates: list[int]) -> Probes:
    """The probes with coordinates on rows = 0, by Newton's method; not numbers where it does not arrive."""
    needed = set(probes.graph.reachable(rows))
    moved = {f"q_{i}": n for i, n in enumerate(coordinates) if n in needed}
    if not moved:
        return probes
    pattern, slopes = slopes_by_entries(probes.graph, rows, list(moved.values()))
    q = np.stack([probes.inputs[name] for name in moved])
    for _ in range(STEPS):
        here = probes.with_inputs(dict(zip(moved, q, strict=True)))
        values, J = np.nan_to_num(here(rows)), np.nan_to_num(here(slopes))
        q = q - pattern.shortest(J.T, values.T, lambda J, g: (np.linalg.pinv(J, rcond=1e-9) @ g[..., None])[..., 0]).T
        if np.median(np.max(np.abs(values), axis=0)) < CLOSED:
            break
    left = np.max(np.abs(probes.with_inputs(dict(zip(moved, q, strict=True)))(rows)), axis=0)
    q[:, ~(left <= CLOSED)] = np.nan
    return probes.with_inputs(dict(zip(moved, q, strict=True)))


def on_velocity_rows(probes: Probes, traced: TracedScene, affine: bool) -> Probes:
    """The probes with speeds on the rows, as near as they can be; `affine`: rows are."""
    phi, u = traced.at.phi.tolist(), traced.u.tolist()
    slopes = [n for column in columns(traced.graph, phi, u) for n in column]
    for _ in range(2 if affine else 8):
        values, A = np.nan_to_num(probes(phi)), np.nan_to_num(probes(slopes)).reshape(len(u), len(phi), -1)
        change = np.einsum("pus,sp->up", np.linalg.pinv(A.transpose(2, 1, 0), rcond=1e-9), values)
        probes = probes.with_inputs({f"u_{k}": probes.inputs[f"u_{k}"] - step for k, step in enumerate(change)})
    return probes
