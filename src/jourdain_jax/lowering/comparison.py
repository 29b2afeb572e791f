"""Compare the rates of two programs, or of a program and dense matrices, at probes where both are valid.
Differences are relative to the typical size of each rate.

Probes are states with parameters. Candidates for a scalar program are compared at the probes made here.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite, at_index, largest, real_type
from jourdain_jax.lowering.appell import AppellOnGraph, Equations
from jourdain_jax.lowering.dense_rates import dense_rates
from jourdain_jax.lowering.elimination import pivots_ok
from jourdain_jax.lowering.lowered_equations import NotLowered
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.identity import varied
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import random_states
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import TracedScene, named_values

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
    # tolerance of the program, in double precision, against dense matrices, relative to the size of each rate
    limit = 1e-8 if real_type() == jnp.float64 else 1e-3
    if np.max(error) > limit:
        worst = names[int(np.argmax(error))]
        raise NotLowered(f"the rate of `{worst}` {DIFFERS} by {np.max(error):.1e}; {LIKELY}")
    values, expected = probes(found.events)[:, chosen][:, usable], events.T[:, usable]
    if found.events and not np.allclose(values, expected, rtol=limit, atol=limit, equal_nan=True):
        raise NotLowered(f"the value of a stop event {DIFFERS}")


def comparison_probes(scene: Scene, structure: Structure, traced: TracedScene) -> Probes:
    """Return probes at random and symmetric configurations on the geometric constraints, with random speeds.

    Parameters are up to a tenth larger than given, so that equality by coincidence is not taken for an
    identity. If the scene is undefined for these parameters, or its moments of inertia are impossible, they
    are closer to the given ones.
    """
    generator = np.random.default_rng(1)
    # at most 56 probes
    t, q = structure.times[:56], np.array(structure.coordinates[:56], np.float64)
    # in single precision, norms of quaternions equal one only to seven digits
    for first, _ in scene.coordinates.quaternions:
        q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
    u = random_states(scene, len(t), generator)[2]
    given = [np.asarray(x) for x in jax.tree.leaves(scene)]
    away = [varied(x, 0.1 * generator.uniform(size=(len(t), *x.shape)), 0.05) - x for x in given]
    inputs = generator.normal(size=(len(t), len(scene.inputs)))
    for column, (_, values) in enumerate(scene.modes.pairs, len(scene.inputs) - len(scene.modes.pairs)):
        inputs[:, column] = generator.integers(len(values), size=len(t))
    values = named_values(scene, t, q, u, inputs)

    def probes(share) -> Probes:
        columns = [
            np.reshape(x + np.reshape(share, (-1, *[1] * x.ndim)) * dx, (len(t), -1)).T
            for x, dx in zip(given, away, strict=True)
        ]
        parameters = {
            f"p{k}_{i}": column for k, of_leaf in enumerate(columns) for i, column in enumerate(of_leaf)
        }
        return Probes(
            traced.graph, values | {name: np.asarray(value, np.float64) for name, value in parameters.items()}
        )

    share, possible, least = np.zeros(len(t)), False, _least_moments(traced, probes(np.zeros(len(t)))) / 2
    # try shrinking shares of the parameter variation until the scene is valid
    for tried in (1.0, -1.0, *(0.1**k for k in range(1, 9))):
        share = np.where(possible, share, tried)
        here = probes(share)
        finite = all_finite(here([n for part in traced.motion for n in part.ravel().tolist()]), axis=0)
        possible = finite & ~np.any(_least_moments(traced, here) < least, axis=1)
        if possible.all():
            break
    return here


def _least_moments(traced: TracedScene, probes: Probes) -> Float[np.ndarray, "probes bodies"]:
    """Return the smallest principal moment of each body at each probe; NaN if undefined."""
    I = np.moveaxis(probes(traced.at.inertia.ravel().tolist()).reshape(-1, 3, 3, probes.count), -1, 0)
    known = all_finite(I, axis=(2, 3))
    return np.where(known, np.linalg.eigvalsh(np.where(known[..., None, None], I, 0.0))[..., 0], np.nan)
