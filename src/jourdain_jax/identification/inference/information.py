"""Information of measurements about the unknowns: covariance, and undetermined combinations.

    J_s = d r / d (theta / size)    an arrow of own unknowns x_i and shared ones s; r in units of sigma
    own        U S V' of a run's own columns; directions V_0 with S <= cutoff max(S) are undetermined
    shared     U S V' of the columns of s after projecting out those of all x_i
    rank       number of singular values above cutoff max(S)
    covariance of s          size V_1 S_1^-2 V_1' size                    over the determined directions V_1
               of x_i, x_j   delta_ij (T_i' T_i)^+ + G_i cov(s) G_j',     x_i = - G_i s for fitted own columns

An unknown that takes part in the undetermined directions V_0 has no standard error and no interval. It takes
part if it changes by sqrt(cutoff) of its size, or by a tenth of its standard error, when all unknowns change
along V_0 by about their sizes. Source: G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), sections
2.1 and 3.4; G. H. Golub and V. Pereyra, Inverse Problems 19 (2003) R1.

Numbers that depend on the estimates of a fit have estimates, standard errors and intervals to first order:

    y = f(scene),     var(y) = g' C g,     g = d y / d theta,     interval y -+ q sqrt(var(y))

C: covariance of the estimates; q: quantile. Such a number may be determined although the unknowns in it are
not: it has a standard error if g vanishes along undetermined directions. Source: C. R. Rao, Linear
Statistical Inference and Its Applications, 2nd ed. (1973), section 6a.2 (the delta method).

Poorly determined combinations of unknowns ("sloppy" directions):

    C_rel = C_ij / (size_i size_j),      C_rel v = s^2 v:      d theta_i/size_i = s v_i is one standard error

The size of an unknown is its magnitude; near zero, its typical change (`Range`). Source: R. N. Gutenkunst et
al., PLoS Computational Biology 3 (2007) e189.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import stdtrit

from jourdain_jax.calculus.reals import described, largest, real_type
from jourdain_jax.identification.solve.arrow import Arrow
from jourdain_jax.identification.solve.layout import Layout
from jourdain_jax.scene.coordinates import Labels, Sentences
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Information:
    """Covariance in blocks, and undetermined directions, given as changes of theta divided by the sizes of
    its entries. In a batch of fits all arrays have a leading axis `members`.
    """

    singular_values: Float[np.ndarray, "*members shared"]  # of the shared unknowns, largest first
    hidden: tuple[Float[np.ndarray, "_ unknowns"], ...]  # undetermined directions of each member, orthonormal
    # an unknown takes part in such a direction if theta / size changes by more than this along it
    least_part: Float[np.ndarray, "*members unknowns"]
    rank: Int[np.ndarray, "*members"]  # number of determined directions
    identifiable: Bool[np.ndarray, "*members unknowns"]
    standard_errors: Float[np.ndarray, "*members unknowns"]  # NaN if not identifiable
    shared: Float[np.ndarray, "*members shared shared"]
    own: Float[np.ndarray, "*members runs own own"]  # covariance if the shared unknowns are known
    follow: Float[np.ndarray, "*members runs own shared"]  # G
    estimated: Int[np.ndarray, "unknowns"]  # indices of the unknowns among the places of all runs

    @property
    def covariance(self) -> Float[np.ndarray, "*members unknowns unknowns"]:
        """Return the covariance of all unknowns, in their units; NaN if not identifiable."""
        both = self.identifiable[..., :, None] & self.identifiable[..., None, :]
        return np.where(both, self.whole_covariance, np.nan)

    @property
    def whole_covariance(self) -> Float[np.ndarray, "*members unknowns unknowns"]:
        """Return the covariance of all unknowns, in their units, along the determined directions."""
        runs, m, p = self.follow.shape[-3:]
        own = -self.follow.reshape(*self.follow.shape[:-3], runs * m, p)
        G = np.concatenate([np.broadcast_to(np.eye(p), (*self.shared.shape[:-2], p, p)), own], axis=-2)
        whole = G @ self.shared @ np.swapaxes(G, -1, -2)
        for i in range(runs):
            block = slice(p + i * m, p + (i + 1) * m)
            whole[..., block, block] += self.own[..., i, :, :]
        return whole[..., self.estimated[:, None], self.estimated]

    def only(self) -> "Information":
        """Return the values of the only member, without the axis of members."""
        of_one = {k: np.asarray(x[0]) for k, x in vars(self).items() if k not in ("hidden", "estimated")}
        return replace(self, **of_one)

    def between_runs(self, scores: Float[np.ndarray, "*members runs shared"]) -> "Information":
        """Return the information with the covariance of the shared unknowns from the differences between
        runs, `C (sum g g') C n / (n - 1)`. C is the previous covariance and g are the scores of the n runs.

        The runs' own unknowns follow the shared ones; the variance due to their own noise is kept. Source:
        K.-Y. Liang and S. L. Zeger, Biometrika 73 (1986) 13.
        """
        runs = scores.shape[-2]
        shared = self.shared @ (np.swapaxes(scores, -1, -2) @ scores) @ self.shared * runs / (runs - 1)
        variance = variances(shared, self.own, self.follow)[..., self.estimated]
        return replace(
            self, standard_errors=np.where(self.identifiable, np.sqrt(variance), np.nan), shared=shared
        )


def variances(
    shared: np.ndarray, own: np.ndarray, follow: np.ndarray
) -> Float[np.ndarray, "*members places"]:
    """Return variances of shared unknowns and of unknowns of runs, from the blocks of an `Information`."""
    of_own = np.diagonal(own, axis1=-2, axis2=-1) + np.einsum(
        "...kij,...jl,...kil->...ki", follow, shared, follow
    )
    return np.concatenate(
        [np.diagonal(shared, axis1=-2, axis2=-1), of_own.reshape(*of_own.shape[:-2], -1)], axis=-1
    )


def students_t_95(degrees):
    """Return the 97.5 % quantile of Student's t distribution, with the degrees of freedom limited to 1 to
    1e7.
    """
    return stdtrit(np.clip(degrees, 1.0, 1e7), 0.975)


def information(
    arrow: Arrow,
    size: Float[np.ndarray, "members places"],
    estimated: np.ndarray,
    bound,
    fails,
    cutoff: float,
) -> Information:
    """Return the information of an arrow in units of sigma.

    `size`: magnitude of each unknown, in its unit; `estimated`: indices of unknowns; `bound`: (members,
    indices), True for an unknown fixed at its bound; `fails`: (members,), True for a failed motion; `cutoff`:
    singular values below this fraction of the largest count as zero.
    """
    (runs, m, p), held = arrow.counts, np.ones(size.shape, bool)
    held[:, estimated] = bound[:, estimated]
    scaled = arrow.scaled(np.where(held, 0.0, size))
    U, S, Vt = np.linalg.svd(scaled.local[..., :m])  # (members, runs, m, m)
    shows, V = np.max(S, axis=2, keepdims=True, initial=0.0) * cutoff < S, np.swapaxes(Vt, 2, 3)
    inverse = np.where(shows, 1 / np.where(shows, S, 1.0), 0.0)[..., None]
    turned = np.swapaxes(U, 2, 3) @ scaled.local[..., m:-1]
    follow, own = V @ (inverse * turned), V @ (inverse**2 * Vt)  # G: x = - G s
    # remainder after the runs' own unknowns
    left = np.where(shows[..., None], 0.0, turned).reshape(len(size), runs * m, p)
    left = np.concatenate([left, scaled.shared[..., :-1]], axis=1)
    _, S_s, Vt_s = np.linalg.svd(left, full_matrices=left.shape[1] < p)
    S_s = np.pad(S_s, ((0, 0), (0, p - S_s.shape[1])))
    largest = np.max(S_s if p else S.reshape(len(size), -1), axis=1, initial=0.0)
    shows_s = cutoff * largest[:, None] < S_s
    squares = np.where(shows_s, 1 / np.where(shows_s, S_s, 1.0) ** 2, 0.0)
    covariance = np.swapaxes(Vt_s, 1, 2) @ (squares[..., None] * Vt_s)
    hidden = [
        _hidden_directions(Vt[b], shows[b], Vt_s[b, ~shows_s[b]], follow[b], held[b])
        for b in range(len(size))
    ]
    variance = variances(covariance, own, follow)
    least_part = np.minimum(np.sqrt(cutoff), np.sqrt(variance) * least_move(cutoff, largest)[:, None])
    has_part = np.stack([np.linalg.norm(rows, axis=0) for rows in hidden]) > least_part
    identifiable = (~has_part & ~bound & ~fails[:, None])[:, estimated]
    size_s, size_l = size[:, :p], size[:, p:].reshape(len(size), runs, m, 1)
    return Information(
        singular_values=S_s,
        hidden=tuple(rows[:, estimated] for rows in hidden),
        least_part=least_part[:, estimated],
        rank=np.where(fails, 0, np.sum(~held, axis=1) - [len(rows) for rows in hidden]),
        identifiable=identifiable,
        standard_errors=np.where(identifiable, (np.sqrt(variance) * size)[:, estimated], np.nan),
        shared=covariance * size_s[..., None] * size_s[:, None],
        own=own * size_l * np.swapaxes(size_l, 2, 3),
        follow=follow * size_l / size_s[:, None, None],
        estimated=estimated,
    )


def least_move(cutoff: float, largest):
    """Return the smallest change, in standard errors, by which an unknown takes part in an undetermined
    direction.

    Errors of J up to `cutoff * largest` rotate such a direction by this much; `largest`: the largest singular
    value.
    """
    # standard errors: an unknown that moves this far along an undetermined direction takes part in it
    return np.maximum(0.1, cutoff * largest)


def _hidden_directions(
    own: np.ndarray, shows: np.ndarray, shared: np.ndarray, follow: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Return orthonormal undetermined directions along which held unknowns do not change. `own`: V' of each
    run, possibly with determined directions.
    """
    (count, m, p), (runs, places) = follow.shape, np.nonzero(~shows)
    apart = np.zeros((len(runs), count, m))
    apart[range(len(runs)), runs] = own[runs, places]
    of_own = np.pad(apart.reshape(len(runs), count * m), ((0, 0), (p, 0)))
    of_shared = np.concatenate(
        [shared, -np.einsum("kij,nj->nki", follow, shared).reshape(len(shared), count * m)], axis=1
    )
    _, S, Vt = np.linalg.svd(np.where(held, 0.0, np.concatenate([of_own, of_shared])), full_matrices=False)
    return Vt[S > 1e-6]  # directions of held unknowns alone are excluded


def hidden_combinations(directions, least_part, size, values, labels: Labels) -> Sentences:
    """Return a sentence on each undetermined direction. `directions`: orthonormal rows of changes of theta,
    divided by the sizes of its entries; changes below `least_part` count as zero.

    In the chosen basis (row-reduced form), each direction contains one unknown that no other direction
    contains. Changes are relative, `d theta / theta`, for nonzero unknowns.
    """
    relative = np.abs(values) > 1e-3 * np.abs(size)
    basis = _reduced(np.asarray(directions), least_part) * size / np.where(relative, values, 1.0)
    basis = basis / np.max(np.abs(basis), axis=1, keepdims=True, initial=np.finfo(float).tiny)
    shared = np.count_nonzero(basis, axis=0) > 1
    return tuple(_in_words(row, relative, relative & ~shared, values, labels) for row in basis)


def _in_words(
    row: np.ndarray, relative: np.ndarray, power: np.ndarray, values: np.ndarray, labels: Labels
) -> str:
    """Return a sentence on the direction. `power`: whether an unknown may occur in a product of powers that
    is constant along all directions.
    """
    # tolerance of exponents to multiples of one half, and of equal changes
    involved, close = np.flatnonzero(row), 0.01
    if len(involved) == 1:
        return f"no channel depends on `{labels[involved[0]]}`"
    names = " and ".join(f"`{labels[i]}`" for i in involved)
    changes = " : ".join(f"d {labels[i]}/{labels[i]}" if relative[i] else f"d {labels[i]}" for i in involved)
    text = (
        f"{names} are not determined separately: no channel changes along {changes} = "
        f"{' : '.join(f'{row[i]:.3g}' for i in involved)}"
    )
    own, *others = involved
    exponents = -row[others] / row[own]
    if power[involved].all() and np.all(np.abs(exponents - np.round(2 * exponents) / 2) < close):
        of_own = ["" if abs(e - 1) < close else f"^{e:.3g}" for e in exponents]
        return (
            f"{text}; the data determine only "
            f"{', '.join(f'{labels[i]} {labels[own]}{e}' for i, e in zip(others, of_own, strict=True))}"
        )
    moved = np.where(relative, row * values, row)[involved]
    if len(involved) == 2 and abs(abs(moved[0]) - abs(moved[1])) < close * abs(moved[0]):
        return f"{text}; the data determine only their {'difference' if moved[0] * moved[1] > 0 else 'sum'}"
    return text


def _reduced(rows: np.ndarray, least_part) -> np.ndarray:
    """Return the reduced row-echelon form, computed with the largest pivots. Entries below `least_part` of
    rows of unit length are noise and become zero.
    """
    rows, free = rows.copy(), list(range(len(rows)))
    for _ in range(len(rows)):
        i, k = max(
            ((i, k) for i in free for k in range(rows.shape[1])), key=lambda place: round(abs(rows[place]), 6)
        )
        rows[i] /= rows[i, k]
        others = [j for j in range(len(rows)) if j != i]
        rows[others] -= np.outer(rows[others, k], rows[i])
        free.remove(i)
    return np.where(np.abs(rows) > least_part * np.linalg.norm(rows, axis=1, keepdims=True), rows, 0.0)


def derived(
    scene: Scene,
    layout: Layout,
    function: Callable[[Scene], Array],
    shared: Float[np.ndarray, "*repeats shared"],
):
    """Return y and its derivatives with respect to the shared unknowns, for one fit or each fit of a batch.
    Raises ValueError unless the function returns numbers.
    """

    def of(shared):
        value = function(layout.scene(scene, shared))
        try:
            return jnp.asarray(value, real_type())
        except (TypeError, ValueError):
            raise ValueError(
                f"the function returns {described(value)}, expected a number or an array of numbers"
            ) from None

    def with_slopes(shared):
        return of(shared), jax.jacfwd(of)(shared)

    for _ in shared.shape[:-1]:
        with_slopes = jax.vmap(with_slopes)
    value, slopes = with_slopes(jnp.asarray(shared))
    return np.asarray(value), np.asarray(slopes)


def standard_errors(
    known: Information,
    slopes: Float[np.ndarray, "*numbers shared"],
    sizes: Float[np.ndarray, "*repeats shared"],
    at_bound: Bool[np.ndarray, "*repeats shared"],
    cutoff: float,
) -> Float[np.ndarray, "*numbers"]:
    """Return standard errors of numbers with these derivatives. Derivatives and results have a leading axis
    of repeats if the information has one.

    The result is NaN for a number that depends on an undetermined direction or on an unknown at a bound.
    """
    shared = slopes.shape[-1]
    parts = (
        known.whole_covariance[..., :shared, :shared],
        np.max(known.singular_values, axis=-1, initial=0.0),
        known.rank,
        slopes,
        sizes,
        at_bound,
    )

    def of_one(hidden, C, largest, rank, slopes, sizes, at_bound):
        error = np.sqrt(np.einsum("...i,ij,...j->...", slopes, C, slopes))
        scaled = slopes * sizes  # with respect to theta / size
        part = np.linalg.norm(scaled @ hidden[:, :shared].T, axis=-1)
        most = np.minimum(
            np.sqrt(cutoff) * np.linalg.norm(scaled, axis=-1), error * least_move(cutoff, largest)
        )
        lost = np.any((slopes != 0) & (at_bound | (rank == 0)), axis=-1)
        return np.where((part <= most) & ~lost, error, np.nan)

    if sizes.ndim == 1:
        return of_one(known.hidden[0], *parts)
    return np.stack([of_one(*one) for one in zip(known.hidden, *parts, strict=True)])


def weak_combinations(
    covariance: Float[np.ndarray, "unknowns unknowns"],
    values: Float[np.ndarray, "unknowns"],
    sizes: Float[np.ndarray, "unknowns"],
    labels: Labels,
) -> Labels:
    """Return directions with a relative standard error of at least 0.1, weakest first, one sentence each.
    Only shared unknowns are examined, if there are any.
    """
    some = np.flatnonzero(np.isfinite(np.diagonal(covariance)))[:400]  # examined unknowns
    shared = [i for i in some if not labels[i].startswith("run ")]
    some = np.array(shared) if shared else some
    scale = np.abs(sizes[some])
    is_relative = np.abs(values[some]) > 1e-3 * scale
    squares, directions = np.linalg.eigh(covariance[np.ix_(some, some)] / (scale * scale[:, None]))
    found = []
    for k in range(some.size)[::-1]:
        spread = float(np.sqrt(max(squares[k], 0.0)))
        if spread < 0.1:
            break
        change = (
            spread * directions[:, k] * scale / np.where(is_relative, np.abs(values[some]), 1.0)
        )  # d theta / |theta|, or d theta
        # relative to the largest entry of a direction: smaller ones are omitted
        parts = np.flatnonzero(np.abs(directions[:, k]) > 0.1 * largest(directions[:, k]))
        parts = parts[np.argsort(-np.abs(directions[parts, k]))]
        *others, last = [
            _by(labels[some[i]], change[i] * np.sign(change[parts[0]]), bool(is_relative[i])) for i in parts
        ]
        if others:
            said = "together are one standard error: the data determine this combination poorly"
            found.append(f"{', '.join(others)} and {last} {said}")
        else:
            found.append(f"{last} is one standard error: the data determine it poorly")
    return tuple(found)


def _by(name: str, change: float, is_relative: bool) -> str:
    if is_relative and abs(change) < 0.995:
        how = f"{100 * change:.2g} %"
    else:
        how = f"{change:.2g}{' times its value' if is_relative else ''}"
    return f"a change of `{name}` by {how}"
