"""Levenberg-Marquardt from one guess, or from several: a root of rows that Newton's method runs away from, where there is one near enough.

    min |f(x)|^2:   x <- x - J' (J J' + damping)^-1 f,   J = df/dx

No derivative passes through: take it at the root (`calculus/fixed_point.py`). Runs under `jit` and `vmap`, where all lanes go on until the last has ended.
Source: J. Nocedal and S. Wright, Numerical Optimization (2006), section 10.3.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Nearest(eqx.Module):
    """Where a search ended, and what is left of the rows there."""

    x: Float[Array, "unknowns"]
    left: Float[Array, ""]  # largest of the rows


class Search(eqx.Module):
    """The best point so far, and the next to try."""

    trial: Float[Array, "unknowns"]
    best: Float[Array, "unknowns"]
    f: Float[Array, "rows"]  # at the best, and their slopes
    J: Float[Array, "rows unknowns"]
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    going: Bool[Array, ""]

    @property
    def left(self) -> Float[Array, ""]:
        """The largest of the rows at the best point."""
        left = jnp.max(jnp.abs(self.f), initial=0.0)
        return jnp.where(jnp.isfinite(left), left, jnp.inf)


def damped_search(
    rows: Callable, guess: Float[Array, "unknowns"], size: Float[Array, "unknowns"], tolerance: float, low=-np.inf, high=np.inf, most_steps=80
) -> Search:
    """Search for x near `guess` from `low` to `high` at which no row exceeds the `tolerance`; it ends where they are smallest. J is per size of an unknown.

    `rows`: x -> f and J. `size`: of each unknown, by which steps are measured; zero for one that is held. Rows should be of order one where unknowns change
    by their size.
    """

    def look(x):
        f, J = rows(x)
        return f, J * size  # per unit of size

    def once(search: Search) -> Search:
        f, J = look(search.trial)
        better = (f @ f < search.f @ search.f) & jnp.all(jnp.isfinite(J))  # never where it is not a number
        best, f, J = (jnp.where(better, a, b) for a, b in ((search.trial, search.best), (f, search.f), (J, search.J)))
        damping = jnp.clip(jnp.where(better, search.damping / 6, search.damping * 5), 1e-14, 1e8)
        step = -J.T @ jnp.linalg.solve(J @ J.T + damping * jnp.eye(f.shape[0], dtype=f.dtype), f)
        # at most a quarter of the size of the unknowns in one step
        step = step * jnp.minimum(1.0, 0.25 / jnp.maximum(jnp.max(jnp.abs(step), initial=0.0), jnp.finfo(f.dtype).tiny))
        # a damping of 1e7: no step makes the rows smaller
        going = (jnp.max(jnp.abs(f), initial=0.0) > tolerance) & (damping < 1e7) & (search.steps < most_steps) & jnp.all(jnp.isfinite(f))
        return Search(jnp.clip(best + size * step, low, high), best, f, J, damping, search.steps + 1, going)

    f, J = jax.eval_shape(look, guess)
    unknown = jnp.full(f.shape, jnp.inf, f.dtype), jnp.zeros(J.shape, J.dtype)
    start = Search(guess, guess, *unknown, jnp.full((), 6e-2, f.dtype), jnp.zeros((), jnp.int32), jnp.array(True))
    return jax.lax.while_loop(lambda search: search.going, once, start)


def first_root(rows: Callable, guesses: Float[Array, "guesses unknowns"], size, tolerance: float, good: float, *bounds) -> tuple[Nearest, Int[Array, ""]]:
    """The root that is found from the first of the `guesses` that leads to one, and its number; where none does, what comes nearest.

    A root leaves at most `good`; all else, also the `bounds`, is as for `damped_search`.
    """
    count = guesses.shape[0]
    # 50_000 slopes are held at once, for each lane: of 96 trailers those of all guesses and 17 lanes took 57 GB
    block = max(1, min(count, 50_000 // max(1, jax.eval_shape(rows, guesses[0])[1].size)))
    blocks = -(-count // block)
    places = np.minimum(np.arange(blocks * block), count - 1).reshape(blocks, block)  # the last one may stand there several times

    def next_block(carried):
        k, best, number = carried
        found = jax.vmap(lambda guess: damped_search(rows, guess, size, tolerance, *bounds))(guesses[jnp.asarray(places)[k]])
        left = jax.vmap(lambda search: search.left)(found)
        which = jnp.where(jnp.any(left <= good), jnp.argmax(left <= good), jnp.argmin(left)).astype(jnp.int32)
        better = (k == 0) | (left[which] < best.left)
        chosen = (Nearest(found.best[which], left[which]), jnp.asarray(places, jnp.int32)[k, which])
        return k + 1, *jax.tree.map(lambda new, old: jnp.where(better, new, old), chosen, (best, number))

    nothing = Nearest(guesses[0], jnp.full((), jnp.inf, guesses.dtype)), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(lambda carried: (carried[0] < blocks) & ~(carried[1].left <= good), next_block, (jnp.zeros((), jnp.int32), *nothing))[1:]
