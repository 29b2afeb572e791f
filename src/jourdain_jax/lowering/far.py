"""Probes at full turns of all angles: a pivot that is large in a scene's domain may vanish where its headings have turned."""

from collections.abc import Sequence

import numpy as np

from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.formal import on_rows

MANY, FEW = 96, 24  # probes; the latter where there are more coordinates than
LARGE = 16


def at_full_turns(probes: Probes, rows: Sequence[int], coordinates: Sequence[int], quaternions: Sequence[int]) -> Probes:
    """Probes with coordinates up to half a turn away from those given, put onto `rows` = 0 where Newton's method arrives.

    `coordinates`: their nodes; `quaternions`: the numbers of the first part of each, which are drawn anew.
    """
    count, generator = MANY if len(coordinates) <= LARGE else FEW, np.random.default_rng(3)
    places = np.arange(count) % probes.count
    inputs = {name: np.broadcast_to(value, probes.count)[places] for name, value in probes.inputs.items()}
    attitudes = {first + i for first in quaternions for i in range(4)}
    for i in (i for i in range(len(coordinates)) if i not in attitudes):
        inputs[f"q_{i}"] = inputs[f"q_{i}"] + generator.uniform(-np.pi, np.pi, count)
    for first in quaternions:
        wxyz = generator.normal(size=(4, count))
        inputs |= {f"q_{first + k}": part for k, part in enumerate(wxyz / np.linalg.norm(wxyz, axis=0))}
    far = probes.with_inputs(inputs)
    return on_rows(far, far, rows, {f"q_{i}": n for i, n in enumerate(coordinates)})
