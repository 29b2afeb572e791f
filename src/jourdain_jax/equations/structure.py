"""What holds of a scene at every state, found once by probing: rank, privileged velocities, which kind of rows.

States are drawn from the scene's domain, together with the symmetric configurations (zero and right angles), where partitions that look
well at random states are singular; all are projected onto the geometric rows. Probing runs on concrete numbers also while a scene's
parameters are traced (the class's default values stand in), so that the choice is static.
"""

import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.equations.kinematics import coordinate_rates, velocities
from jourdain_jax.equations.plausibility import implausible, pose_numbers
from jourdain_jax.equations.probing import on_numbers, probed_once
from jourdain_jax.equations.projection import closure_residual, project_positions, project_speeds
from jourdain_jax.equations.rows import names_of_rows, velocity_residual
from jourdain_jax.equations.scaling import row_scale, speed_scale
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.arguments import as_scene
from jourdain_jax.scene.names import as_names
from jourdain_jax.scene.numbers import is_traced
from jourdain_jax.scene.scene import Scene

RANDOM_PROBES = 24
SYMMETRIC_PROBES = 200
# Where a scene states no domain: wide enough that an angle meets every direction, so that no partition passes by luck.
COORDINATE_DOMAIN = (-3.2, 3.2)
SPEED_DOMAIN = (-1.0, 1.0)
WELL_CONDITIONED = 0.02  # smallest singular value of the scaled A_z over all probes, for the minimal state to be the default
_EXHAUSTIVE = 3000
_SHORTLIST = 40


@dataclass(frozen=True)
class Structure:
    """Static facts about a scene."""

    row_names: tuple[str, ...]
    rank: int  # of the rows at generic states
    ranks: tuple[int, ...]  # at all probed states
    redundant_rows: tuple[str, ...]  # may be left out together: the others keep the rank at every probed state
    rank_losses: tuple[str, ...]  # configurations among the probed ones with fewer independent rows, as text
    independent: tuple[int, ...]  # privileged speeds, chosen by the user or by conditioning
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes
    typical_pivot: float  # its median
    affine: bool  # rows are linear or affine in the speeds
    homogeneous: bool  # phi vanishes at u = 0
    rheonomic: bool  # rows, poses or coordinate rates depend on time
    driven: bool  # bodies or coordinates move while all speeds are zero
    chosen_by_user: bool
    faults: tuple[str, ...]  # numbers of bodies and planes that cannot be, as sentences

    @property
    def degrees_of_freedom(self) -> int:
        """Number of independent speeds at generic states."""
        return len(self.independent)

    @property
    def well_conditioned(self) -> bool:
        """Whether the privileged velocities serve everywhere in the domain."""
        return self.worst_pivot >= WELL_CONDITIONED


def sample_states(scene: Scene, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At most `count` random admissible states (t, q, u) from the scene's domain, on the rows, each with a leading axis of states.

    `seed`: of the generator. Scene parameters must be concrete. ValueError where no state meets the geometric rows.
    """
    drawn = -(-count // 32) * 32  # always a multiple of this, so that one program serves all small samples
    t, q, u = _random_states(scene, drawn, np.random.default_rng(seed))
    q, u, miss = _projected(scene, t, q, u)
    good = np.flatnonzero(_assembled(scene, miss, np.ones(drawn, bool)))[:count]
    return t[good], q[good], u[good]


def symmetric_states(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (t, q, u) at the symmetric configurations (zero and right angles), on the rows where those can be met."""
    configurations = _symmetric_configurations(scene)[:32]
    t, _, u = _random_states(scene, 32, np.random.default_rng(2))
    q, u, miss = _projected(scene, 0.0 * t, np.resize(configurations, (32, configurations.shape[1])), u)
    good = np.flatnonzero(miss < np.sqrt(np.finfo(miss.dtype).eps))
    good = good[good < len(configurations)]
    return t[good], q[good], u[good]


def _random_states(scene: Scene, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States from the domain, not yet on the rows."""
    q_low, q_high = _bounds(scene, scene.coordinate_names.entries, COORDINATE_DOMAIN)
    u_low, u_high = _bounds(scene, scene.speed_names.entries, SPEED_DOMAIN)
    q = generator.uniform(q_low, q_high, (count, len(q_low)))
    for first, _ in scene.coordinates.quaternions:
        wxyz = generator.normal(size=(count, 4))
        q[:, first : first + 4] = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    return generator.uniform(0, 1, count), q, generator.uniform(u_low, u_high, (count, len(u_low)))


def _assembled(scene: Scene, miss: np.ndarray, generic: np.ndarray) -> np.ndarray:
    """Which states lie on the geometric rows; a ValueError where no random one does."""
    good = miss < np.sqrt(np.finfo(miss.dtype).eps)
    if not good[generic].any():
        raise ValueError(
            f"no admissible state of `{type(scene).__name__}` was found in its `domain`: positions miss the geometric rows by {np.min(miss[generic]):.1e} or "
            "more; state a `domain` nearer to an assembled configuration, or check the geometric rows against each other"
        )
    return good


def _bounds(scene: Scene, names, default) -> tuple[np.ndarray, np.ndarray]:
    pairs = [scene.domain.get(name, default) for name in names]
    return np.array([p[0] for p in pairs], float), np.array([p[1] for p in pairs], float)


@on_numbers
def _projected(scene, t, q, u):
    def one(t, q, u):
        q = project_positions(scene, t, q)
        return q, project_speeds(scene, t, q, u), _miss(scene, t, q)

    return jax.vmap(one)(t, q, u)


def _miss(scene, t, q):
    """Largest residual of the geometric rows; infinite where it is not a number."""
    miss = jnp.max(jnp.abs(closure_residual(scene, t, q)), initial=0.0)
    return jnp.where(jnp.isfinite(miss), miss, jnp.inf)


def _symmetric_configurations(scene: Scene) -> np.ndarray:
    """Zero, and right angles (within the domain) in one or two coordinates."""
    low, high = _bounds(scene, scene.coordinate_names.entries, COORDINATE_DOMAIN)
    reference = scene.coordinates.reference()
    attitude = {i + k for i, _ in scene.coordinates.quaternions for k in range(4)}
    turns = [(i, a) for i in range(len(low)) if i not in attitude for a in (np.pi / 2, -np.pi / 2) if low[i] <= a <= high[i]]
    pairs = sorted(itertools.combinations(turns, 2), key=lambda pair: pair[0][1] != pair[1][1])  # equal angles first: headings of one axle
    chosen = [(), *((turn,) for turn in turns), *pairs]
    configurations = []
    for turned in chosen[:SYMMETRIC_PROBES]:
        q = np.where([i in attitude for i in range(len(low))], reference, np.clip(reference, low, high))
        for i, angle in turned:
            q[i] = angle
        configurations.append(q)
    return np.array(configurations).reshape(-1, len(low))


@on_numbers
def _probe(scene, t, q, u, u_other):
    def one(t, q, u, u_other):
        q = project_positions(scene, t, q)
        M = mass_matrix_at(scene, t, q)
        A, A_other = (jax.jacfwd(lambda v: velocity_residual(scene, t, q, v))(v) for v in (u, u_other))
        c = speed_scale(M)
        scaled = row_scale(A * c)[:, None] * A * c
        still = velocity_residual(scene, t, q, jnp.zeros_like(u))
        curved = jnp.max(jnp.abs(A - A_other), initial=0.0) > 1e-9 * (1 + jnp.max(jnp.abs(A), initial=0.0))
        timed = jnp.concatenate(
            [
                jax.jacfwd(lambda t: velocity_residual(scene, t, q, u))(t),
                jax.jacfwd(lambda t: coordinate_rates(scene, t, q, u))(t),
                jax.jacfwd(lambda t: jnp.stack([b.position for b in scene.bodies(t, scene.coordinate_names.view(q)).values()]).ravel())(t),
            ]
        )
        at_rest = velocities(scene, t, q, jnp.zeros_like(u))
        moving = jnp.concatenate([at_rest.linear.ravel(), at_rest.angular.ravel(), coordinate_rates(scene, t, q, jnp.zeros_like(u))])
        return scaled, jnp.max(jnp.abs(still), initial=0.0), curved, jnp.any(timed != 0), jnp.any(moving != 0), _miss(scene, t, q), pose_numbers(scene, t, q)

    return jax.vmap(one)(t, q, u, u_other)


def structure_of(scene: Scene) -> Structure:
    """Static facts about a scene: rank of its rows, privileged velocities and their conditioning, kinds of rows; eqs. (25)-(31).

    Probed once per class and parameter values, at random and symmetric states of the domain; concrete numbers stand in for traced parameters.
    ValueError where no admissible state is found, or `privileged` names unknown or too few speeds; for known parameters also where
    numbers of its bodies or planes cannot be.
    """
    structure = _probed_structure(as_scene(scene))
    if structure.faults and not is_traced(scene):  # numbers that stand in for traced parameters prove nothing
        raise ValueError(structure.faults[0])
    return structure


@probed_once
def _probed_structure(scene: Scene) -> Structure:
    names = names_of_rows(scene)
    count = len(scene.speed_names)
    t, q, u = _random_states(scene, RANDOM_PROBES, np.random.default_rng(0))
    symmetric = _symmetric_configurations(scene)
    t, q, u = np.concatenate([t, np.zeros(len(symmetric))]), np.concatenate([q, symmetric]), np.concatenate([u, u[:1].repeat(len(symmetric), 0)])
    scaled, still, curved, timed, moving, miss, numbers = _probe(scene, t, q, u, -u[::-1])
    generic = np.arange(len(t)) < RANDOM_PROBES
    on_rows = _assembled(scene, miss, generic)
    usable = np.all(np.isfinite(scaled), axis=(1, 2)) & on_rows
    q, scaled, still, curved, timed, moving = (x[usable] for x in (q, scaled, still, curved, timed, moving))
    ranks = [_rank(A) for A in scaled]
    rank = max((r for r, is_generic in zip(ranks, generic[usable], strict=True) if is_generic), default=0)
    independent, by_user = _user_choice(scene, count - rank), True
    candidates = scaled[[r == rank for r in ranks]]  # at isolated losses of rank no partition of generic size exists
    if independent is None:
        independent, by_user = _choose(candidates, count, rank), False
    pivots = _pivots(candidates, [i for i in range(count) if i not in independent], rank)
    full_everywhere = all(r == rank for r in ranks)
    return Structure(
        row_names=names,
        rank=rank,
        ranks=tuple(ranks),
        redundant_rows=_redundant_rows(scaled, ranks, names),
        rank_losses=tuple(_describe(scene, c) for c, r in zip(q, ranks, strict=True) if r < rank),
        independent=independent,
        worst_pivot=_worst(candidates, [i for i in range(count) if i not in independent], rank) if full_everywhere else 0.0,
        typical_pivot=float(np.median(pivots)) if pivots.size else 1.0,
        affine=not bool(curved.any()),
        homogeneous=bool((still < 1e-12).all()),
        rheonomic=bool(timed.any()),
        driven=bool(moving.any()),
        chosen_by_user=by_user,
        faults=implausible(scene, jax.tree.map(lambda x: x[on_rows], numbers)),
    )


def _rank(A: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(A, tol=1e-9)) if A.size else 0


def _redundant_rows(scaled: np.ndarray, ranks: list[int], names: tuple[str, ...]) -> tuple[str, ...]:
    """Rows that may be left out, later ones first, so that the rest keeps its rank at every probed state."""
    kept = list(range(len(names)))
    for s in reversed(range(len(names))):
        rest = [i for i in kept if i != s]
        if all(_rank(A[rest]) == r for A, r in zip(scaled, ranks, strict=True)):
            kept = rest
    return tuple(name for s, name in enumerate(names) if s not in kept)


def _describe(scene: Scene, q: np.ndarray) -> str:
    values = [f"{name} = {value:.4g}" for name, value in zip(scene.coordinate_names.entries, q, strict=True) if abs(value) > 1e-12]
    return ", ".join(values) or "all coordinates zero"


def _user_choice(scene: Scene, freedoms: int) -> tuple[int, ...] | None:
    if scene.privileged is None:
        return None
    chosen = tuple(scene.speed_names.index(name, f"privileged speed of `{type(scene).__name__}`:") for name in as_names(scene.privileged))
    if len(chosen) != freedoms:
        raise ValueError(
            f"`privileged` of `{type(scene).__name__}` names {len(chosen)} speeds, but the scene has {freedoms} degrees of freedom; "
            f"name {freedoms} independent speeds"
        )
    return chosen


def _pivots(scaled: np.ndarray, dependent: list[int], rank: int) -> np.ndarray:
    """Smallest singular value of A_z at every probe."""
    if rank == 0:
        return np.ones(len(scaled))
    return np.linalg.svd(scaled[:, :, dependent], compute_uv=False)[:, rank - 1]


def _worst(scaled: np.ndarray, dependent: list[int], rank: int) -> float:
    """The smallest pivot over the domain: zero where the determinant of A_z changes sign between probes, for it vanishes in between."""
    if rank and scaled.shape[1] == rank:
        signs = np.linalg.slogdet(scaled[:, :, dependent])[0]
        if signs.min(initial=0.0) < 0 < signs.max(initial=0.0):
            return 0.0
    return float(_pivots(scaled, dependent, rank).min(initial=1.0))


def _choose(scaled: np.ndarray, count: int, rank: int) -> tuple[int, ...]:
    """The independent speeds whose complement has the largest worst pivot over all probes (the largest typical one among equals)."""
    if rank == 0:
        return tuple(range(count))
    subsets = list(itertools.islice(itertools.combinations(range(count), rank), _EXHAUSTIVE + 1))
    if len(subsets) > _EXHAUSTIVE:
        subsets = list({_greedy(A, rank) for A in scaled})

    def merit(dependent, probes):
        return round(_worst(probes, list(dependent), rank), 6), round(float(np.median(_pivots(probes, list(dependent), rank))), 6)

    some = scaled[:: max(1, len(scaled) // 40)]
    best = sorted(subsets, key=lambda dependent: merit(dependent, some), reverse=True)[:_SHORTLIST]
    dependent = max(best, key=lambda dependent: merit(dependent, scaled))
    return tuple(i for i in range(count) if i not in dependent)


def _greedy(A: np.ndarray, rank: int) -> tuple[int, ...]:
    """Columns chosen one after another by largest remaining length (pivoted QR)."""
    remaining, chosen = A.copy(), []
    for _ in range(rank):
        lengths = np.linalg.norm(remaining, axis=0)
        k = int(np.argmax(lengths))
        chosen.append(k)
        e = remaining[:, k] / lengths[k]
        remaining = remaining - np.outer(e, e @ remaining)
    return tuple(sorted(chosen))
