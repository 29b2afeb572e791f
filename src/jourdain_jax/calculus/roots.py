"""Roots of residuals: Newton's method, damped least squares, fixed-point iteration, and Gauss-Newton in NumPy
at many states at once.

    newton_root      F(x, theta) = 0   =>   dx = - (dF/dx)^-1 (dF/dtheta) dtheta
    damped_search    min |f(x)|^2:     x <- x - J' (J J' + damping)^-1 f,         J = df/dx
    fixed_point      x <- step(a, x):  D <- d step/da + d step/dx D,              D = dx/d(a, x_0)
    nearest_root     g(x) = 0:         x <- x - G+ g(x),                          G = dg/dx

`newton_root` is differentiated by `jax.lax.custom_root`, which linearises F once, at the root. Derivatives of
any order, in either mode, cost one linear solve each. `damped_search` (J. Nocedal and S. Wright, Numerical
Optimization (2006), section 10.3) has no derivative: differentiate at the root. Under `vmap` it runs until
the last sample has converged.

`fixed_point` computes x together with D for the entries of a and x_0 that vary, so both modes of
differentiation run one loop. If the iteration converges quadratically, each further step doubles the order of
correct derivatives; two steps without change give derivatives up to the third. Once all samples have settled,
the remaining steps are skipped, even under `vmap`.

`nearest_root` treats rows as dependent if the triangular factor of the scaled rows has a small diagonal. In
that case it drops small singular values.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import Count, Flag, PerRow, Scalar, all_finite, eps_of, largest, tiny_of

Unknowns = Float[Array, "unknowns"]


class Root(eqx.Module):
    """The last iterate, and whether it is a root."""

    x: Unknowns
    converged: Flag


def newton_root(residual: Callable, guess: Unknowns, scale: Unknowns) -> Root:
    """Return x with `residual(x) = 0` near `guess`; `residual` may close over traced numbers.

    `scale`: size of each unknown; infinite for an unknown to ignore. The iteration stops when the corrections
    no longer shrink. It has converged if they are then at most `eps^0.6` times the sizes.
    """

    eps = eps_of(guess)

    def solve(f, x0):
        def running(carry):
            _, _, settled, k = carry
            return ~settled & (k < 20)

        def iterate(carry):
            x, size, _, k = carry
            value, derivative = jax.linearize(f, x)
            dx = jnp.linalg.solve(_matrix(derivative, x), value)
            new_size = jnp.max(jnp.abs(dx) / scale, initial=0.0)
            at_round_off = new_size <= 4.0 * eps  # units of round-off
            # a correction that no longer shrinks tenfold has reached round-off
            stalled = (new_size <= eps**0.6) & (new_size > 0.1 * size)
            return x - dx, new_size, at_round_off | stalled | ~jnp.isfinite(new_size), k + 1

        start = (x0, jnp.asarray(jnp.inf, x0.dtype), jnp.array(False), jnp.array(0, jnp.int32))
        x, size, _, _ = jax.lax.while_loop(running, iterate, start)
        return x, (size <= eps**0.6).astype(x0.dtype)

    x, converged = jax.lax.custom_root(
        residual,
        jax.lax.stop_gradient(guess),
        solve,
        lambda f, y: jnp.linalg.solve(_matrix(f, y), y),
        has_aux=True,
    )
    return Root(x, converged > 0)


def _matrix(linear: Callable, like) -> Float[Array, "unknowns unknowns"]:
    """Return the matrix of a linear function, column by column."""
    return jax.vmap(linear, in_axes=1, out_axes=1)(jnp.eye(like.shape[0], dtype=like.dtype))


class Nearest(eqx.Module):
    """The end point of a search, and the residual there."""

    x: Unknowns
    left: Scalar  # largest residual


class Search(eqx.Module):
    """Best point so far, and the next trial point."""

    trial: Unknowns
    best: Unknowns
    f: PerRow  # residuals at the best point, and their Jacobian
    J: Float[Array, "rows unknowns"]
    damping: Scalar
    steps: Count
    going: Flag

    @property
    def left(self) -> Scalar:
        """Return the largest residual at the best point."""
        left = largest(self.f)
        return jnp.where(jnp.isfinite(left), left, jnp.inf)


def damped_search(
    rows: Callable, guess: Unknowns, size: Unknowns, tolerance: float, low=-np.inf, high=np.inf, most_steps=80
) -> Search:
    """Search from `guess`, between `low` and `high`, for x whose residuals f are at most `tolerance`. Return
    the best x, its f, and J in units of `size`.

    `rows`: function from x to f and `J = df/dx`. `size`: unit of the steps of each unknown, zero for a fixed
    one. Scale f so that a change of an unknown by its size changes f by about one.
    """

    def look(x):
        f, J = rows(x)
        return f, J * size  # per unit of size

    def once(search: Search) -> Search:
        f, J = look(search.trial)
        # never accept a Jacobian that is not finite
        better = (f @ f < search.f @ search.f) & jnp.all(jnp.isfinite(J))
        best, f, J = (
            jnp.where(better, a, b) for a, b in ((search.trial, search.best), (f, search.f), (J, search.J))
        )
        damping = jnp.clip(jnp.where(better, search.damping / 6, search.damping * 5), 1e-14, 1e8)
        step = -J.T @ jnp.linalg.solve(J @ J.T + damping * jnp.eye(f.shape[0], dtype=f.dtype), f)
        # limit a step to a quarter of the size of the unknowns
        step = step * jnp.minimum(1.0, 0.25 / jnp.maximum(largest(step), tiny_of(f)))
        # at a damping of 1e7 no step reduces the residuals
        going = (
            (largest(f) > tolerance)
            & (damping < 1e7)
            & (search.steps < most_steps)
            & jnp.all(jnp.isfinite(f))
        )
        return Search(jnp.clip(best + size * step, low, high), best, f, J, damping, search.steps + 1, going)

    f, J = jax.eval_shape(look, guess)
    unknown = jnp.full(f.shape, jnp.inf, f.dtype), jnp.zeros(J.shape, J.dtype)
    start = Search(
        guess, guess, *unknown, jnp.full((), 6e-2, f.dtype), jnp.zeros((), jnp.int32), jnp.array(True)
    )
    return jax.lax.while_loop(lambda search: search.going, once, start)


def smooth_root(
    look: Callable, rows: Callable, guess: Unknowns, x, size, tolerance, cutoff: float, most_steps=80
) -> Unknowns:
    """Return the root near a guess, differentiable up to the third order. A search without derivatives
    is followed by three steps `x <- x - J+ R(x)` with constant J; each makes one more order of
    derivatives correct.

    `look`: function from x to residuals R and Jacobian J, without derivatives; `rows`: function from x to R;
    `x`: values of the fixed unknowns (size zero), with their derivatives; `cutoff`: relative cutoff of J+.
    Other arguments as for `damped_search`.
    """
    found = jax.lax.stop_gradient(
        damped_search(look, jax.lax.stop_gradient(guess), size, tolerance, most_steps=most_steps)
    )
    inverse = size[:, None] * pseudo_inverse(found.J, cutoff)
    return jax.lax.scan(
        lambda x, _: (x - inverse @ rows(x), None), jnp.where(size > 0, found.best, x), length=3
    )[0]


def first_root(
    rows: Callable, guesses: Float[Array, "guesses unknowns"], size, tolerance: float, good: float, *bounds
) -> tuple[Nearest, Count]:
    """Return the root from the first of the `guesses` that leads to one, and the index of this guess. If none
    does, return the end point with the smallest residuals.

    A root has residuals of at most `good`. Other arguments, including the `bounds`, as for `damped_search`.
    """
    count = guesses.shape[0]
    # limit of Jacobian entries in memory per sample: all guesses at once of 96 trailers, in 17 samples,
    # took 57 GB
    block = max(1, min(count, 50_000 // max(1, jax.eval_shape(rows, guesses[0])[1].size)))
    blocks = -(-count // block)
    # the last guess fills the last block
    places = np.minimum(np.arange(blocks * block), count - 1).reshape(blocks, block)

    def next_block(carried):
        k, best, number = carried
        found = jax.vmap(lambda guess: damped_search(rows, guess, size, tolerance, *bounds))(
            guesses[jnp.asarray(places)[k]]
        )
        left = jax.vmap(lambda search: search.left)(found)
        which = jnp.where(jnp.any(left <= good), jnp.argmax(left <= good), jnp.argmin(left)).astype(jnp.int32)
        better = (k == 0) | (left[which] < best.left)
        chosen = (Nearest(found.best[which], left[which]), jnp.asarray(places, jnp.int32)[k, which])
        return k + 1, *jax.tree.map(lambda new, old: jnp.where(better, new, old), chosen, (best, number))

    nothing = Nearest(guesses[0], jnp.full((), jnp.inf, guesses.dtype)), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(
        lambda carried: (carried[0] < blocks) & ~(carried[1].left <= good),
        next_block,
        (jnp.zeros((), jnp.int32), *nothing),
    )[1:]


QUIET = 2  # numerics: number of steps without change after which the iteration has settled
ROUND_OFF = 1e3  # numerics: a change is larger than this many eps, relative to 1 + |x|


def fixed_point(
    step: Callable, a: Any, x: Float[Array, "entries"], most: int, prepare: Callable | None = None
) -> Float[Array, "entries"]:
    """Return x after at most `most` steps of `x <- step(a, x)`; a NaN counts as settled.

    `prepare`: function from a to the argument of the steps, a pair whose second part is not differentiated.
    """
    return _iterated((a, x), step=step, most=most, prepare=prepare)


@eqx.filter_custom_jvp
def _iterated(of: tuple, *, step: Callable, most: int, prepare: Callable | None):
    a, x = of
    given = a if prepare is None else prepare(a)
    return _loop(lambda carry: (step(given, carry[0]),), (x,), most)[0]


@_iterated.def_jvp
@with_usual_promotion
def _iterated_jvp(primals, tangents, *, step, most, prepare):
    (of,), (along,) = primals, tangents
    (moving, _), (fixed, _) = moves, _ = eqx.partition(
        of, jax.tree.map(lambda d: d is not None, along, is_leaf=lambda d: d is None)
    )
    flat, restored = ravel_pytree(moves)
    units, first = jax.vmap(restored)(jnp.eye(flat.size, dtype=flat.dtype))
    D = jnp.zeros((flat.size, *of[1].shape), of[1].dtype) if first is None else first
    along_each = partial(jax.vmap, axis_size=flat.size)
    if prepare is None:
        at, dat, taken = moving, units, lambda at: eqx.combine(at, fixed)
    else:
        of_units = along_each(
            lambda da: jax.jvp(lambda a: prepare(eqx.combine(a, fixed)), (moving,), (da,), has_aux=True),
            out_axes=(None, 0, None),
        )
        at, dat, rest = of_units(units)
        taken = lambda at: (at, rest)

    def both(carry):
        x, D = carry
        return along_each(
            lambda da, dx: jax.jvp(lambda a, x: step(taken(a), x), (at, x), (da, dx)), out_axes=(None, 0)
        )(dat, D)

    x, D = _loop(both, (of[1], D), most)
    return x, ravel_pytree(along)[0] @ D


def _loop(step: Callable, carry: tuple, most: int) -> tuple:
    """Iterate `step` on a tuple at most `most` times, or until its first entry no longer changes."""
    if most <= QUIET:
        return jax.lax.scan(lambda carry, _: (step(carry), None), carry, length=most)[0]

    def once(state, _):
        carry, quiet = state
        going = quiet < QUIET
        new = jax.lax.cond(eqxi.unvmap_any(going), step, lambda carry: carry, carry)
        old_value, value = jax.lax.stop_gradient((carry[0], new[0]))
        changed = jnp.any(jnp.abs(value - old_value) > ROUND_OFF * eps_of(value) * (1 + jnp.abs(old_value)))
        kept = tuple(jnp.where(going, *pair) for pair in zip(new, carry, strict=True))
        return (kept, jnp.where(going & changed, 0, jnp.minimum(quiet + 1, QUIET))), None

    return jax.lax.scan(once, (carry, jnp.zeros((), jnp.int32)), length=most)[0][0]


# x of some states and their indices -> g, G in the form that `solve` takes
Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def nearest_root(
    look: Look,
    solve: Callable,
    x: np.ndarray,
    *,
    most: int = 25,
    longest: np.ndarray | float = np.inf,
    within: tuple = (-np.inf, np.inf),
) -> tuple[np.ndarray, np.ndarray]:
    """Return x with g(x) = 0 near the given x, (states, unknowns), and the last corrections relative to
    1 + |x|, which are infinite for NaN.

    `look`: function from x and state indices to g and G. `solve`: function from G and g to the shortest d
    with `G d = g`. No entry of a step exceeds `longest`, and x stays within the bounds `within`.
    """
    x, last, moving = np.array(x, float), np.full(len(x), np.inf), np.arange(len(x))
    for _ in range(most):
        g, G = look(x[moving], moving)
        step = solve(G, g)
        size = largest(step, 1)
        moves = np.isfinite(size)
        last[moving[~moves]] = np.inf
        step, size, moving = step[moves], size[moves], moving[moves]
        shorter = np.maximum(1.0, np.max(np.abs(step) / longest, axis=1, keepdims=True, initial=0.0))
        x[moving] = np.clip(x[moving] - step / shorter, *within)
        last[moving] = size / (1 + largest(x[moving], 1))
        moving = moving[last[moving] > 4 * np.finfo(float).eps]
        if not moving.size:
            break
    return x, last


def shortest(G: np.ndarray, g: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the shortest d with `G d = g` at every state. If rows are nearly dependent, or shorter than
    `typical`, return a least-squares solution.
    """
    return (pseudo_inverses(G, typical) @ g[..., None])[..., 0]


def pseudo_inverses(G: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
    """Return G+ at every state, NaN where G is NaN. Rows are first scaled to unit length; rows shorter than
    `typical` are scaled to less.
    """
    lengths = np.maximum(np.linalg.norm(G, axis=2), typical)
    d = 1 / np.where(lengths > 0, lengths, 1.0)
    found, finite = np.full(np.swapaxes(G, 1, 2).shape, np.nan), all_finite(G, axis=(1, 2))
    scaled = d[..., None] * G
    places = np.flatnonzero(finite)
    if G.shape[1] <= G.shape[2]:
        Q, R = np.linalg.qr(np.swapaxes(scaled[finite], 1, 2))  # D G = R' Q'
        # with a smaller diagonal, decide by singular values
        regular = np.min(np.abs(np.diagonal(R, axis1=1, axis2=2)), axis=1, initial=1.0) > 1e-6
        found[places[regular]] = Q[regular] @ np.swapaxes(np.linalg.inv(R[regular]), 1, 2)
        places = places[~regular]
    for k in places:
        found[k] = _by_singular_values(scaled[k])
    return found * d[:, None]


def _by_singular_values(G: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.pinv(G, rcond=1e-9)
    except np.linalg.LinAlgError:  # entries too far apart for a decomposition
        return np.full(G.shape[::-1], np.nan)
