"""Functions of time as programs: operations, plain numbers and captured values.

A function of time is traced in each call that receives it. Captured values (arrays, traced numbers) and plain
numbers in sums, products, quotients and comparisons become arguments of a program and have derivatives. The
remaining operations identify the program. A new function with the same operations but other numbers therefore
needs no compilation; a function whose globals have changed is a new program.
"""

from collections.abc import Callable, Hashable
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Primitive, Var, jaxpr_as_fun
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import compiled
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.program.calls import description
from jourdain_jax.scene.outside_names import now_read_by

_TAKE_NUMBERS = ("add", "sub", "mul", "div", "lt", "le", "gt", "ge")  # differentiable in nonzero numbers


class TimeProgram:
    """Operations of a function of time, without its numbers. Programs are equal if their operations are."""

    def __init__(self, closed: ClosedJaxpr, real):
        taken: list[tuple[Var, Literal]] = []

        def lifted(atoms):
            return [
                lift(x) if isinstance(x, Literal) and x.aval.shape == () and x.aval.dtype == real else x
                for x in atoms
            ]

        def lift(number: Literal) -> Var:
            taken.append((Var(number.aval), number))
            return taken[-1][0]

        jaxpr = closed.jaxpr
        equations = [
            e.replace(invars=lifted(e.invars)) if e.primitive.name in _TAKE_NUMBERS else e for e in jaxpr.eqns
        ]
        outputs = lifted(jaxpr.outvars)
        arguments = [*(v for v, _ in taken), *jaxpr.constvars, *jaxpr.invars]
        self.numbers = np.array([number.val for _, number in taken], real)  # not part of comparisons
        self.closed = ClosedJaxpr(
            jaxpr.replace(constvars=[], invars=arguments, eqns=equations, outvars=outputs), []
        )
        self._key = description(self.closed)
        self._hash = hash(self._key)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the arguments other than time: plain numbers, then captured values."""
        return [x.shape for x in self.closed.in_avals[:-1]]

    def __call__(self, numbers, held, t):
        """Return the value at time t. `numbers`: the plain numbers; `held`: the captured values."""
        given = zip((*numbers, *held, t), self.closed.in_avals, strict=True)
        return jaxpr_as_fun(self.closed)(*(jnp.asarray(x, like.dtype) for x, like in given))[0]

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, TimeProgram) and self._key == other._key)

    def does_the_same_as(self, other: "TimeProgram") -> bool:
        """Return whether both programs have the same operations, ignoring custom derivative rules."""
        return self._key == other._key or _without_rules(self._key) == _without_rules(other._key)


def _without_rules(described):
    """Return a description of operations without custom derivative rules."""
    if not isinstance(described, tuple):
        return described
    if (
        len(described) == 4
        and isinstance(described[0], Primitive)
        and described[0].name.startswith("custom_")
    ):
        primitive, inputs, parameters, outputs = described
        kept = tuple(
            (name, _without_rules(value))
            for name, value in parameters
            if isinstance(value, tuple | str | int | None)
        )
        return primitive, inputs, kept, outputs
    return tuple(map(_without_rules, described))


class FunctionOfTime(eqx.Module):
    """Input as a function of time: its operations, plain numbers, and captured arrays."""

    program: TimeProgram = eqx.field(static=True)
    numbers: Float[Array, "*lanes numbers"]
    held: tuple

    def __call__(self, t):
        """Return the value at time t."""
        return self.program(self.numbers, self.held, t)


def traced(function: Callable, real) -> tuple[FunctionOfTime | None, object]:
    """Return a `FunctionOfTime` (None unless its value is one number), and the shape of its value.

    A function is traced if it is new, or if a value that it reads has changed (`scene/identity.py`).
    """
    try:
        kept = _trace(function)
    except TypeError:  # not hashable
        kept = _Trace()
    now = (now_read_by(function), real) if kept.again else (None,)
    if now[0] is not None and kept.now == now:
        return kept.found
    closed, shape = jax.make_jaxpr(lambda t: function(t), return_shape=True)(jax.ShapeDtypeStruct((), real))
    found = None
    if getattr(shape, "shape", None) == ():
        program = TimeProgram(closed, real)
        if kept.program is None or not kept.program.does_the_same_as(program):
            kept.program = program
        found = FunctionOfTime(
            kept.program, jnp.asarray(program.numbers), tuple(jnp.asarray(x) for x in closed.consts)
        )
    if kept.again and found is not None and not is_traced(found):
        kept.now, kept.found = now, (found, shape)
    kept.again = True
    return found, shape


class _Trace:
    """Last trace of a function, and the values that it read then."""

    def __init__(self) -> None:
        self.again = False
        self.now: Hashable = None
        self.found: tuple[FunctionOfTime | None, object] = (None, None)
        self.program: TimeProgram | None = None


@lru_cache(maxsize=64)
def _trace(function: Callable) -> _Trace:
    return _Trace()


def for_programs(f: Callable, options: Callable | None = None) -> Callable[[Hashable], Callable]:
    """Return a function that compiles `f` for given input programs. The 16 most recently used are kept."""
    return lru_cache(maxsize=16)(lambda programs: compiled(f, options))
