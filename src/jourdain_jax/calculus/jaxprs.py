"""Analysis of traced programs: operations that results need, targets of calls, and loops."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.interpreters.partial_eval import dce_jaxpr

LOOPS = ("while", "scan")
# Where an operation that only calls a function keeps it, by the name of the operation.
_CALLS = dict.fromkeys(("jit", "pjit", "remat", "remat2", "checkpoint"), "jaxpr")
_CALLS |= dict.fromkeys(("closed_call", "core_call", "custom_jvp_call", "custom_vjp_call"), "call_jaxpr")


def evaluated(closed: ClosedJaxpr, arguments: Sequence, results: Callable, number: Callable = lambda x, aval: np.asarray(x, aval.dtype)) -> list:
    """Return outputs at the given arguments: `results(equation, inputs)` evaluates one operation, `number(x,
    aval)` a constant.
    """
    jaxpr = closed.jaxpr
    values = {v: number(x, v.aval) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)} | dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom):
        return number(atom.val, atom.aval) if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        values |= zip(equation.outvars, results(equation, [read(x) for x in equation.invars]), strict=True)
    return [read(x) for x in jaxpr.outvars]


def needed_only(closed: ClosedJaxpr, outputs: Sequence[int] | None = None) -> ClosedJaxpr:
    """Return `closed` with only the operations that its `outputs` need (by index, in order; default: all),
    also inside calls.
    """
    jaxpr = closed.jaxpr
    of_wanted = jaxpr if outputs is None else jaxpr.replace(outvars=[jaxpr.outvars[i] for i in outputs])
    return ClosedJaxpr(dce_jaxpr(of_wanted, [True] * len(of_wanted.outvars), instantiate=True)[0], closed.consts)


def called(name: str, params: Mapping) -> ClosedJaxpr | None:
    """Return the function that an operation of this name calls, if the operation does nothing else; None for
    other operations.
    """
    if name not in _CALLS:
        return None
    found = params[_CALLS[name]]
    return found if hasattr(found, "consts") else ClosedJaxpr(found, [])


def parts_of_scan(equation) -> tuple[int, int]:
    """Return the numbers of constant and of carried inputs of a scan. These inputs have the same axes inside
    the body as outside; all others have one axis less inside.

    The names of these parameters differ between versions of JAX.
    """
    body = equation.params["jaxpr"].jaxpr
    whole, carried = (
        sum(x.aval.ndim == y.aval.ndim for x, y in zip(*pair, strict=True)) for pair in ((equation.invars, body.invars), (equation.outvars, body.outvars))
    )
    return whole - carried, carried


def is_jaxpr(x) -> bool:
    """Return whether this is a traced function, closed or not."""
    return hasattr(x, "eqns") or hasattr(x, "jaxpr")


def inner_jaxprs(params: Mapping) -> list[Jaxpr]:
    """Return the traced functions among the parameters of an operation."""
    return [getattr(x, "jaxpr", x) for x in jax.tree.leaves(list(params.values()), is_leaf=is_jaxpr) if is_jaxpr(x)]


def loops(jaxpr: Jaxpr) -> Iterator[str]:
    """Return the names of its loops, in order, also inside calls."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in LOOPS:
            yield equation.primitive.name
        for inner in inner_jaxprs(equation.params):
            yield from loops(inner)
