"""Analysis of jaxprs: evaluation, dead code, inner functions and loops."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters.partial_eval import dce_jaxpr

LOOPS = ("while", "scan")
# Parameter that holds the called function, by name of the primitive.
_CALLS = dict.fromkeys(("jit", "pjit", "remat", "remat2", "checkpoint"), "jaxpr")
_CALLS |= dict.fromkeys(("closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"), "call_jaxpr")


def evaluated(
    closed: ClosedJaxpr,
    arguments: Sequence,
    results: Callable,
    number: Callable = lambda x, aval: np.asarray(x, aval.dtype),
) -> list:
    """Evaluate a jaxpr. `results(equation, inputs)` evaluates one equation, `number(x, aval)` converts a
    constant.
    """
    jaxpr = closed.jaxpr
    values = {v: number(x, v.aval) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)} | dict(
        zip(jaxpr.invars, arguments, strict=True)
    )

    def read(atoms) -> list:
        return [number(x.val, x.aval) if isinstance(x, Literal) else values[x] for x in atoms]

    for equation in jaxpr.eqns:
        values |= zip(equation.outvars, results(equation, read(equation.invars)), strict=True)
    return read(jaxpr.outvars)


def needed_only(closed: ClosedJaxpr, outputs: Sequence[int] | None = None) -> ClosedJaxpr:
    """Return `closed` without the equations that its outputs do not need, including those inside calls.
    `outputs`: indices of the outputs to keep (default: all).
    """
    jaxpr = closed.jaxpr
    of_wanted = jaxpr if outputs is None else jaxpr.replace(outvars=[jaxpr.outvars[i] for i in outputs])
    return ClosedJaxpr(
        dce_jaxpr(of_wanted, [True] * len(of_wanted.outvars), instantiate=True)[0], closed.consts
    )


def called(name: str, params: Mapping) -> ClosedJaxpr | None:
    """Return the function that a primitive calls; None if it calls none."""
    if name not in _CALLS:
        return None
    found = params[_CALLS[name]]
    return found if hasattr(found, "consts") else ClosedJaxpr(found, [])


def parts_of_scan(equation) -> tuple[int, int]:
    """Return the numbers of constant and of carried inputs of a scan.

    Scanned inputs are recognised by the axis that they lose inside the body, because parameter names differ
    between versions of JAX.
    """
    body = equation.params["jaxpr"].jaxpr
    whole, carried = (
        sum(x.aval.ndim == y.aval.ndim for x, y in zip(*pair, strict=True))
        for pair in ((equation.invars, body.invars), (equation.outvars, body.outvars))
    )
    return whole - carried, carried


def is_jaxpr(x) -> bool:
    """Return whether `x` is a jaxpr, closed or open."""
    return hasattr(x, "eqns") or hasattr(x, "jaxpr")


def inner_jaxprs(params: Mapping) -> list[Jaxpr]:
    """Return the jaxprs among the parameters of a primitive."""
    return [
        getattr(x, "jaxpr", x)
        for x in jax.tree.leaves(list(params.values()), is_leaf=is_jaxpr)
        if is_jaxpr(x)
    ]


def loops(jaxpr: Jaxpr) -> Iterator[str]:
    """Yield the names of all loops in order, including loops inside calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in LOOPS:
            yield equation.primitive.name
        for inner in inner_jaxprs(equation.params):
            yield from loops(inner)
