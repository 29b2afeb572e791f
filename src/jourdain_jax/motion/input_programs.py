"""Functions of time that are given as inputs: looked at anew in every call, their numbers kept apart from what is done with them.

A function is traced where it is handed over. What it closes over (arrays, traced numbers) and the plain numbers in its sums, products, quotients and
comparisons become arguments of a program, so that they have derivatives; what is left, the operations, is compared by value. So a new function that does
the same with other numbers compiles nothing, and a function whose globals have changed is another program.
"""

from collections.abc import Callable, Hashable
from functools import lru_cache
from weakref import WeakKeyDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Primitive, Var, jaxpr_as_fun
from jaxtyping import Array, Float

from jourdain_jax.calculus.compiled import compiled
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.program.calls import description
from jourdain_jax.scene.names_read import is_function, now_read_by

_TAKE_NUMBERS = ("add", "sub", "mul", "div", "lt", "le", "gt", "ge")  # finite derivatives with respect to a plain number, where it is not zero


class TimeProgram:
    """The operations of a function of time, without its plain numbers; equal to any other that does the same."""

    def __init__(self, closed: ClosedJaxpr, real):
        taken: list[tuple[Var, Literal]] = []

        def lifted(atoms):
            return [lift(x) if isinstance(x, Literal) and x.aval.shape == () and x.aval.dtype == real else x for x in atoms]

        def lift(number: Literal) -> Var:
            taken.append((Var(number.aval), number))
            return taken[-1][0]

        jaxpr = closed.jaxpr
        equations = [e.replace(invars=lifted(e.invars)) if e.primitive.name in _TAKE_NUMBERS else e for e in jaxpr.eqns]
        outputs = lifted(jaxpr.outvars)
        arguments = [*(v for v, _ in taken), *jaxpr.constvars, *jaxpr.invars]
        self.numbers = np.array([number.val for _, number in taken], real)  # of this trace: they do not count in comparisons
        self.closed = ClosedJaxpr(jaxpr.replace(constvars=[], invars=arguments, eqns=equations, outvars=outputs), [])
        self._key = description(self.closed)
        self._hash = hash(self._key)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of the arguments before the time: the plain numbers, and what the function closes over."""
        return [x.shape for x in self.closed.in_avals[:-1]]

    def __call__(self, numbers, held, t):
        """The value at time t; `numbers`: the plain ones; `held`: what the function closes over."""
        given = zip((*numbers, *held, t), self.closed.in_avals, strict=True)
        return jaxpr_as_fun(self.closed)(*(jnp.asarray(x, like.dtype) for x, like in given))[0]

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, TimeProgram) and self._key == other._key)

    def does_the_same_as(self, other: "TimeProgram") -> bool:
        """Whether both are traces of one function, which is known: rules of differentiation are new in every trace, and are not compared."""
        return self._key == other._key or _without_rules(self._key) == _without_rules(other._key)


def _without_rules(described):
    """A description without the functions that are somebody's rules of differentiation."""
    if not isinstance(described, tuple):
        return described
    if len(described) == 4 and isinstance(described[0], Primitive) and described[0].name.startswith("custom_"):
        primitive, inputs, parameters, outputs = described
        kept = tuple((name, _without_rules(value)) for name, value in parameters if isinstance(value, tuple | str | int | None))
        return primitive, inputs, kept, outputs
    return tuple(map(_without_rules, described))


class FunctionOfTime(eqx.Module):
    """An input as a given function of time: its operations, the plain numbers in them, and the arrays that it closes over."""

    program: TimeProgram = eqx.field(static=True)
    numbers: Float[Array, "*lanes numbers"]
    held: tuple

    def __call__(self, t):
        """Value at time t."""
        return self.program(self.numbers, self.held, t)


def traced(function: Callable, real) -> tuple[FunctionOfTime | None, object]:
    """A function of one time as it is now, and the shape of what it returns; no `FunctionOfTime` where that is not one number.

    It is traced again where it is another function, or what it reads (`scene/names_read.py`) has changed or has state.
    """
    if not is_function(function):
        return _traced_now(function, real)
    kept = _trace(function)
    now = (now_read_by(function), real) if kept.again else None
    if now is not None and now[0] is not None and kept.now == now:
        return kept.found
    found = _traced_now(function, real)
    if kept.again and found[0] is not None and not is_traced(found[0]):
        kept.now, kept.found = now, found
    kept.again = True
    return found


class _Trace:
    """The last trace of a function that is given again, and what it read then; of one that is given once, as most in loops are, nothing is kept."""

    def __init__(self) -> None:
        self.again = False
        self.now: Hashable = None
        self.found: tuple[FunctionOfTime | None, object] = (None, None)


@lru_cache(maxsize=64)
def _trace(function: Callable) -> _Trace:
    return _Trace()


def _traced_now(function: Callable, real) -> tuple[FunctionOfTime | None, object]:
    closed, shape = jax.make_jaxpr(lambda t: function(t), return_shape=True)(jax.ShapeDtypeStruct((), real))  # of a new function JAX keeps no trace
    if getattr(shape, "shape", None) != ():
        return None, shape
    program = TimeProgram(closed, real)
    return FunctionOfTime(_known(function, program), jnp.asarray(program.numbers), tuple(jnp.asarray(x) for x in closed.consts)), shape


_latest: WeakKeyDictionary = WeakKeyDictionary()  # of each function, while it lives


def _known(function: Callable, program: TimeProgram) -> TimeProgram:
    """An equal program that was met before, or this one."""
    try:
        before = _latest.get(function)
        if before is None or not before.does_the_same_as(program):
            before = _latest[function] = _one_of_equals(program)
        return before
    except TypeError:  # an object that cannot be referred to weakly
        return _one_of_equals(program)


@lru_cache(maxsize=64)
def _one_of_equals(program: TimeProgram) -> TimeProgram:
    return program


def for_programs(f: Callable, options: Callable | None = None) -> Callable[[Hashable], Callable]:
    """`f` compiled for a set of input programs; what was compiled for one is dropped, machine code included, when as many other sets were used since."""
    for_none = compiled(f, options)
    for_some = lru_cache(maxsize=16)(lambda programs: compiled(f, options))
    return lambda programs: for_some(programs) if programs else for_none
