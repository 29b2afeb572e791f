"""Small motions on the constraint manifold: all perturbations of a state, and which of them are independent.

    dq = E ds,   dg = G ds = 0,   dphi = Phi_s ds + A du + Phi_f df = 0

`ds` is `dq` itself for a plain coordinate. A quaternion is perturbed by a small turn in body axes, `dq = q (0, ds)/2`, so that no component
of it is special. Dependent `ds` follow from the geometric rows g, dependent `du` from all velocity rows phi.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.build.rank import best_privileged, pivots_at
from jourdain_jax.build.row_program import RowProgram, row_program
from jourdain_jax.build.sampling import sample_states
from jourdain_jax.build.structure import WELL_CONDITIONED, structure_of, usual_rows
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse, rank_cutoff, singular_values
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.calculus.rotations import quaternion_product
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.reductions import Privileged
from jourdain_jax.equations.rows import position_residual
from jourdain_jax.equations.scaling import row_scale, scaled
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.native.values_of_nodes import values_of_nodes
from jourdain_jax.motion.put_on_rows import State, row_functions
from jourdain_jax.native import ffi
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.names import as_names, nearest
from jourdain_jax.scene.scene import Scene


class Flow(eqx.Module):
    """The motion at one instant, or its derivative along a perturbation (then every array has an axis of perturbations)."""

    qdot: Float[Array, "coordinates *perturbations"]
    udot: Float[Array, "speeds *perturbations"]  # by Appell's equations in the privileged speeds
    phi: Float[Array, "rows *perturbations"]
    g: Float[Array, "geometric_rows *perturbations"]


class Perturbations(eqx.Module):
    """Names of `ds`, and E, D of `dq = E ds`, `ds = D dq`."""

    E: Float[Array, "coordinates perturbed"]
    D: Float[Array, "perturbed coordinates"]
    names: tuple[str, ...] = eqx.field(static=True)


class Programs(NamedTuple):
    """Scalar programs of a scene's rates in its privileged speeds, and of its rows, as machine code with derivatives of its own."""

    rates: Lowered
    rows: RowProgram


def programs_of(scene: Scene | BuiltFor, privileged: tuple[int, ...]) -> Programs | None:
    """The programs, where machine code serves for these privileged speeds; otherwise the scene's own matrices do, differentiated by JAX."""
    if ffi.reason_against() or (isinstance(scene, BuiltFor) and scene.backend == "xla"):
        return None
    rates, rows = lowered(as_scene(scene)), row_program(as_scene(scene))
    if not isinstance(rates, Lowered) or rates.independent != privileged or rows is None or rows.M is None:
        return None
    return None if unsupported(rates.graph, [*rates.qdot, *rates.ydot, *rates.guards]) else Programs(rates, rows)


@lru_cache(maxsize=64)
def _rates(program: Lowered) -> Callable[[Array], Array]:
    """Coordinate rates, accelerations of the privileged speeds, and guards as a function of parameters, t, q, y and inputs in a row."""
    of, nodes = program.traced, [*program.qdot, *program.ydot, *program.guards]
    given = [*(n for part in of.parameters for n in part.ravel().tolist()), of.t, *of.q.tolist()]
    given += [*(int(of.u[k]) for k in program.independent), *of.inputs.tolist()]
    return values_of_nodes(program.graph, dict(enumerate(nodes)), len(nodes), given)


def _flow_by(programs: Programs, scene: Scene):
    rates, rows = _rates(programs.rates), row_functions(programs.rows)
    geometric, n, chosen = len(names_of_position_rows(scene)), len(scene.coordinate_names), np.array(programs.rates.independent, int)

    def flow(t, q, u, f):
        parameters = [jnp.ravel(leaf) for leaf in jax.tree.leaves(scene)]
        found = rates(jnp.concatenate([*parameters, t[None], q, u[chosen], f]).astype(real_type()))
        guards = found[n + chosen.size :]
        qdot = jnp.where(jnp.all(guards > 0), found[:n], jnp.nan)
        udot = jnp.zeros_like(u).at[chosen].set(found[n : n + chosen.size])
        return Flow(qdot, udot, rows.rows(scene, t, q, u, f)[0], rows.closures(scene, t, q)[0][:geometric]), rows.masses(scene, t, q)

    return flow


def flow_of(scene: Scene, privileged: tuple[int, ...], programs: Programs | None = None):
    """`(t, q, u, f) -> (Flow, mass matrix)` with the accelerations in the given privileged speeds; by `programs` those of the other speeds are zero."""
    if programs is not None:
        return _flow_by(programs, scene)

    def flow(t, q, u, f):
        equations, rows = equations_and_rows(scene, t, q, u, f)
        problem = scaled(equations, rows.judged_by(usual_rows(scene)))
        w, _, _ = Privileged(privileged).solve(problem)
        return Flow(coordinate_rates(scene, t, q, u), problem.c * w, rows.phi, position_residual(scene, t, q)), equations.M

    return flow


def perturbations(scene: Scene, q: Float[Array, "coordinates"]) -> Perturbations:
    """Plain coordinates as they are, and three turns in body axes per quaternion: `attitude_turn_x`, `..._y`, `..._z`."""
    names = list(scene.coordinate_names.entries)
    E = D = jnp.eye(len(names), dtype=q.dtype)
    dropped = []
    for first, _ in scene.coordinates.quaternions:
        here = slice(first, first + 4)
        group = names[first].removesuffix("_w")
        names[here] = [f"{group}_w", *(f"{group}_turn_{axis}" for axis in "xyz")]
        times = _left_product(q[here])
        E, D = E.at[here, here].set(times / 2), D.at[here, here].set(2 * times.T)  # q is a unit quaternion: the inverse is the transpose
        dropped.append(first)
    kept = others(dropped, len(names))
    return Perturbations(E[:, kept], D[kept], tuple(names[i] for i in kept))


def carried_along(scene: Scene, q: Float[Array, "coordinates"], qdot: Float[Array, "coordinates"]) -> Float[Array, "coordinates coordinates"]:
    """W of `d(ds)/dt = D (d qdot - W dq)`: perturbing turns are measured in axes that turn with the unperturbed motion.

    Zero for plain coordinates. For a quaternion `d(q0^-1 q)/dt = q0^-1 (qdot - q0dot q0^-1 q)`, hence `W dq = q0dot q0^-1 dq`.
    """
    W = jnp.zeros((q.shape[0], q.shape[0]), q.dtype)
    for first, _ in scene.coordinates.quaternions:
        here = slice(first, first + 4)
        conjugate = q[here] * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)
        W = W.at[here, here].set(_left_product(quaternion_product(qdot[here], conjugate)))
    return W


def _left_product(p: Float[Array, "4"]) -> Float[Array, "4 4"]:
    """The matrix of `x -> p x`."""
    return jax.vmap(lambda e: quaternion_product(p, e), out_axes=1)(jnp.eye(4, dtype=p.dtype))


def others(some, count: int) -> Int[np.ndarray, "rest"]:
    """The indices below `count` that are not among `some`."""
    return np.setdiff1d(np.arange(count), np.asarray(some, int))


def eliminated(rows: Float[Array, "rows all"], dependent: Int[np.ndarray, "dependent"]) -> tuple[Float[Array, "all independent"], Float[Array, ""]]:
    """All perturbations from the independent ones so that `rows @ perturbation = 0`; and the smallest singular value of the scaled block."""
    independent = others(dependent, rows.shape[1])
    basis = jnp.eye(rows.shape[1], dtype=rows.dtype)[:, independent]
    if dependent.size == 0:
        return basis, jnp.ones((), rows.dtype)
    block = rows[:, dependent]
    d = row_scale(block)[:, None]
    block, right = d * block, d * rows[:, independent]
    below = jnp.linalg.solve(block, right) if block.shape[0] == block.shape[1] else pseudo_inverse(block) @ right
    sigma = singular_values(block)
    pivot = sigma[-1] if block.shape[0] >= block.shape[1] else jnp.zeros((), block.dtype)
    return basis.at[dependent].set(-below), pivot


def privileged_speeds(scene: Scene, names: str | tuple[str, ...] | None = None) -> tuple[int, ...]:
    """Indices of the independent speeds: those named, else the scene's own choice, else the engine's."""
    names = scene.privileged if names is None else names
    if names is None:
        return structure_of(scene).independent
    chosen = tuple(scene.speed_names.index(name, f"privileged speed of `{type(scene).__name__}`:") for name in as_names(names))
    freedoms = structure_of(scene).degrees_of_freedom
    if len(set(chosen)) != freedoms or len(chosen) != freedoms:
        raise ValueError(
            f"`privileged` names {len(set(chosen))} speeds of `{type(scene).__name__}` ({', '.join(as_names(names))}), which has {freedoms} degrees of "
            f"freedom; name {freedoms} independent speeds"
        )
    return chosen


def privileged_at(scene: Scene, state: State, f, usual: tuple[int, ...]) -> tuple[int, ...]:
    """Indices of independent speeds at a known state: the `usual` ones, or others where these do not determine the rest well."""
    A, count = _scaled_rows(scene, state.t, state.q, state.u, f)[None], len(scene.speed_names)
    rank = count - len(usual)
    pivot = lambda y: pivots_at(A, others(y, count).tolist(), rank)[0]  # noqa: E731
    return usual if pivot(usual) >= WELL_CONDITIONED else best_privileged(A, count, rank)


@eval_numpy
def _scaled_rows(scene: Scene, t, q, u, f):
    equations, rows = equations_and_rows(scene, t, q, u, f)
    return scaled(equations, rows.judged_by(usual_rows(scene))).A


def dependent_coordinates(scene: Scene, state: State, named: tuple[str, ...], dependent: tuple[str, ...] | None) -> Int[np.ndarray, "dependent"]:
    """Indices of the perturbations `ds` that follow from the geometric rows: those named, else well conditioned ones.

    The choice looks at the state, or at the scene's domain where the state or the parameters are traced.
    """
    names = perturbations(scene, state.q).names
    for name in (*named, *(dependent or ())):
        if name not in names:
            raise ValueError(f"`{type(scene).__name__}` has no coordinate `{name}` to perturb; {nearest(name, names)}")
    if len(set(named)) != len(named):
        raise ValueError(f"`coordinates` names one twice ({', '.join(named)}); name each once")
    both = set(named) & set(dependent or ())
    if both:
        raise ValueError(f"coordinate `{both.pop()}` is asked for in `coordinates` and said to be dependent; leave it out of one of the two")
    if dependent is not None:
        return np.array([names.index(name) for name in dependent], int)
    if not names_of_position_rows(scene):
        return np.zeros(0, int)
    t, q = state.t[None], state.q[None]
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((scene, state))):
        scene = with_reference_parameters(scene)
        t, q, _ = sample_states(scene, 16)
    return _pivots(_geometric_rows(scene, t, q), [names.index(name) for name in named], type(scene).__name__)


@eval_numpy
def _geometric_rows(scene: Scene, t, q):
    """dg over the perturbations, at every state."""
    return jax.vmap(lambda t, q: jax.jacfwd(position_residual, 2)(scene, t, q) @ perturbations(scene, q).E)(t, q)


def _pivots(G: Float[np.ndarray, "samples rows columns"], kept: list[int], scene: str) -> Int[np.ndarray, "dependent"]:
    """Columns chosen one after another by the largest remaining length in their worst sample (pivoted QR), none of those `kept`."""
    G = G / np.maximum(np.linalg.norm(G, axis=2, keepdims=True), np.finfo(G.dtype).tiny)
    rank = max(int(np.linalg.matrix_rank(block, tol=rank_cutoff(G.dtype))) for block in G)
    chosen: list[int] = []
    for _ in range(rank):
        lengths = np.linalg.norm(G, axis=1)
        worst = lengths.min(axis=0)
        worst[kept + chosen] = -1.0
        k = int(np.argmax(worst))
        if worst[k] <= rank_cutoff(G.dtype):
            raise ValueError(
                f"the geometric rows of `{scene}` tie the asked coordinates to each other; ask for fewer in `coordinates`, or name the `dependent` ones"
            )
        chosen.append(k)
        e = G[:, :, k] / lengths[:, k, None]
        G = G - e[:, :, None] * np.einsum("sr,src->sc", e, G)[:, None, :]
    return np.array(sorted(chosen), int)
