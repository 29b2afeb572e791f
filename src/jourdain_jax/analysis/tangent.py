"""Small motions on the constraint manifold: all perturbations of a state, and which of them are independent.

    dq = E ds,   dg = G ds = 0,   dphi = Phi_s ds + A du + Phi_f df = 0

`ds` is `dq` itself for a plain coordinate. A quaternion is perturbed by a small turn in body axes, `dq = q (0, ds)/2`, so that no component
of it is special. Dependent `ds` follow from the geometric rows g, dependent `du` from all velocity rows phi.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.build.rank import best_privileged, named_speeds, pivots_at
from jourdain_jax.build.sampling import sample_states
from jourdain_jax.build.structure import WELL_CONDITIONED, structure_of, usual_rows
from jourdain_jax.calculus.reals import Entries, is_traced, rank_cutoff
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.rows import position_residual
from jourdain_jax.equations.scaling import scaled
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.motion.put_on_rows import State
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene


def perturbed_names(scene: Scene) -> tuple[str, ...]:
    """Names of `ds`: plain coordinates as they are, and three turns in body axes per quaternion: `attitude_turn_x`, `..._y`, `..._z`."""
    names = list(scene.coordinate_names.entries)
    for first, _ in reversed(scene.coordinates.quaternions):
        group = names[first].removesuffix("_w")
        names[first : first + 4] = [f"{group}_turn_{axis}" for axis in "xyz"]
    return tuple(names)


def perturbations(scene: Scene, q: Float[Entries, "coordinates"]) -> tuple[Float[Entries, "coordinates perturbed"], Float[Entries, "perturbed coordinates"]]:
    """E and D of `dq = E ds`, `ds = D dq`; of a unit quaternion q the inverse of `x -> q x` is the transpose."""
    return (
        _by_blocks(scene, q, np.eye, lambda first: left_product(q[first : first + 4])[:, 1:] / 2),
        _by_blocks(scene, q, np.eye, lambda first: 2 * left_product(q[first : first + 4]).T[1:]),
    )


def carried_along(scene: Scene, q: Float[Entries, "coordinates"], qdot: Float[Entries, "coordinates"]) -> Float[Entries, "coordinates coordinates"]:
    """W of `d(ds)/dt = D (d qdot - W dq)`: perturbing turns are measured in axes that turn with the unperturbed motion.

    Zero for plain coordinates. For a quaternion `d(q0^-1 q)/dt = q0^-1 (qdot - q0dot q0^-1 q)`, hence `W dq = q0dot q0^-1 dq`.
    """
    return _by_blocks(scene, q, lambda n: np.zeros((n, n)), lambda first: left_product(qdot[first : first + 4]) @ left_product(q[first : first + 4]).T)


def _by_blocks(scene: Scene, q, plain, turned):
    blocks, begin = [], 0
    for first, _ in scene.coordinates.quaternions:
        blocks += [plain(first - begin), turned(first)]
        begin = first + 4
    return block_diagonal([*blocks, plain(q.shape[-1] - begin)])


def left_product(p: Float[Entries, "4"]) -> Float[Entries, "4 4"]:
    """The matrix of `x -> p x` of quaternions."""
    w, x, y, z = p
    return numeric(p).stack([numeric(p).stack(row) for row in ([w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w])])


def block_diagonal(blocks: list) -> Float[Entries, "rows columns"]:
    """Matrices along the diagonal of one that is zero elsewhere."""
    xp, widths = numeric(blocks), np.cumsum([0, *(block.shape[1] for block in blocks)])
    sides = [(np.zeros((len(x), first)), x, np.zeros((len(x), widths[-1] - last))) for x, first, last in zip(blocks, widths, widths[1:], strict=False)]
    return xp.concatenate([xp.concatenate(row, axis=1) for row in sides])


def numeric(x):
    """`jax.numpy` where anything is traced, otherwise NumPy."""
    return jnp if is_traced(x) else np


def inverse(x: Float[Entries, "rows rows"]) -> Float[Entries, "rows rows"]:
    """The inverse; NaN where there is none."""
    try:
        return numeric(x).linalg.inv(x)
    except np.linalg.LinAlgError:
        return np.full(x.shape, np.nan)


def others(some, count: int) -> Int[np.ndarray, "rest"]:
    """The indices below `count` that are not among `some`."""
    return np.setdiff1d(np.arange(count), np.asarray(some, int))


def eliminated(rows: Float[Entries, "rows all"], dependent: Int[np.ndarray, "dependent"]) -> tuple[Float[Entries, "all independent"], Float[Entries, ""]]:
    """All perturbations from the independent ones so that `rows @ perturbation = 0`; and the smallest singular value of the scaled block."""
    xp, independent = numeric(rows), others(dependent, rows.shape[1])
    if dependent.size == 0:
        return np.eye(rows.shape[1]), np.ones(())
    if xp is np and not np.all(np.isfinite(rows)):
        return np.full((rows.shape[1], len(independent)), np.nan), np.asarray(np.nan)
    block = rows[:, dependent]
    fixed = jax.lax.stop_gradient(block) if xp is jnp else block
    length = xp.sqrt(xp.sum(fixed**2, axis=1, keepdims=True))
    d = 1 / xp.where(length > 0, length, 1.0)
    block, right, sigma = d * block, d * rows[:, independent], xp.linalg.svd(d * fixed, compute_uv=False)
    below = -(inverse(block) if block.shape[0] == block.shape[1] else xp.linalg.pinv(block, rtol=rank_cutoff(block.dtype))) @ right
    pivot = sigma[-1] if block.shape[0] >= block.shape[1] else 0.0
    order = np.argsort(np.concatenate([independent, dependent]))
    return xp.concatenate([np.eye(len(independent)), below])[order], xp.asarray(pivot)


def privileged_speeds(scene: Scene, names: str | tuple[str, ...] | None = None) -> tuple[int, ...]:
    """Indices of the independent speeds: those named, else the scene's own choice, else the engine's."""
    known = structure_of(scene)
    return known.independent if names is None else named_speeds(scene, names, known.degrees_of_freedom)


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


def dependent_coordinates(
    scene: Scene, state: State, named: tuple[str, ...], dependent: tuple[str, ...] | None, G: Float[np.ndarray, "rows coordinates"] | None = None
) -> Int[np.ndarray, "dependent"]:
    """Indices of the perturbations `ds` that follow from the geometric rows: those named, else well conditioned ones.

    The choice looks at the state, or at the scene's domain where the state or the parameters are traced. `G`: dg/dq at the state, if it is known.
    """
    names = perturbed_names(scene)
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
    if is_traced((scene, state)):
        scene = with_reference_parameters(scene)
        t, q, _ = sample_states(scene, 16)
    G = _geometric_rows(scene, t, q) if G is None else G[None]
    return _pivots(G @ np.stack([perturbations(scene, x)[0] for x in np.asarray(q)]), [names.index(name) for name in named], type(scene).__name__)


@eval_numpy
def _geometric_rows(scene: Scene, t, q):
    """dg/dq at every state."""
    return jax.vmap(lambda t, q: jax.jacfwd(position_residual, 2)(scene, t, q))(t, q)


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
