"""What must hold of every scene at every admissible state, as residuals relative to the size of what is
compared.

`evaluated` works everything out in one program per structure, with parameters, states and ways of looking
(`seen_differently`) as batches: on NumPy without compiling, or compiled. `residuals` compares; a reduction is
judged where it says that it applies.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from generated_scenes import LENGTHS, body_name, coordinate_list, generated
from seen_differently import Seen, other_names, views

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.calculus.matrices import null_space_qr, null_space_svd, present
from jourdain_jax.dynamics.accelerations import diagnosed
from jourdain_jax.dynamics.reactions import power, row_reactions
from jourdain_jax.equations import (
    GibbsAppell,
    coordinate_rates,
    gibbs_function,
    kinetic_energy,
    partial_velocities,
    potential_energy,
    velocity_residual,
)
from jourdain_jax.equations import virtual_power as equations_module
from jourdain_jax.equations.projection import closure_residual, project_positions, project_speeds
from jourdain_jax.equations.reductions import Partition, _by_null_space, reduce, scaled
from jourdain_jax.equations.rows import ConstraintRows
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.scene.identity import reference_parameters
from jourdain_jax.structure.load_power import power_of_loads

PUSH = 0.7  # value of the input, where a scene has one
# smallest singular values of the rows, and of M, below which an instance counts as near a loss of rank and is
# left out
NEAR = 0.03


def instances(recipe, parameters, states, seed):
    """Scenes with random parameters as one batch, the first of them alone, and states off the rows: (t, q,
    u), `states` of them for each scene.
    """
    scenes = [generated(recipe, seed + k) for k in range(parameters)]
    draw = np.random.default_rng([recipe.seed, seed, 7])
    scene = scenes[0]
    count = parameters * states
    q = scene.reference() + 0.35 * draw.uniform(-1, 1, (count, len(scene.coordinate_names)))
    u = draw.uniform(-1.0, 1.0, (count, len(scene.speed_names)))
    arrays, rest = zip(*(eqx.partition(s, eqx.is_array) for s in scenes), strict=True)
    stacked = eqx.combine(jax.tree.map(lambda *x: np.stack(x), *arrays), rest[0])
    return stacked, scene, draw.uniform(0, 2, count), q, u


def dimensions(recipe):
    """Which coordinates, and which speeds, are lengths and their rates."""
    q, u = [], []
    for _, stem, _ in coordinate_list(recipe):
        q += [False] * 4 if stem == "*" else [stem in LENGTHS]
        u += [False] * 3 if stem == "*" else [stem in LENGTHS]
    return tuple(q), tuple(u)


def evaluated(recipe, *, parameters, states, seed=0, compiled=False, looks=True):
    """Everything at all instances, as NumPy arrays with a leading axis of instances; `looks`: also seen
    differently.
    """
    stacked, scene, t, q, u = instances(recipe, parameters, states, seed)
    run = jax.jit if compiled else partial(uncompiled_lanes, shared=None)
    leaves, treedef = jax.tree.flatten(stacked)
    leaves = [np.repeat(x, states, axis=0) for x in leaves]

    def plain(leaves, t, q, u, sign):
        return jax.vmap(lambda leaves, *state: _plain(jax.tree.unflatten(treedef, leaves), *state))(
            leaves, t, q, u, sign
        )

    names, ways = views(len(scene.coordinate_names), len(scene.speed_names))

    def seen(leaves, ways, *state):
        return jax.vmap(
            lambda leaves, *view_and_state: _seen(
                recipe, jax.tree.unflatten(treedef, leaves), *view_and_state
            )
        )(leaves, ways, *state)

    with reference_parameters(scene):
        both = [np.concatenate([x, x]) for x in (*leaves, t, q, u)]
        found = jax.tree.map(np.asarray, run(plain)(both[:-3], *both[-3:], np.repeat([1.0, -1.0], len(t))))
        forwards, backwards = (
            jax.tree.map(lambda x, half=half: x[half], found) for half in (slice(len(t)), slice(len(t), None))
        )
        forwards["reversed"] = backwards["udot"]
        if not looks:
            return forwards
        known = (forwards[name] for name in ("t", "q", "u", "rate"))
        every = [np.repeat(x, len(names), axis=0) for x in (*leaves, *known)]
        ways = jax.tree.map(lambda x: np.tile(x, (len(t), *[1] * (x.ndim - 1))), ways)
        viewed = jax.tree.map(np.asarray, run(seen)(every[:-4], ways, *every[-4:]))
    viewed = jax.tree.map(lambda x: x.reshape(len(t), len(names), *x.shape[1:]), viewed)
    return forwards | {"seen": viewed}


@eqx.filter_jit
def _solved(ways, equations, rows):
    """Accelerations by every reduction of equations and rows; traced once for each shape."""
    return {name: reduce(way, equations, rows) for name, way in ways.items()}


@eqx.filter_jit
def _diagnosed(found, equations, rows):
    return diagnosed(found, equations, rows)


@eqx.filter_jit
def _bases(independent, equations, rows):
    """Null spaces of the scaled rows, and accelerations by other bases Z R of them."""
    problem = scaled(equations, rows)
    n = problem.M.shape[0]
    Z = {"qr": null_space_qr(problem.A), "svd": null_space_svd(problem.A)}
    split = Partition(problem.A, independent)
    mixed = jnp.eye(n) + 0.6 * jnp.sin(1.0 + jnp.arange(n * n, dtype=float).reshape(n, n))
    other = {}
    for name, basis in Z.items():
        there = present(basis)
        R = jnp.where(there[:, None] & there, mixed, jnp.eye(n))
        other[name] = _by_null_space(problem, basis @ R)[0]
    C = jnp.where(split.pivot() > NEAR, split.C, 0.0)
    return {
        "A": problem.A,
        "Z": Z,
        "C": C,
        "other bases": other,
        "M": problem.M,
        "sigma": jnp.linalg.svd(problem.M, compute_uv=False)[-1],
    }


def _accelerations(scene, ways, t, q, u, inputs):
    """By every reduction, and the equations and rows they came from."""
    equations, rows = equations_module.equations_and_rows(scene, t, q, u, inputs)
    gibbs = {name: way for name, way in ways.items() if isinstance(way, GibbsAppell)}
    rows = ConstraintRows(
        rows.phi, rows.A, rows.drift, ()
    )  # without names, so that one trace serves all rows of one shape
    found = _solved({name: way for name, way in ways.items() if name not in gibbs}, equations, rows)
    return (
        found | {name: way.accelerations(scene, t, q, u, equations, rows) for name, way in gibbs.items()},
        equations,
        rows,
    )


def _seen(recipe, scene, view, t, q, u, rate):
    """Accelerations of the same motion, seen differently."""
    inputs = PUSH * jnp.ones(len(scene.inputs))
    lengths, paces = dimensions(recipe)
    seen = Seen(scene, view, other_names(body_name(i) for i in range(len(recipe.bodies))), lengths, paces)
    new_q = seen.new_coordinates(q)
    new_u, expected = jax.jvp(seen.new_speeds, (q, u), (coordinate_rates(scene, t, q, u), rate))
    ways = {name: way for name, way in jj.reductions(scene).items() if name != "gibbs-appell"}
    by, equations, rows = _accelerations(seen, ways, t / view.time, new_q, new_u, inputs)
    c = scaled(equations, rows).c
    return {
        "udot": {name: way.udot / c for name, way in by.items()},
        "applicable": {name: way.applicable for name, way in by.items()},
        "expected": expected * view.time / c,
        "force": c * (equations.Q - equations.h),
        "rank": _diagnosed(by["svd"], equations, rows).rank,
    }


def _plain(scene, t, q, u, sign):
    """Everything at one state near (q, u), with the speeds of the given sign."""
    inputs = PUSH * jnp.ones(len(scene.inputs))
    q = project_positions(scene, t, q)
    u = sign * project_speeds(scene, t, q, u, inputs)
    left = jnp.concatenate([closure_residual(scene, t, q), velocity_residual(scene, t, q, u, inputs)])
    ways = jj.reductions(scene)
    by, equations, rows = _accelerations(scene, ways, t, q, u, inputs)
    best = _diagnosed(by["svd"], equations, rows)
    bases = _bases(structure_of(scene).independent, equations, rows)
    c = scaled(equations, rows).c
    motion = jj.motion_at(scene, t, q, u, inputs)
    along = jnp.cos(1.0 + jnp.arange(u.shape[0])) / c  # any direction, for Hessians
    h, M_along = jax.jvp(
        jax.grad(lambda a: gibbs_function(scene, t, q, u, a)), (jnp.zeros_like(u),), (along,)
    )

    def T(u, t=t, q=q):
        return kinetic_energy(scene, t, q, u)

    def energies(t, q, u):
        return (
            T(u, t, q),
            potential_energy(scene, jj.motion_at(scene, t, q, u, inputs)),
            velocity_residual(scene, t, q, u, inputs),
        )

    rates = (jnp.ones_like(t), coordinate_rates(scene, t, q, u), best.udot)
    (kinetic, V, _), (T_rate, V_rate, phi_rate) = jax.jvp(energies, (t, q, u), rates)
    (at_rest, slope), (_, T_along) = jax.jvp(jax.value_and_grad(T), (jnp.zeros_like(u),), (along,))
    reactions = row_reactions(scene, t, q, u, best, inputs)
    partial = partial_velocities(scene, t, q, u)
    turned = jnp.einsum(
        "bji,sbj->sbi", jnp.stack([body.orientation for body in motion.bodies.values()]), reactions.torque
    )
    by_row = (
        jnp.einsum("bik,sbi->sk", partial.linear, reactions.force)
        + jnp.einsum("bik,sbi->sk", partial.angular, turned)
        + reactions.direct
    )
    return {
        "M": c[:, None] * equations.M * c,
        "h": c * equations.h,
        "Q": c * equations.Q,
        "M along": c * (equations.M @ along),
        "T along": c * T_along,
        "G along": c * M_along,
        "h of G": c * h,
        "T": kinetic,
        "T by M": at_rest + slope @ u + 0.5 * u @ equations.M @ u,
        "A": bases["A"],
        "Z": bases["Z"],
        "C": bases["C"],
        "other bases": bases["other bases"],
        "sigma of M": bases["sigma"],
        "rate": best.udot,
        "udot": {name: way.udot / c for name, way in by.items()},
        "force": {name: c * way.constraint_force for name, way in by.items()},
        "applicable": {name: way.applicable for name, way in by.items()},
        "rank": best.rank,
        "sigma": best.smallest_singular_value,
        "row rates": scaled(equations, rows).d * phi_rate,
        "row forces": c * by_row,
        "E": kinetic + V,
        "E rate": T_rate + V_rate,
        "power": power(scene, motion, best).total,
        "power of loads": power_of_loads(scene, motion, conservative=False),
        "speed": jnp.linalg.norm(u / c),
        "well conditioned": jnp.array(structure_of(scene).well_conditioned),
        "miss": jnp.max(jnp.abs(left), initial=0.0),
        "t": t,
        "q": q,
        "u": u,
    }


def admitted(found):
    """Which instances lie on the rows, away from a loss of rank (of the rows, or of M)."""
    rank = found["rank"]
    return (
        (found["miss"] < 1e-10)
        & (found["sigma"] > NEAR)
        & (found["sigma of M"] > NEAR**2)
        & (rank == rank.max())
    )


def residuals(recipe, found):
    """Residual of every invariant at the admitted instances, each an array over them."""
    good = admitted(found)
    found = jax.tree.map(lambda x: x[good], found)
    M = found["M"]
    largest = lambda x: np.max(np.abs(x), axis=tuple(range(1, x.ndim)), initial=0.0)
    force = largest(found["Q"]) + largest(found["h"]) + largest(found["force"]["svd"]) + found["speed"] ** 2
    size = force + largest(found["udot"]["svd"])
    out = {
        "M is symmetric": largest(M - np.swapaxes(M, 1, 2)),
        "M is positive definite": np.where(np.linalg.eigvalsh(M)[:, 0] > 0, 0.0, 1.0),
        "u'Mu/2 is the quadratic part of T": np.abs(found["T"] - found["T by M"]) / (found["T"] + 1e-3),
        "M is the Hessian of T": largest(found["M along"] - found["T along"]),
        "M is the Hessian of the Gibbs function": largest(found["M along"] - found["G along"]),
        "h is the gradient of the Gibbs function": largest(found["h"] - found["h of G"]) / force,
        "rows hold along the motion": largest(found["row rates"]) / size,
        "reactions add up": largest(np.sum(found["row forces"], axis=1) - found["force"]["svd"]) / force,
        "dE/dt is the power of all that works": (
            np.abs(found["E rate"] - found["power"]) / (np.abs(found["E"]) + found["speed"] * size)
        ),
    }
    for name, Z in found["Z"].items():
        out[f"A Z = 0, {name}"] = largest(found["A"] @ Z)
        out[f"Z' reaction of each row = 0, {name}"] = largest(found["row forces"] @ Z) / force
        out[f"Z -> Z R changes nothing, {name}"] = (
            largest(found["other bases"][name] - found["udot"]["svd"]) / size
        )
    out["A C = 0, privileged"] = largest(found["A"] @ found["C"]) / (1 + largest(found["C"]))
    for name, udot in found["udot"].items():
        serves = found["applicable"][name]
        power = np.einsum("sij,si->sj", found["Z"]["svd"], found["force"][name])
        out[f"Z'(virtual power) = 0, {name}"] = np.where(serves, largest(power) / force, 0.0)
        out[f"reductions agree, {name}"] = np.where(serves, largest(udot - found["udot"]["svd"]) / size, 0.0)
        if name in ("qr", "svd", "kkt", "udwadia-kalaba"):
            out[f"applies, {name}"] = np.where(serves, 0.0, 1.0)
    if recipe.scleronomic:
        out["dE/dt is the power of impressed forces"] = np.abs(found["E rate"] - found["power of loads"]) / (
            np.abs(found["E"]) + found["speed"] * size
        )
    if recipe.reversible:
        for name, udot in found["reversed"].items():
            out[f"time reversal, {name}"] = np.where(
                found["applicable"][name], largest(udot - found["udot"][name]) / size, 0.0
            )
    return out | (_of_views(found) if "seen" in found else {})


def _of_views(found):
    """One motion, seen differently, by every reduction."""
    seen = found["seen"]
    names, _ = views(1, 1)
    out = {}
    for k, view in enumerate(names):
        expected, force = seen["expected"][:, k], seen["force"][:, k]
        size = np.max(np.abs(expected), axis=1) + np.max(np.abs(force), axis=1)
        out[f"{view}: the rank of the rows"] = np.where(seen["rank"][:, k] == found["rank"], 0.0, 1.0)
        for name, udot in seen["udot"].items():
            serves = seen["applicable"][name][:, k]
            out[f"{view} changes nothing, {name}"] = np.where(
                serves, np.max(np.abs(udot[:, k] - expected), axis=1) / size, 0.0
            )
    return out
