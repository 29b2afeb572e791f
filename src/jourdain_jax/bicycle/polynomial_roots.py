"""All real roots of a low-degree polynomial in an interval, without an eigenvalue solver.

Between two neighbouring extrema a polynomial has at most one root, and its extrema are the roots of its derivative:
from the linear derivative upwards, every root of every degree is bracketed and bisected. Only additions and
multiplications, so it runs in large batches on any device. A root of even multiplicity, where the polynomial touches
zero without crossing, is not counted.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

_BISECTIONS = 64  # an interval shrinks to 5e-20 of its length

Scalar = Float[Array, ""]


def evaluate(coefficients: Sequence[Array] | Array, x: Array) -> Array:
    """p(x) = sum_k coefficients[k] x^k by Horner's scheme; `x` real or complex, of any shape."""
    value = jnp.zeros_like(x) + coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value


def add(*polynomials: Sequence[Scalar]) -> list[Scalar]:
    """Coefficients of the sum, lowest power first."""
    length = max(len(polynomial) for polynomial in polynomials)
    return [sum(p[k] for p in polynomials if k < len(p)) for k in range(length)]


def multiply(*polynomials: Sequence[Scalar]) -> list[Scalar]:
    """Coefficients of the product, lowest power first."""
    product = list(polynomials[0])
    for factor in polynomials[1:]:
        terms: list[list[Scalar]] = [[] for _ in range(len(product) + len(factor) - 1)]
        for i, a in enumerate(product):
            for j, b in enumerate(factor):
                terms[i + j].append(a * b)
        product = [sum(term) for term in terms]
    return product


def scale(factor: float | Scalar, polynomial: Sequence[Scalar]) -> list[Scalar]:
    """Coefficients of `factor` times the polynomial."""
    return [factor * coefficient for coefficient in polynomial]


def derivative(coefficients: Sequence[Scalar]) -> list[Scalar]:
    """Coefficients of dp/dx, lowest power first."""
    return [k * coefficient for k, coefficient in enumerate(coefficients)][1:]


def real_roots(coefficients: Sequence[Scalar], lower: Scalar, upper: Scalar) -> Float[Array, " degree"]:
    """The real roots between `lower` and `upper`, ascending, then NaN for those that are not there.

    **Arguments:** `coefficients`, lowest power first (the highest may be zero); `lower` < `upper`.
    **Returns:** as many numbers as the degree. They carry no derivative: see `newton_root` for one.
    """
    coefficients = [jax.lax.stop_gradient(coefficient) for coefficient in coefficients]
    return jnp.sort(_real_roots(coefficients, jax.lax.stop_gradient(lower), jax.lax.stop_gradient(upper)))


def _real_roots(coefficients: Sequence[Scalar], lower: Scalar, upper: Scalar) -> Float[Array, " degree"]:
    if len(coefficients) == 1:
        return jnp.zeros((0,), jnp.result_type(coefficients[0]))
    extrema = _real_roots(derivative(coefficients), lower, upper)
    extrema = jnp.sort(jnp.where(jnp.isnan(extrema), upper, extrema))
    nodes = jnp.concatenate([lower[None], extrema, upper[None]])
    left, right = nodes[:-1], nodes[1:]
    left_negative = evaluate(coefficients, left) < 0
    crossing = left_negative != (evaluate(coefficients, right) < 0)

    def halve(_, bracket):
        left, right = bracket
        middle = 0.5 * (left + right)
        same_side = (evaluate(coefficients, middle) < 0) == left_negative
        return jnp.where(same_side, middle, left), jnp.where(same_side, right, middle)

    left, right = jax.lax.fori_loop(0, _BISECTIONS, halve, (left, right))
    return jnp.where(crossing, 0.5 * (left + right), jnp.nan)
