"""A function with derivatives of its own in both modes: all orders of modes and of `vmap` give what JAX gives of the function itself."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jourdain_jax import DifferentiationModeError
from jourdain_jax.calculus.differentiated_as import Rules, with_rules


def plain(numbers, shift):
    """Two results and a whole number."""
    x, y = numbers["x"], numbers["y"]
    return {"a": jnp.sin(x * shift) * y[0] + y[1] ** 3 * shift**2, "count": jnp.asarray(3), "b": jnp.exp(-x) * y}


def push(arguments, tangents):
    filled = jax.tree.map(lambda x, d: jnp.zeros_like(x) if d is None else d, arguments, tangents, is_leaf=lambda d: d is None)
    return jax.jvp(plain, arguments, filled)


def pull(perturbed, arguments, found, g):
    """Of those numbers alone that vary, as of a motion."""
    by_all = jax.vjp(lambda *x: {name: x for name, x in plain(*x).items() if name != "count"}, *arguments)[1]({name: g[name] for name in "ab"})
    return jax.tree.map(lambda varies, x: x if varies else None, perturbed, by_all)


def ours(*arguments):
    """What runs cannot be differentiated, as machine code cannot."""
    run = jax.custom_jvp(plain)
    run.defjvp(lambda *_: pytest.fail("what runs was differentiated"))

    return with_rules(run, Rules(push, pull))(*arguments)


X = jnp.array([0.7, -0.4, 1.3, 0.2])
LANES = X * (1 + 0.1 * jnp.arange(3.0)[:, None])


def number(function, x, factor=0.8):
    found = function({"x": x[0], "y": x[1:3]}, factor * x[3])
    return found["a"] ** 2 * jnp.sum(found["b"]) + found["count"]


MODES = {"jacfwd": jax.jacfwd, "jacrev": jax.jacrev}


@functools.cache
def second_derivatives(use):
    """Those of the function itself, the same by all modes."""
    return jax.jit(lambda: USES[use](jax.jacfwd, jax.jacrev, plain))()


ORDERS = list(itertools.product(MODES, MODES))
USES = {
    "one": lambda outer, inner, f: outer(inner(lambda x: number(f, x)))(X),
    "of some numbers along others": lambda outer, inner, f: outer(lambda a: inner(lambda b: number(f, jnp.stack([b, *X[1:3], a])))(X[0]))(X[3]),
    "lanes": lambda outer, inner, f: jax.vmap(outer(inner(lambda x: number(f, x))))(LANES),
    "lanes between": lambda outer, inner, f: outer(lambda x: jax.vmap(lambda lane: inner(lambda x: number(f, x))(x + lane))(LANES))(X),
    "lanes inside, which share numbers": lambda outer, inner, f: outer(inner(lambda x: jnp.sin(jax.vmap(lambda k: number(f, x, k))(X))))(X),
    "directions alone": lambda outer, inner, f: jax.vmap(lambda v: jax.jvp(inner(lambda x: number(f, x)), (X,), (v,))[1])(LANES),
    "inside of scan": lambda outer, inner, f: outer(inner(lambda x: jax.lax.scan(lambda c, k: (number(f, c * x), k), 1.0, X)[0]))(X),
}


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("order", ORDERS, ids=" of ".join)
def test_second_derivatives_in_all_modes(order, use):
    outer, inner = (MODES[name] for name in order)
    np.testing.assert_allclose(jax.jit(lambda: USES[use](outer, inner, ours))(), second_derivatives(use), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("order", [names for names in itertools.product(MODES, MODES, MODES) if names != ("jacfwd",) * 3], ids=" of ".join)
def test_third_derivatives_name_the_mode_that_has_them(order):
    def function(x):
        return number(ours, x)

    for name in reversed(order):
        function = MODES[name](function)
    with pytest.raises(DifferentiationModeError, match=r"forward mode of any order.*jacfwd"):
        jax.eval_shape(jax.vmap(function), LANES)
