"""Levenberg-Marquardt in the program that evaluates all runs: the steps of `levenberg_marquardt`, until one may be the last or would pass a bound.

From one motion of a short run to the next, calls of compiled code and of NumPy take longer than the motion itself (a disc: four times as long). `minimise`
goes on from where these end, by the same rules. The damped step is

    d = - D^-1 V (S^2 + lambda)^-1 V' D^-1 g,      D^-1 J'J D^-1 = V S^2 V'        where S is not far from singular

The noise is white, and its sigmas are known.
"""

from collections.abc import Callable
from itertools import accumulate, pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.levenberg_marquardt import LEAST_COLUMN
from jourdain_jax.analysis.losses import LEAST_SQUARES, Loss
from jourdain_jax.analysis.pace import BEGIN, LEAST, MOST, SLOW, SURELY, after_trial, shrinkage

ROOM = 64  # for steps
WEAK = 1e-4  # of the largest singular value: what J'J tells to eight digits


class Told(NamedTuple):
    """What steps go by, in one vector; unknowns in the order of the columns of J."""

    most: Float[Array, ""]  # steps; zero: residuals are evaluated and nothing else
    tolerance: Float[Array, ""]
    cutoff: Float[Array, ""]
    patience: Float[Array, ""]
    near: Float[Array, ""]
    low: Float[Array, "unknowns"]
    high: Float[Array, "unknowns"]
    least: Float[Array, "unknowns"]  # size of what is near zero
    mean: Float[Array, "unknowns"]  # of priors
    weight: Float[Array, "unknowns"]  # 1 / sigma of these; zero: there is none
    counts: Float[Array, "samples"]  # which samples do

    @staticmethod
    def of(vector, unknowns: int) -> "Told":
        """The numbers that such a vector holds."""
        each = vector[5 : 5 + 5 * unknowns].reshape(5, unknowns)
        return Told(*(vector[k] for k in range(5)), *(each[k] for k in range(5)), counts=vector[5 + 5 * unknowns :])

    @staticmethod
    def length(unknowns: int, samples: int) -> int:
        """The length of such a vector."""
        return 5 + 5 * unknowns + samples


class _At(NamedTuple):
    """Where the steps are, and the next one; in one vector, since XLA copies and compiles each array of a loop by itself."""

    pace: Float[Array, "5"]  # damping, growth, fall; lengths |J d| of the last two steps, NaN where none was taken
    x: Float[Array, "unknowns"]
    products: Float[Array, "width width"]  # [J r]'[J r] there, with priors
    d: Float[Array, "unknowns"]
    costs: Float[Array, "_"]  # F at first and after each step
    cost: Float[Array, ""]  # F there
    steps: Float[Array, ""]  # tried; below zero: x itself is to be evaluated
    promised: Float[Array, ""]
    slope: Float[Array, ""]  # of F along the step
    length: Float[Array, ""]  # |J d|
    converged: Float[Array, ""]
    foretold: Float[Array, ""]  # whether the step is the last, whose end is known without evaluation
    goes: Float[Array, ""]  # whether it is tried

    def vector(self) -> Float[Array, "_"]:
        """All in one."""
        return jnp.concatenate([jnp.ravel(x) for x in self])

    @staticmethod
    def of(vector, n: int) -> "_At":
        """The numbers that such a vector of NumPy or of JAX holds, for n unknowns."""
        ends = [*accumulate((0, 5, n, (n + 1) ** 2, n, ROOM + 1))]
        pace, x, products, d, costs = (vector[begin:end] for begin, end in pairwise(ends))
        return _At(pace, x, products.reshape(n + 1, n + 1), d, costs, *(vector[ends[-1] + k] for k in range(8)))

    @staticmethod
    def room(n: int) -> int:
        """Length of such a vector."""
        return 14 + ROOM + 2 * n + (n + 1) ** 2


def first_steps(evaluate: Callable, loss: Loss, x: Float[Array, "unknowns"], known: tuple[Array, ...], told: Float[Array, "_"]) -> Float[Array, "_"]:
    """Takes the steps from x; where they end, in one vector (see `read`). `evaluate`: [J r] of unknowns and what is `known`, (samples, unknowns + 1)."""
    n, places = x.shape[0], np.arange(ROOM + 1.0)

    def tried(now: tuple[Array, Array]) -> tuple[Array, Array]:
        # XLA would take what depends on these alone out of the loop. Of many small operations that wait, it hands some to other threads, which costs more.
        vector, numbers, others = jax.lax.optimization_barrier((now[0], told, known))
        old, of = _At.of(vector, n), Told.of(numbers, n)
        x = old.x + old.d
        rows = evaluate(x, *others)
        of_priors = jnp.concatenate([of.weight[:, None] * np.eye(n), (of.weight * (x - of.mean))[:, None]], axis=1)
        counted = jnp.where(of.counts[:, None] > 0, rows, 0.0)
        whole = jnp.concatenate([loss.weighted(counted, counted[:, -1], jnp), of_priors])
        products = whole.T @ whole
        cost = loss.value(counted[:, -1], jnp) + LEAST_SQUARES.value(of_priors[:, -1], jnp)
        cost, before = jnp.where(jnp.isfinite(jnp.sum(products)), cost, jnp.inf), old.cost
        by_slopes = -0.5 * (old.slope + products[:-1, -1] @ old.d)
        taken, pace = after_trial(jnp, old.pace, old.length, before, cost, old.promised, by_slopes, of.tolerance)
        first = old.steps < 0
        taken, pace, steps = first | taken, jnp.where(first, old.pace, pace), old.steps + 1
        cost = jnp.where(taken, cost, before)
        costs = jnp.where(places == steps, cost, old.costs)
        at = jnp.where(taken, jnp.concatenate([x, products.ravel()]), jnp.concatenate([old.x, old.products.ravel()]))
        x, products = at[:n], at[n:].reshape(n + 1, n + 1)
        earlier = jnp.sum(jnp.where(places == steps - of.patience, costs, 0.0))
        slow = (steps >= of.patience) & (cost > jnp.maximum(of.near, SLOW * earlier))

        # the next step
        A, gradient, size = products[:-1, :-1], products[:-1, -1], jnp.maximum(jnp.abs(x), of.least)
        norms = jnp.sqrt(jnp.sum(A * np.eye(n), axis=0))
        V, squares = jax.lax.linalg.eigh(A / (norms * norms[:, None]), symmetrize_input=False)
        dampings = jnp.stack([pace[0], jnp.full_like(pace[0], LEAST)])
        both = -((((gradient / norms) @ V) / (squares + dampings[:, None])) @ V.T) / norms  # the step, and the undamped one
        lengths, moves = jnp.sqrt(jnp.sum((both @ A) * both, axis=1)), jnp.max(jnp.abs(both) / size, axis=1)
        small = (lengths <= of.tolerance) & (moves <= of.tolerance)
        inside = jnp.all((x + both >= of.low) & (x + both <= of.high) & (x > of.low) & (x < of.high), axis=1)
        d, length, slope = both[0], lengths[0], gradient @ both[0]
        shrinks = shrinkage(jnp, pace, length)
        sure = (shrinks < 1) & (length * shrinks <= SURELY * of.tolerance) & (moves[0] * shrinks <= SURELY * of.tolerance)
        usual = (norms * size > LEAST_COLUMN * jnp.max(norms * size)) & (squares > jnp.maximum(WEAK, of.cutoff) ** 2 * squares[-1])
        may = (steps < of.most) & ~slow & inside[0] & (pace[0] <= MOST) & jnp.isfinite(length) & jnp.all(usual)
        done = small[0] & ((pace[0] <= LEAST) | (small[1] & inside[1]))
        ends = may & jnp.stack([done | sure, ~done & sure, ~done & ~sure])
        at = _At(pace, x, products, d, costs, cost, steps, -slope - 0.5 * length**2, slope, length, *ends.astype(x.dtype))
        return at.vector(), jnp.where(taken, rows, now[1])

    none = np.zeros(())
    begin = _At(np.array(BEGIN), np.zeros(n), np.zeros((n + 1, n + 1)), np.zeros(n), np.zeros(ROOM + 1), *[none] * 8)._replace(steps=none - 1, goes=none + 1)
    first = jnp.asarray(np.concatenate([np.ravel(part) for part in begin])).at[5 : 5 + n].set(x)
    end, rows = jax.lax.while_loop(lambda now: now[0][-1] > 0, tried, (first, jnp.zeros((told.shape[0] - Told.length(n, 0), n + 1))))
    at = _At.of(end, n)
    steps, d, last = at.steps + at.foretold, jnp.where(at.foretold > 0, at.d, 0.0), at.cost - at.promised
    at = at._replace(steps=steps, x=at.x + d, costs=jnp.where((places == steps) & (at.foretold > 0), last, at.costs))
    ended = jnp.concatenate([rows[:, :-1], rows[:, -1:] + rows[:, :-1] @ d[:, None]], axis=1)
    return jnp.concatenate([at.vector(), ended.ravel()])


def read(found: Float[np.ndarray, "_"], unknowns: int) -> tuple[tuple[float, ...], list[float], bool, np.ndarray, np.ndarray]:
    """The pace of the next step; F at first and after each step; whether a minimum was found; the unknowns, and [J r] there."""
    at, rows = _At.of(found, unknowns), found[_At.room(unknowns) :].reshape(-1, unknowns + 1)
    return tuple(at.pace.tolist()), at.costs[: int(at.steps) + 1].tolist(), bool(at.converged), at.x, rows
