"""Which outputs of a jaxpr may have kinks or jumps as functions of some inputs: those that pass a comparison, a rounding, an index or a branch on the way.

That is necessary for a kink, not sufficient: a spline picks its piece by an index, and is smooth.
"""

from collections.abc import Collection, Sequence

import numpy as np
from jax.extend.core import Literal

from jourdain_jax.calculus.jaxprs import inner_jaxprs, parts_of_scan
from jourdain_jax.calculus.scalar_operations import BRANCHES

ROUGH = BRANCHES | {"clamp", "reduce_max", "reduce_min", "cummax", "cummin", "sort", "atan2", "select_n"}
_SMOOTH, _MOVES, _MAY_BEND = 0, 1, 2  # does not depend on the inputs; depends smoothly; may have kinks


def may_bend(closed, variables: Collection[int], smooth: Collection[str] = ()) -> list[bool]:
    """Whether each output of a closed jaxpr may have kinks or jumps as a function of those inputs; functions named in `smooth` have none."""
    marks = [_MOVES if k in variables else _SMOOTH for k in range(len(closed.jaxpr.invars))]
    return [mark == _MAY_BEND for mark in _marked(closed.jaxpr, marks, frozenset(smooth))]


def _marked(jaxpr, marks: Sequence[int], smooth: frozenset[str]) -> list[int]:
    known = dict(zip(jaxpr.invars, marks, strict=True))

    def read(atom) -> int:
        return _SMOOTH if isinstance(atom, Literal) else known.get(atom, _SMOOTH)

    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        if max(given, default=_SMOOTH) == _SMOOTH:
            continue
        known |= dict(zip(equation.outvars, _results(equation, given, smooth), strict=True))
    return [read(x) for x in jaxpr.outvars]


def _results(equation, given: list[int], smooth: frozenset[str]) -> list[int]:
    name, params = equation.primitive.name, equation.params
    if params.get("name") in smooth:
        return [max(given)] * len(equation.outvars)
    if name == "select_n" and given[0] == _SMOOTH:
        return [max(given)]
    if name == "scan":
        return _repeated(params["jaxpr"].jaxpr, given, *parts_of_scan(equation), smooth)
    if name == "while":
        conditions, constants = params["cond_nconsts"], params["body_nconsts"]
        found = _repeated(params["body_jaxpr"].jaxpr, given[conditions:], constants, len(given) - conditions - constants, smooth)
        turns = max(_marked(params["cond_jaxpr"].jaxpr, [*given[:conditions], *found], smooth))  # whether it depends on them how often it turns
        return [_MAY_BEND if mark or turns else mark for mark in found]
    if name == "cond":
        branches = [_marked(branch.jaxpr, given[1:], smooth) for branch in params["branches"]]
        return [_MAY_BEND if given[0] else max(marks) for marks in zip(*branches, strict=True)]
    inner = inner_jaxprs(params)
    if inner:
        alike = len(inner) == 1 and len(inner[0].invars) == len(given) and len(inner[0].outvars) == len(equation.outvars)
        return _marked(inner[0], given, smooth) if alike else [_MAY_BEND] * len(equation.outvars)
    decided = name in ROUGH or any(not np.issubdtype(v.aval.dtype, np.inexact) for v in equation.outvars)
    return [_MAY_BEND if decided else max(given)] * len(equation.outvars)


def _repeated(jaxpr, given: list[int], constants: int, carried: int, smooth: frozenset[str]) -> list[int]:
    """The marks of a loop, gone round until nothing that is carried changes any more."""
    given = list(given)
    while True:
        found = _marked(jaxpr, given, smooth)
        carry = [max(pair) for pair in zip(given[constants : constants + carried], found, strict=False)]
        if carry == given[constants : constants + carried]:
            return found
        given[constants : constants + carried] = carry
