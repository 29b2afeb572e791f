"""Compare the rates of two programs, or of a program and dense matrices, at probes where both are valid.
Differences are relative to the typical size of each rate.

`comparison_probes` makes the probes, which are states with parameters. `dense_rates` computes the rates of
a scene by dense matrices in NumPy, with JAX's derivatives, as a reference for scalar programs:

    beta, gamma, A          derivatives of v, omega, phi along each speed
    a_0, alpha_0, drift     derivatives along (1, qdot, 0)
    M = sum m beta' beta + gamma' I gamma
    f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    M udot - A' lambda = f,   A udot = -drift                                        (68)-(70)

Source: Wang and Pao (2003).

`full_turns` makes probes outside the domain, with angles over full turns, because a pivot that is large in
the domain may vanish at another heading. Their speeds satisfy the velocity constraints; otherwise redundant
constraints would have no solution.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Float

from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.reals import Indices, all_finite, at_index, largest, real_type
from jourdain_jax.calculus.roots import shortest
from jourdain_jax.equations.virtual_power import mass_matrix
from jourdain_jax.lowering.appell import AppellOnGraph, Equations
from jourdain_jax.lowering.elimination import pivots_ok
from jourdain_jax.lowering.lowered_equations import NotLowered
from jourdain_jax.lowering.pivots import turns
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.identity_test import onto_rows
from jourdain_jax.scene.identity import varied
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import random_states, speed_scales, typical_lengths
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import TracedScene, VelocityQuantities, jaxpr_of_scene, named_values


def dense_rates(
    scene: Scene, structure: Structure, independent: Indices, parameters: Scene, t, q, u, inputs
) -> tuple[np.ndarray, ...]:
    """Return the rates of coordinates, the rates of the independent speeds, and the values of events, at many
    states. Rates are NaN if the accelerations are not unique.

    All arrays, including parameters, have a leading axis of states. `independent`: indices of the speeds in
    the state; the constraints determine the others.
    """
    closed, shape = jaxpr_of_scene(scene, structure.potentials_of_inputs)
    numbers: VelocityQuantities = jax.tree.unflatten(
        jax.tree.structure(shape), range(len(jax.tree.leaves(shape)))
    )[0]

    def of_state(*names: str) -> Callable:
        function = jaxpr_as_fun(needed_only(closed, [getattr(numbers, name) for name in names]))
        return lambda scene, t, q, u, inputs: function(*jax.tree.leaves(scene), t, q, u, inputs)

    names = "qdot", "omega", "force", "torque", "direct", "mass", "inertia", "events", "slip_turns"
    values, level = of_state(*names), of_state("v", "omega", "phi")

    def slopes(scene, t, q, u, inputs, *along):
        return jax.jvp(lambda *state: level(scene, *state, inputs), (t, q, u), along)

    functions, states = (uncompiled_lanes(values), uncompiled_lanes(slopes)), (parameters, t, q, u, inputs)
    # limits the product of states and directions that are computed at once
    size = -(-len(t) // (1 + u.size // 4096))
    found = [
        _rates(functions, structure, independent, *at_index(states, slice(i, i + size)))
        for i in range(0, len(t), size)
    ]
    return tuple(map(np.concatenate, zip(*found, strict=True)))


def _rates(
    functions: tuple[Callable, Callable],
    structure: Structure,
    independent: Indices,
    parameters,
    t,
    q,
    u,
    inputs,
) -> tuple[np.ndarray, ...]:
    values, slopes = functions
    kept, (states, speeds) = list(structure.kept_rows), u.shape
    dependent = np.setdiff1d(np.arange(speeds), independent)

    lanes = lambda *given: jax.tree.map(lambda x: np.repeat(x, speeds, axis=0), given)
    parted = lambda found: jax.tree.map(lambda x: x.reshape(states, speeds, *x.shape[1:]), found)

    u = np.where(np.isin(np.arange(speeds), dependent), 0.0, u)
    none, still = np.zeros(states * speeds), np.zeros((states * speeds, q.shape[1]))
    each = np.tile(np.eye(speeds), (states, 1))
    (_, _, phi), found = parted(slopes(*lanes(parameters, t, q, u, inputs), none, still, each))
    beta, gamma, A = (np.moveaxis(x, 1, -1) for x in found)
    A = A[:, kept]
    if dependent.size:  # A (u - y) = -phi(y)
        A_z = A[:, :, dependent]
        u[:, dependent] = -shortest(A_z, phi[:, 0, kept], typical_lengths(np.linalg.norm(A_z, axis=2)))
    qdot, omega, force, torque, direct, m, I, events, turns = values(parameters, t, q, u, inputs)
    # with the same batch size as above, so that JAX traces the function once
    along = np.ones(states), qdot, np.zeros_like(u)
    rates = parted(slopes(*lanes(parameters, t, q, u, inputs, *along)))[1]
    a, alpha, drift = (x[:, 0] for x in rates)
    turned = lambda x: np.einsum("sbij,sbj->sbi", I, x)
    force, torque = force - m[..., None] * a, torque - turned(alpha) - np.cross(omega, turned(omega))
    f = np.einsum("sbik,sbi->sk", beta, force) + np.einsum("sbik,sbi->sk", gamma, torque) + direct
    M, lengths = mass_matrix(m, I, beta, gamma), structure.row_lengths[kept]
    udot = accelerations(M, f, A, drift[:, kept], lengths, structure.rank)
    qdot = np.append(qdot[:, : q.shape[1] - turns.shape[1]], turns, axis=1)
    return qdot, udot[:, list(independent)], events


def accelerations(M, f, A, drift, row_lengths: np.ndarray, rank: int) -> np.ndarray:
    """Solve `M udot - A' lambda = f`, `A udot = -drift` for udot at many states; NaN if udot is not unique.

    `rank`: rank of the constraints. Further eigenvalues are ignored, because coordinates rounded to single
    precision make dependent constraints independent by about 1e-8.
    """
    c = speed_scales(M)
    A = A * c[:, None]
    length = np.maximum(np.linalg.norm(A, axis=2), row_lengths)
    d = 1 / np.where(length > 0, length, 1.0)
    A = d[..., None] * A
    system = np.block([[c[:, :, None] * M * c[:, None], A.mT], [A, np.zeros((*A.shape[:2], A.shape[1]))]])
    right = np.concatenate([c * f, -d * drift], axis=1)
    finite = all_finite(system, axis=(1, 2)) & all_finite(right, axis=1)
    size, V = np.linalg.eigh(np.where(finite[:, None, None], system, 0.0))
    largest = np.argsort(-np.abs(size), axis=1)[:, : f.shape[1] + rank]
    size, V = np.take_along_axis(size, largest, 1), np.take_along_axis(V, largest[:, None], 2)
    least = 16 * V.shape[1] * np.finfo(float).eps * np.abs(size[:, :1])
    determined = finite & np.all(np.abs(size) > least, axis=1)
    along = (V.mT @ np.where(finite[:, None], right, 0.0)[..., None])[..., 0]
    along = along / np.where(determined[:, None], size, 1.0)
    return np.where(determined[:, None], c * (V @ along[..., None])[:, : f.shape[1], 0], np.nan)


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

    Parameters are up to a tenth larger than those of `scene`, so that equality by coincidence is not taken
    for an identity. If the scene is undefined for these parameters, or its moments of inertia are
    impossible, they are closer to those of `scene`.
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
