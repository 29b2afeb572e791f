"""Facts that hold at every state of a scene, found once by probing: rank, independent speeds, kinds of
constraints.

Random states are drawn from the scene's domain. Symmetric configurations (zero and right angles) are added,
since partitions that are regular at random states may be singular there. All are projected onto the geometric
constraints. Traced parameters are replaced by numbers near the class's defaults, so that decisions are
static.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Indices, all_finite, at_index, eps_of, is_traced
from jourdain_jax.equations.rows import UsualRows, names_of_position_rows, names_of_rows
from jourdain_jax.scene.arguments import as_scene
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.identity import once_per_values, reference_parameters, with_reference_parameters
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import speed_scales, typical_row_lengths
from jourdain_jax.structure.plausibility import sentences
from jourdain_jax.structure.probes import TIMED, follow_from_others
from jourdain_jax.structure.rank import (
    RANDOM_PROBES,
    at_probes,
    best_privileged,
    contradictions,
    exceeds,
    far_rows,
    is_singular,
    moves,
    named_speeds,
    no_inertia,
    pivots_at,
    ranks_of,
    redundant_rows,
    scaled_states,
    sizes,
    speed_terms,
    worst_pivot,
)
from jourdain_jax.structure.sampling import drawn_states, no_numbers, usable_states
from jourdain_jax.structure.smoothness import kinks

WELL_CONDITIONED = 0.02  # numerics: least `worst_pivot` for which the minimal state is the default


@dataclass(frozen=True)
class Structure:
    """Properties of a scene found by probing: rank, independent speeds, dependence on time, faults."""

    row_names: Labels
    rank: int  # at generic states
    ranks: tuple[int, ...]  # at all probed states
    redundant_rows: Labels  # may be omitted together: the others keep the rank at every probed state
    may_set_in: Labels  # redundant rows that may be independent away from the probes
    rank_losses: Labels  # probed configurations with fewer independent rows, as text
    independent: Indices  # independent speeds, chosen by the user or by conditioning
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes
    typical_pivot: float  # its median
    affine: bool  # constraints are linear or affine in the speeds
    homogeneous: bool  # phi vanishes at u = 0
    timed: Labels  # quantities that depend explicitly on time, from `TIMED`
    driven: bool  # bodies or coordinates move while all speeds are zero
    massless: bool  # M is singular: some free motion has no inertia
    varying_inertia: bool  # masses or central inertias change along the motion
    potentials_of_inputs: Indices  # indices of the loads whose potential depends on inputs
    rows_of_inputs: bool  # constraints depend on inputs; accelerations then depend on their rates
    chosen_by_user: bool
    kinks: Labels  # quantities that are not smooth, as sentences
    impossible: Labels  # bodies with moments of inertia that no distribution of mass has
    odd_grounds: Labels  # grounds of contacts whose motion contradicts the stated one
    faults: Labels  # impossible bodies and planes, contradictory constraints; as sentences
    without_inertia: Labels  # a free motion without inertia, as a sentence
    row_lengths: np.ndarray = field(compare=False, repr=False)  # typical, in scaled speeds
    plain_row_lengths: np.ndarray = field(compare=False, repr=False)  # in unscaled speeds
    times: np.ndarray = field(compare=False, repr=False)  # of the probed states on the geometric constraints
    coordinates: np.ndarray = field(compare=False, repr=False)  # of the same states; random ones first
    random: int  # number of random states
    closure_slopes: np.ndarray = field(compare=False, repr=False)  # G at the first random states
    row_slopes: np.ndarray = field(compare=False, repr=False)  # A at the same states

    @property
    def decisions(self) -> tuple:
        """Return the findings that decide how the scene is integrated; the others describe it."""
        of_rows = (
            self.row_names,
            self.rank,
            self.redundant_rows,
            self.may_set_in,
            self.affine,
            self.homogeneous,
            self.rows_of_inputs,
        )
        of_speeds = (
            self.independent,
            self.chosen_by_user,
            self.well_conditioned,
            self.typical_pivot >= WELL_CONDITIONED,
        )
        return (
            *of_rows,
            *of_speeds,
            self.timed,
            self.driven,
            self.massless,
            self.varying_inertia,
            self.potentials_of_inputs,
        )

    @property
    def rheonomic(self) -> bool:
        """Return whether any quantity of `TIMED` depends explicitly on time."""
        return bool(self.timed)

    @property
    def timed_kinematics(self) -> bool:
        """Return whether constraints, poses or coordinate rates depend explicitly on time."""
        return not {"rows", "poses", "coordinate rates"}.isdisjoint(self.timed)

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of independent speeds at generic states."""
        return len(self.independent)

    @property
    def kept_rows(self) -> Indices:
        """Return indices of the rows that are not redundant."""
        return tuple(s for s, name in enumerate(self.row_names) if name not in self.redundant_rows)

    @property
    def dependent_rows(self) -> bool:
        """Return whether the kept rows are dependent at generic states; each is needed at some
        other state.
        """
        return len(self.kept_rows) > self.rank

    @property
    def rows_may_contradict(self) -> bool:
        """Return whether constraints are redundant and not all linear and homogeneous in the speeds. The
        omitted constraints may then contradict the others.
        """
        return self.rank < len(self.row_names) and not (self.affine and self.homogeneous)

    @property
    def has_minimal_state(self) -> bool:
        """Return whether the integrated state is by default the coordinates and independent speeds."""
        return self.affine and self.well_conditioned

    @property
    def well_conditioned(self) -> bool:
        """Return whether the independent speeds are usable everywhere in the domain."""
        # in a chain of n rows that each couple two neighbours, `worst_pivot` falls as 1/n, although no pivot
        # of the chain does
        return not self.may_set_in and self.worst_pivot >= WELL_CONDITIONED * min(1.0, 24 / max(self.rank, 1))


def structure_of(scene: Scene) -> Structure:
    """Return static facts about a scene: rank of its constraints, independent speeds and their
    conditioning, kinds of constraints; eqs. (25)-(31).

    They are found once per class and parameter values, at random and symmetric states of the domain. Concrete
    numbers replace traced parameters. Raises ValueError if no admissible state is found, if bodies do not
    move smoothly, if a free motion has no inertia, or if `privileged` names unknown or too few speeds. For
    known parameters it is also raised by impossible numbers of bodies or planes, except for moments of
    inertia (`check_bodies`), and by contradictory constraints.
    """
    structure = structure_whatever_its_faults(scene)
    # findings at replaced parameters prove nothing about bodies and grounds
    of_numbers = structure.odd_grounds or structure.faults if is_judged(scene) else ()
    if wrong := structure.without_inertia or structure.kinks or of_numbers:
        raise ValueError(wrong[0])
    return structure


def check_bodies(scene: Scene) -> None:
    """Raise ValueError if a body of a known scene has moments of inertia that no distribution of mass has.
    Fits may pass such values, so `structure_of` accepts them.
    """
    impossible = structure_of(scene).impossible
    if impossible and is_judged(scene):
        raise ValueError(impossible[0])


def structure_whatever_its_faults(scene: Scene) -> Structure:
    """Return static facts about a scene, without errors for its faults."""
    return _structure(as_scene(scene))


def is_judged(scene: Scene) -> bool:
    """Return whether the parameters of a scene are known, so that findings at probed states apply to it."""
    return not is_traced(scene)


def trust(scene: Scene, varied: bool = False) -> float:
    """Return the weight of typical lengths: 1 for known parameters, 0.001 for traced or `varied` parameters,
    whose values may have another magnitude.
    """
    return 1.0 if is_judged(scene) and not varied else 1e-3


def plain_row_lengths(scene: Scene) -> Float[np.ndarray, "rows"]:
    """Return typical lengths of the rows of `A` in the units of the speeds."""
    return structure_whatever_its_faults(scene).plain_row_lengths * trust(scene)


def closure_lengths(scene: Scene) -> Float[np.ndarray, "closures"]:
    """Return typical lengths of the rows of G, with the unit norms of quaternions, for
    `project_positions`.
    """
    geometric = plain_row_lengths(scene)[: len(names_of_position_rows(scene))]
    return np.concatenate([geometric, np.full(len(scene.coordinates.quaternions), 1.0, geometric.dtype)])


def usual_rows(scene: Scene, varied: bool = False) -> UsualRows:
    """Return typical lengths of the rows in scaled speeds, and their rank at generic states. `varied`:
    whether `scene` is one sample of a batch, whose parameters differ.
    """
    known = structure_whatever_its_faults(scene)
    return UsualRows(known.row_lengths * trust(scene, varied), np.asarray(known.rank, np.int32))


@once_per_values
def _structure(scene: Scene) -> Structure:
    with np.errstate(all="ignore"):  # probes with NaN are ignored
        return _probed_structure(scene)


def _probed_structure(scene: Scene) -> Structure:
    names = names_of_rows(scene)
    count = len(scene.speed_names)
    for drawn in drawn_states(scene, RANDOM_PROBES, np.random.default_rng(0)):
        t, u, generic, found = at_probes(scene, *drawn)
        if (np.isfinite(found.error) & all_finite(found.A, axis=(1, 2)))[generic].any():
            break
    on_rows = usable_states(scene, found, generic)
    numbers = at_index(found.numbers, on_rows)
    rough = kinks(scene, found.q[on_rows & generic], u)
    grounds, bodies, faults = (sentences(scene, numbers, of) for of in ("grounds", "moments", "faults"))
    A = found.A * speed_scales(found.M)[:, None]
    usable = all_finite(A, axis=(1, 2)) & on_rows
    if not faults and not usable.any():
        finite = np.isfinite(A).all(axis=2)[on_rows].any(axis=0)
        named = (
            ", ".join(f"`{name}`" for name, good in zip(names, finite, strict=True) if not good) or "(all)"
        )
        faults = (
            (
                f"constraints {named} of `{type(scene).__name__}` are not finite at any probed state,"
                " expected numbers; check their computation"
            ),
        )
    if usable.any() and not usable[generic].any():
        raise no_numbers(scene, RANDOM_PROBES)  # symmetric states alone do not show the generic rank
    typical = typical_row_lengths(
        A[usable & generic], (found.A_beyond * speed_scales(found.M)[:, None])[generic]
    )
    beyond = found.A_beyond[generic]
    t, u, generic, found = at_index((t, u, generic, found), usable)
    scaled = scaled_states(found, typical)
    ranks = ranks_of(scaled.A, found.error)
    rank = max((r for r, is_generic in zip(ranks, generic, strict=True) if is_generic), default=0)
    # other faults, such as a negative mass, come first
    inert = () if faults else no_inertia(scene, at_index(scaled, generic & (np.array(ranks) == rank)))
    # at isolated losses of rank no partition has the generic size
    candidates = scaled.A[[r == rank for r in ranks]]
    by_user = scene.privileged
    if by_user is None:
        independent = best_privileged(candidates, count, rank)
    else:
        independent = named_speeds(scene, by_user, count - rank)
    dependent = [i for i in range(count) if i not in independent]
    pivots = pivots_at(candidates, dependent, rank)
    full_everywhere, eps, unproved = all(r == rank for r in ranks), float(eps_of(found.A)), found.unproved
    acts, at_rest = (
        lambda name: name in unproved or moves(found.vanishing[name]),
        found.vanishing["rows at rest"],
    )
    affine = "nonlinear" not in unproved and not exceeds(
        found.A - found.A_other, np.sqrt(eps), sizes(found)[..., None]
    )
    # a tolerance near round-off, because integrating zero work does less harm than omitting work
    homogeneous = "rows at rest" not in unproved and not exceeds(at_rest, 32 * eps, speed_terms(found, u))
    rows_of_inputs = acts("rows of inputs")
    # smaller numbers may be errors of tables and iterations
    asks_for_motion = exceeds(at_rest, np.sqrt(eps), speed_terms(found, u))
    if affine and asks_for_motion and not (faults or rows_of_inputs) and rank < len(names):
        asked = (at_rest / np.where(scaled.lengths > 0, scaled.lengths, 1))[generic]
        faults = contradictions(
            type(scene).__name__,
            names,
            scaled.A[generic],
            asked,
            [r for r, is_random in zip(ranks, generic, strict=True) if is_random],
        )
    # last, since the replacement of a traced direction must not hide another fault
    faults = faults or sentences(scene, found.numbers, "gravity")
    redundant = redundant_rows(
        scaled, found.error, ranks, generic, names, lambda: far_rows(scene, typical, *drawn)
    )
    return Structure(
        row_names=names,
        rank=rank,
        ranks=tuple(ranks),
        redundant_rows=redundant,
        may_set_in=(
            redundant
            if redundant
            and "rank" in unproved
            and not follow_from_others(scene, t, found.q, u, [names.index(name) for name in redundant])
            else ()
        ),
        rank_losses=tuple(_describe(scene, c) for c, r in zip(found.q, ranks, strict=True) if r < rank),
        independent=independent,
        worst_pivot=worst_pivot(candidates, dependent, rank, pivots) if full_everywhere else 0.0,
        typical_pivot=float(np.median(pivots)) if pivots.size else 1.0,
        affine=affine,
        homogeneous=homogeneous,
        timed=tuple(filter(acts, TIMED)),
        driven=acts("motion at rest"),
        massless=is_singular(scaled.M[generic]),
        varying_inertia=acts("inertia"),
        potentials_of_inputs=tuple(
            sorted(
                int(name.split()[1])
                for name in found.vanishing
                if name.startswith("potential ") and acts(name)
            )
        ),
        rows_of_inputs=rows_of_inputs,
        chosen_by_user=by_user is not None,
        kinks=rough,
        impossible=bodies,
        odd_grounds=grounds,
        faults=faults,
        without_inertia=inert,
        row_lengths=typical,
        plain_row_lengths=typical_row_lengths(found.A[generic], beyond),
        times=t,
        coordinates=found.q,
        random=int(np.sum(generic)),
        closure_slopes=found.G[generic][:4],
        row_slopes=found.A[generic][:4],
    )


def _describe(scene: Scene, q: np.ndarray) -> str:
    values = [
        f"{name} = {value:.4g}"
        for name, value in zip(scene.coordinate_names.entries, q, strict=True)
        if abs(value) > 1e-12
    ]
    return ", ".join(values) or "all coordinates zero"


class Reference:
    """A scene whose numbers replace traced parameters of its class; a static argument of compiled functions.

    Two references are equal if their scenes lead to the same decisions (`Structure.decisions`), and then
    share one program. The program of a call thus depends on its arguments, not on the order of calls. Numbers
    near the class's defaults replace parameters that are traced already.

    `varied`: names of parameters that differ within a batch (None: all). Numbers nearby replace them, so that
    numbers that are equal by coincidence have no effect.
    """

    def __init__(self, scene: Scene, varied: Iterable[str] | None = None):
        self.scene = with_reference_parameters(scene)
        self._varied = None if varied is None else frozenset(varied)
        decisions = structure_whatever_its_faults(self.scene).decisions
        self._key = jax.tree.structure(scene), self._varied, decisions, jax.config.jax_enable_x64

    @contextmanager
    def stands_in(self) -> Iterator[None]:
        """Return a context in which the values of this scene replace traced parameters."""
        with reference_parameters(self.scene, self._varied):
            yield

    def __hash__(self):
        return hash(self._key)

    def __eq__(self, other):
        return isinstance(other, Reference) and self._key == other._key
