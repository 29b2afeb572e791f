"""Compare the rates of two programs, or of a program and dense matrices, at probes where both are valid.
Differences are relative to the typical size of each rate.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import all_finite, at_index, largest, real_type
from jourdain_jax.lowering.appell import AppellOnGraph, Equations
from jourdain_jax.lowering.dense_rates import dense_rates
from jourdain_jax.lowering.elimination import pivots_ok
from jourdain_jax.lowering.lowered_equations import NotLowered
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import Structure

DIFFERS = "differs from dense matrices"
LIKELY = (
    "a body, load or constraint may have a kink there, or the constraints or the remaining inertia are nearly"
    " singular"
)


def rates_of(found: Equations) -> list[int]:
    """Return the nodes of qdot and ydot."""
    return [*found.qdot, *found.ydot]


def values_at(found: Equations, probes: Probes) -> np.ndarray:
    """Return the rates at all probes; NaN at probes with a small pivot, where the program is not valid."""
    return np.where(pivots_ok(found.pivots, probes), probes(rates_of(found)), np.nan)


def agree(values: np.ndarray, expected: np.ndarray) -> bool:
    """Return whether two programs agree wherever the second is valid, from their rates."""
    usable = all_finite(expected, axis=0)
    error = np.abs(values - expected)[:, usable]
    # tolerance 1e-9, relative to the size of each rate
    return bool(enough(usable) and np.all(error <= 1e-9 * _sizes(expected[:, usable])))


def _sizes(rates: np.ndarray) -> np.ndarray:
    """Return reference sizes for errors of rates (first axis) at probes: the largest value of each rate, plus
    0.01 of the largest rate at the probe, because elimination spreads round-off over all rates.
    """
    usual = largest(rates, 1, keepdims=True)
    return usual + 0.01 * largest(rates, 0) + np.finfo(float).tiny


def enough(usable: np.ndarray) -> bool:
    """Return whether a program is valid at enough probes: at 12, or, if there are few probes, at half of
    them. For long chains, few probes satisfy the constraints.
    """
    return int(np.count_nonzero(usable)) >= min(12, max(4, len(usable) // 2))


def check_against_dense(
    scene: Scene, structure: Structure, builder: AppellOnGraph, found: Equations, values: np.ndarray
) -> None:
    """Raise `NotLowered`, with the name of the worst rate, if the program differs at the probes from a
    solution by dense matrices with JAX's derivatives.
    """
    probes, independent = builder.probes, tuple(builder.independent)
    leaves, treedef = jax.tree.flatten(scene)
    columns = [[probes.inputs[f"p{k}_{i}"] for i in range(np.size(leaf))] for k, leaf in enumerate(leaves)]
    # a parameter may have no entries
    values_of = [np.stack(c, -1) if c else np.zeros((probes.count, 0)) for c in columns]
    parameters = jax.tree.unflatten(
        treedef,
        [
            x.reshape(-1 if x.size else probes.count, *np.shape(leaf))
            for x, leaf in zip(values_of, leaves, strict=True)
        ],
    )
    t = np.broadcast_to(probes.inputs["t_0"], probes.count)
    sizes = (len(scene.coordinate_names), len(scene.speed_names), len(scene.inputs))
    q, u, inputs = (
        np.stack([probes.inputs[f"{p}_{i}"] for i in range(n)], -1) if n else np.zeros((len(t), 0))
        for p, n in zip("qui", sizes, strict=True)
    )
    usable = all_finite(values, axis=0)
    # programs of more than 5000 operations are compared at 6 probes only
    large = builder.graph.operations(rates_of(found)) > 5000
    chosen = np.flatnonzero(usable)[:6] if large else np.arange(probes.count)
    states = at_index((parameters, t, q, u, inputs), chosen)
    qdot, ydot, events = dense_rates(scene, structure, independent, *states)
    expected, values = np.concatenate([qdot, ydot], axis=1).T, values[:, chosen]
    names = [*scene.coordinate_names.entries, *(scene.speed_names.entries[i] for i in independent)]
    usable = usable[chosen] & all_finite(expected, axis=0)
    error = np.max(np.abs(values - expected)[:, usable] / _sizes(expected[:, usable]), axis=1, initial=0.0)
    if not enough(usable):
        raise NotLowered("its scalar program is valid at too few of the probed states")
    # tolerance between the program, in double precision, and dense matrices, relative to the size of each
    # rate
    limit = 1e-8 if real_type() == jnp.float64 else 1e-3
    if np.max(error) > limit:
        worst = names[int(np.argmax(error))]
        raise NotLowered(f"the rate of `{worst}` {DIFFERS} by {np.max(error):.1e}; {LIKELY}")
    values, expected = probes(found.events)[:, chosen][:, usable], events.T[:, usable]
    if found.events and not np.allclose(values, expected, rtol=limit, atol=limit, equal_nan=True):
        raise NotLowered(f"the value of a stop event {DIFFERS}")
