"""Adjoint of one step, below for an explicit Runge-Kutta method: from cotangents of its end to cotangents of its start.

Y_i = y_0 + h sum_j a_ij k_j,   k_i = f(t_0 + c_i h, Y_i, args),   y_1 = y_0 + h sum b_i k_i
v_i = b_i g_1 + sum_l a_li G_l,   (tau_i, G_i) = (df/dt, df/dy)' h v_i              from the last stage to the first
g_0 = g_1 + sum G_i,   g_args = sum (df/dargs)' h v_i,   g_h = sum v_i . k_i + c_i tau_i
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.integrators.erk_step import onto_rows, stages, weighted
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.integrators.problem import Problem, as_in


class StepCotangents(eqx.Module):
    """Cotangents after going back over a step."""

    t_0: Float[Array, "*lanes"]
    t_1: Float[Array, "*lanes"]
    y: PyTree
    shared: PyTree


def step_vjp(problem_of: Callable[[PyTree], Problem], shared: PyTree, method: Method | ImplicitMethod, t_0, t_1, y: PyTree, g: PyTree) -> StepCotangents:
    """Cotangents of the step from `y` at `t_0` to `t_1`, given that of its end, `g`. `problem_of(shared)`: rates, projection and args."""
    if not isinstance(method, Method):
        return _by_jax(problem_of, shared, method, t_0, t_1, y, g)
    problem, h = problem_of(shared), t_1 - t_0
    method = replace(method, b_error=np.zeros_like(method.b_error))  # no error is asked: a stage that only it needs is left out
    y_1, slopes, at, _, rank = stages(problem, method, t_0, y, h)
    by_t_1 = jnp.zeros_like(t_1)
    by_shared = jax.tree.map(jnp.zeros_like, shared)
    if problem.project is not None:
        by_t_1, g, by_shared = jax.vjp(lambda t, y, shared: (p := problem_of(shared)).project(t, y, p.args), t_1, y_1, shared)[1](g)

    def stage(carry, row):
        G, by_shared, by_t, by_h = carry
        c, b, column, Y, k, i = row
        v = jax.tree.map(lambda g, G: as_in(b, g) * g + weighted(column, G), g, G)
        near = None if rank is None else rank.near & (i > 0)
        _, pull = jax.vjp(lambda t, y, shared: _rates(problem_of(shared).in_step(t_0, h), near, t, y), t_0 + c * h, Y, shared)
        tau, G_i, more = pull(jax.tree.map(lambda v: as_in(h, v) * v, v))
        G = jax.tree.map(lambda G, new: jax.lax.dynamic_update_index_in_dim(G, new, i, 0), G, G_i)
        by_h = by_h + product(v, k, t_0.ndim) + c * tau
        return (G, jax.tree.map(jnp.add, by_shared, more), by_t + tau, by_h), None

    count = len(jax.tree.leaves(at)[0])
    # G_l of stages that come later
    rows = jnp.asarray(method.c[:count]), jnp.asarray(method.b[:count]), jnp.asarray(method.A[:count, :count].T), at
    rows = *rows, jax.tree.map(lambda k: k[:count], slopes), jnp.arange(count)
    zero = jnp.zeros_like(t_0)
    (G, by_shared, by_t, by_h), _ = jax.lax.scan(stage, (jax.tree.map(jnp.zeros_like, at), by_shared, zero, zero), rows, reverse=True)
    return StepCotangents(by_t - by_h, by_t_1 + by_h, jax.tree.map(lambda g, G: g + jnp.sum(G, axis=0), g, G), by_shared)


def _by_jax(problem_of: Callable[[PyTree], Problem], shared: PyTree, method: ImplicitMethod, t_0, t_1, y: PyTree, g: PyTree) -> StepCotangents:
    """Return cotangents of a step of an implicit method, by JAX through the equations of the step; zero for a lane that stands still."""

    def end(t_0, t_1, y, shared):
        problem, h = problem_of(shared), t_1 - t_0
        change = method.solve(problem.in_step(t_0, h), t_0, y, h).change
        y_1 = jax.tree.map(jnp.add, y, change)
        return y_1 if problem.project is None else problem.project(t_1, y_1, problem.args)

    gone = jax.vjp(end, t_0, t_1, y, shared)[1](g)
    return StepCotangents(*jax.tree.map(lambda x: jnp.where(t_0 == t_1, jnp.zeros_like(x), x), gone))


def product(g: PyTree, f: PyTree, lane_axes: int) -> Float[Array, "*lanes"]:
    """Sum of g f over all but the last axes."""
    return sum(jnp.sum(a * b, axis=tuple(range(a.ndim - lane_axes))) for a, b in zip(jax.tree.leaves(g), jax.tree.leaves(f), strict=True))


def _rates(problem: Problem, near: Bool[Array, "*lanes"] | None, t, y: PyTree) -> PyTree:
    y = y if near is None else onto_rows(problem, near, t, y)
    return jax.tree.map(lambda f, y: as_in(f, y), problem.rates(t, y, problem.args), y)
