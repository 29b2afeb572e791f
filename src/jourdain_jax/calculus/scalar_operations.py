"""Table of the scalar functions that a scene may use: value, derivative, round-off and source code of each.

It is the only definition of these functions; a new function is a new entry.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus import round_off


@dataclass(frozen=True)
class Operation:
    """A scalar function of the table."""

    name: str
    value: Callable  # of NumPy arrays, elementwise
    # (g, n, *args, *rates) -> rate of node n = f(*args) of a graph g, from the rates of its arguments; None:
    # piecewise constant
    derivative: Callable[..., int] | None = None
    # "flat": analytic, but constant to the last digit over some range; "branch": chooses a branch by
    # comparing its arguments; "choice": combines such decisions
    kind: Literal["analytic", "flat", "branch", "choice"] = "analytic"
    # value and round-off bound, see `round_off`; None: identity proofs do not cover this function
    bounded: Callable | None = None
    # of JAX arrays; None: the function of `jax.numpy` with the name of `value`
    traced: Callable | None = None
    python: str = ""  # Python source: a format of the arguments, or a name; empty: the name in `math`
    c: str = ""  # empty: the name in C's library
    sympy: Callable[..., Any] | None = None  # (sympy, *args); None: the function of this name
    infix: tuple[str, int] | None = None  # infix symbol and precedence
    commutes: bool = False

    @property
    def in_jax(self) -> Callable:
        """Return the function that evaluates the operation on JAX arrays."""
        return self.traced or getattr(jnp, self.value.__name__)

    @property
    def is_number(self) -> bool:
        """Return whether arguments and value are numbers rather than booleans."""
        return self.kind != "choice" and self.name not in COMPARISONS


# Longer derivatives.


def _quotient(g, n, a, b, da, db):
    return g.div(g.sub(da, g.mul(n, db)), b)  # (a/b)' = (a' - (a/b) b')/b


def _larger(g, n, a, b, da, db):
    return _halved_where_equal(g, a, b, g.call("select", g.call("gt", a, b), db, da), da, db)


def _smaller(g, n, a, b, da, db):
    return _halved_where_equal(g, a, b, g.call("select", g.call("lt", a, b), db, da), da, db)


def _halved_where_equal(g, a, b, otherwise, da, db):
    """Return the mean of both derivatives where the arguments are equal, as JAX does. Thus `max(x, 0) -
    max(-x, 0)` is smooth at x = 0.
    """
    return g.call("select", g.call("eq", a, b), otherwise, g.mul(g.const(0.5), g.add(da, db)))


def _real_power(g, n, a, b, da, db):
    """Return `(a^b)' = b a^(b-1) a' + a^b log(a) b'`. The first term is zero where a and b are zero, the
    second where a is zero (`a^b log a` tends to 0 for b > 0).
    """
    of_base, of_exponent = g.zero, g.zero
    if da != g.zero:
        of_base = g.mul(g.mul(b, g.call("pow", a, _unless_zero(g, (a, b), g.sub(b, g.one)))), da)
    if db != g.zero:
        of_exponent = g.mul(g.mul(n, g.call("log", _unless_zero(g, (a,), a))), db)
    return g.add(of_base, of_exponent)


def _unless_zero(g, nodes: tuple[int, ...], value):
    """Return the value, or 1 where all of the nodes are zero."""
    if any(g.is_const(n) and g.value[n] for n in nodes):
        return value
    vanish = [g.call("eq", n, g.zero) for n in nodes]
    return g.call("select", functools.reduce(lambda a, b: g.call("and", a, b), vanish), value, g.one)


def _remainder(g, n, a, b, da, db):
    return g.sub(da, g.mul(g.div(g.sub(a, n), b), db))  # a = k b + n with integer k


def _arctangent(g, n, y, x, dy, dx):
    return g.div(g.sub(g.mul(x, dy), g.mul(y, dx)), g.add(g.mul(x, x), g.mul(y, y)))


def _of_asin(g, n, a, da):
    return g.div(da, g.call("sqrt", g.sub(g.one, g.mul(a, a))))


def _of_acosh(g, n, a, da):
    return g.div(da, g.mul(g.call("sqrt", g.sub(a, g.one)), g.call("sqrt", g.add(a, g.one))))


def _of_abs(g, n, a, da):
    # 1 at zero, so that powers of |x| are smooth
    return g.mul(g.call("select", g.call("ge", a, g.zero), g.const(-1.0), g.one), da)


def _whole_quotients(sympy, a, b):
    return a - b * sympy.sign(a / b) * sympy.floor(sympy.Abs(a / b))


_COMPARED = (
    ("lt", "<", np.less),
    ("le", "<=", np.less_equal),
    ("gt", ">", np.greater),
    ("ge", ">=", np.greater_equal),
    ("eq", "==", np.equal),
)
_COMPARED += (("ne", "!=", np.not_equal),)
COMPARISONS = frozenset(name for name, *_ in _COMPARED)

_ALL = [
    Operation(
        "add",
        np.add,
        lambda g, n, a, b, da, db: g.add(da, db),
        bounded=round_off.sum_,
        infix=("+", 1),
        sympy=lambda _, a, b: a + b,
        commutes=True,
    ),
    Operation(
        "sub",
        np.subtract,
        lambda g, n, a, b, da, db: g.sub(da, db),
        bounded=round_off.difference,
        infix=("-", 1),
        sympy=lambda _, a, b: a - b,
    ),
    Operation(
        "mul",
        np.multiply,
        lambda g, n, a, b, da, db: g.add(g.mul(da, b), g.mul(a, db)),
        bounded=round_off.product,
        infix=("*", 2),
        sympy=lambda _, a, b: a * b,
        commutes=True,
    ),
    Operation(
        "div", np.divide, _quotient, bounded=round_off.quotient, infix=("/", 2), sympy=lambda _, a, b: a / b
    ),
    Operation(
        "neg", np.negative, lambda g, n, a, da: g.neg(da), bounded=round_off.negative, sympy=lambda _, a: -a
    ),
    Operation("sqrt", np.sqrt, lambda g, n, a, da: g.div(da, g.mul(g.const(2.0), n)), bounded=round_off.root),
    Operation("sin", np.sin, lambda g, n, a, da: g.mul(g.call("cos", a), da), bounded=round_off.wave(np.sin)),
    Operation(
        "cos", np.cos, lambda g, n, a, da: g.neg(g.mul(g.call("sin", a), da)), bounded=round_off.wave(np.cos)
    ),
    Operation(
        "tan", np.tan, lambda g, n, a, da: g.mul(g.add(g.one, g.mul(n, n)), da), bounded=round_off.tangent
    ),
    Operation("asin", np.arcsin, _of_asin),
    Operation("acos", np.arccos, lambda g, n, a, da: g.neg(_of_asin(g, n, a, da))),
    Operation("atan", np.arctan, lambda g, n, a, da: g.div(da, g.add(g.one, g.mul(a, a)))),
    Operation("atan2", np.arctan2, _arctangent),
    Operation("exp", np.exp, lambda g, n, a, da: g.mul(n, da), "flat"),
    Operation(
        "exp2",
        np.exp2,
        lambda g, n, a, da: g.mul(g.mul(n, g.const(math.log(2.0))), da),
        "flat",
        sympy=lambda _, a: 2**a,
    ),
    Operation(
        "expm1",
        np.expm1,
        lambda g, n, a, da: g.mul(g.add(n, g.one), da),
        "flat",
        sympy=lambda s, a: s.exp(a) - 1,
    ),
    Operation("log", np.log, lambda g, n, a, da: g.div(da, a)),
    Operation(
        "log1p",
        np.log1p,
        lambda g, n, a, da: g.div(da, g.add(g.one, a)),
        "flat",
        sympy=lambda s, a: s.log(a + 1),
    ),
    Operation("pow", np.power, _real_power, sympy=lambda s, a, b: s.Pow(a, b)),
    Operation("cbrt", np.cbrt, lambda g, n, a, da: g.div(da, g.mul(g.const(3.0), g.mul(n, n)))),
    Operation("sinh", np.sinh, lambda g, n, a, da: g.mul(g.call("cosh", a), da), "flat"),
    Operation("cosh", np.cosh, lambda g, n, a, da: g.mul(g.call("sinh", a), da), "flat"),
    Operation("tanh", np.tanh, lambda g, n, a, da: g.mul(g.sub(g.one, g.mul(n, n)), da), "flat"),
    Operation("asinh", np.arcsinh, lambda g, n, a, da: g.div(da, g.call("sqrt", g.add(g.mul(a, a), g.one)))),
    Operation("acosh", np.arccosh, _of_acosh),
    Operation("atanh", np.arctanh, lambda g, n, a, da: g.div(da, g.sub(g.one, g.mul(a, a)))),
    Operation(
        "logistic",
        lambda a: 1 / (1 + np.exp(-a)),
        lambda g, n, a, da: g.mul(g.mul(n, g.sub(g.one, n)), da),
        "flat",
        traced=jax.lax.logistic,
        python="1.0 / (1.0 + math.exp(-({0})))",
        c="1.0 / (1.0 + exp(-({0})))",
        sympy=lambda s, a: 1 / (1 + s.exp(-a)),
    ),
    Operation("abs", np.absolute, _of_abs, "branch", python="abs", c="fabs", sympy=lambda s, a: s.Abs(a)),
    Operation("sign", np.sign, None, "branch", python="sign"),
    Operation(
        "max",
        np.maximum,
        _larger,
        "branch",
        python="max",
        c="fmax",
        sympy=lambda s, a, b: s.Max(a, b),
        commutes=True,
    ),
    Operation(
        "min",
        np.minimum,
        _smaller,
        "branch",
        python="min",
        c="fmin",
        sympy=lambda s, a, b: s.Min(a, b),
        commutes=True,
    ),
    Operation("floor", np.floor, None, "branch"),
    Operation("ceil", np.ceil, None, "branch", sympy=lambda s, a: s.ceiling(a)),
    Operation(
        "round", np.rint, None, "branch", python="round", c="rint", sympy=lambda s, a: s.Function("round")(a)
    ),
    Operation("rem", np.fmod, _remainder, "branch", python="math.fmod", c="fmod", sympy=_whole_quotients),
    *(
        Operation(
            name,
            f,
            None,
            "branch",
            infix=(sign, 0),
            sympy=lambda s, a, b, name=name: getattr(s, name.title())(a, b),
        )
        for name, sign, f in _COMPARED
    ),
    Operation("is_finite", np.isfinite, None, "choice", python="math.isfinite", c="isfinite"),
    Operation(
        "and",
        np.logical_and,
        None,
        "choice",
        python="({0}) and ({1})",
        c="({0}) && ({1})",
        sympy=lambda s, a, b: s.And(a, b),
    ),
    Operation(
        "or",
        np.logical_or,
        None,
        "choice",
        python="({0}) or ({1})",
        c="({0}) || ({1})",
        sympy=lambda s, a, b: s.Or(a, b),
    ),
    Operation(
        "not", np.logical_not, None, "choice", python="not ({0})", c="!({0})", sympy=lambda s, a: s.Not(a)
    ),
    Operation(  # the third argument if the first is true, otherwise the second
        "select",
        lambda c, a, b: np.where(c, b, a),
        lambda g, n, c, a, b, dc, da, db: g.call("select", c, da, db),
        "choice",
        traced=lambda c, a, b: jnp.where(c, b, a),
        python="{2} if {0} else {1}",
        c="{0} ? {2} : {1}",
        sympy=lambda s, c, a, b: s.Piecewise((b, c), (a, True)),
    ),
]
TABLE: dict[str, Operation] = {operation.name: operation for operation in _ALL}
BRANCHES = frozenset(op.name for op in _ALL if op.kind == "branch")
VALUES: dict[str, Callable] = {op.name: op.value for op in _ALL}
