"""JAX calls in a graph of scalars: the parts of a traced function that have no scalar form.

    array   scalars combined into an array    opaque  the results of a `Call` of arrays
    output  one of these results              entry   one of its entries, again a scalar

Values may have batch axes, which come last.

`interpret_with_calls` keeps parts of a jaxpr without scalar form as calls of JAX. An equation without a rule
is opaque. Equations that exchange large arrays with it, and equations between two opaque ones, become opaque
as well, so a neural network is one call. Each equation has a level:

    of scalars        the largest level of its operands
    opaque            the same, but one more than the level of a scalar operand

Connected opaque equations of one level form one call.
"""

import functools
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jourdain_jax.calculus.jaxprs import called, evaluated, loops, needed_only
from jourdain_jax.calculus.reals import is_array
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, Value, apply, refuse


class Call:
    """A closed jaxpr that is kept as a call, and the reasons for it. Calls with the same
    operations are equal.
    """

    def __init__(self, closed, reasons: tuple[str, ...]):
        self.closed, self.reasons = closed, reasons
        self._described = description(closed)
        # distinguishes calls of different functions
        self._hash, self.name = hash(self._described), repr(self._described)
        # on NumPy, operands and results with a leading axis of probes
        self.at_probes = uncompiled_lanes(jaxpr_as_fun(closed))

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, Call) and self._described == other._described

    @property
    def reason(self) -> str:
        """Return the reason for the call, as a noun phrase."""
        return " and ".join(self.reasons)

    @property
    def loop(self) -> str:
        """Return the name of the first loop in the call, or an empty string."""
        return next(loops(self.closed.jaxpr), "")

    @functools.cache  # noqa: B019  (calls are few, and live as long as their graph)
    def slopes(self, moves: tuple[tuple[bool, ...], ...]) -> "Call":
        """Return a call that computes the derivatives of each result. Their first axis runs over the entries
        of the operands that vary. Raises `Unsupported` if JAX has no forward derivative.
        """
        function, avals = jaxpr_as_fun(self.closed), [v.aval for v in self.closed.jaxpr.invars]
        places = [(k, i) for k, of_operand in enumerate(moves) for i, does in enumerate(of_operand) if does]

        def columns(*operands):
            def along(k, i):
                directions = [
                    np.zeros(x.shape, x.dtype if np.issubdtype(x.dtype, np.floating) else jax.dtypes.float0)
                    for x in avals
                ]
                directions[k].flat[i] = 1
                return jax.jvp(function, operands, tuple(directions))[1]

            found = zip(*(along(k, i) for k, i in places), strict=True)
            return [
                jnp.stack(dx) if np.issubdtype(a.dtype, np.floating) else jnp.zeros(0)
                for dx, a in zip(found, self.closed.out_avals, strict=True)
            ]

        try:
            closed = jax.make_jaxpr(columns)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals))
        except (TypeError, ValueError, NotImplementedError):
            raise Unsupported(f"the derivative of {self.reason}") from None
        return Call(closed, self.reasons)

    def results(self, *operands) -> tuple:
        """Return the results of the call; operands and results may have trailing batch axes."""
        function = jaxpr_as_fun(self.closed)
        avals = [v.aval for v in self.closed.jaxpr.invars]
        real = [x.dtype for x in operands if jnp.issubdtype(x.dtype, jnp.floating)]
        operands = [jnp.asarray(x, a.dtype) for x, a in zip(operands, avals, strict=True)]
        lanes = jnp.broadcast_shapes(*(x.shape[a.ndim :] for x, a in zip(operands, avals, strict=True)))
        axes = tuple(None if x.ndim == a.ndim else -1 for x, a in zip(operands, avals, strict=True))
        operands = [
            x if axis is None else jnp.broadcast_to(x, (*a.shape, *lanes))
            for x, a, axis in zip(operands, avals, axes, strict=True)
        ]
        for _ in lanes:
            function = jax.vmap(function, in_axes=axes, out_axes=-1)
        try:
            found = function(*operands)
        except NotImplementedError as error:
            if not lanes or "vmap" not in str(error):
                raise
            raise NotImplementedError(
                f"a callback in a load or stop event does not support batches: {str(error).splitlines()[0]}"
            ) from None
        return tuple(
            jnp.asarray(x, jnp.result_type(*real)) if real and jnp.issubdtype(x.dtype, jnp.floating) else x
            for x in found
        )


def _array(shape_and_type, *entries):
    shape, dtype = shape_and_type
    lanes = jnp.broadcast_shapes(*map(jnp.shape, entries))
    stacked = jnp.stack([jnp.broadcast_to(x, lanes) for x in entries])
    return (stacked if np.dtype(dtype).kind == "f" else stacked.astype(dtype)).reshape(*shape, *lanes)


def _output(which, results):
    return results[which[0]]


def _entry(index, x):
    number, dimensions = index
    return jax.lax.index_in_dim(x.reshape(-1, *x.shape[dimensions:]), number, keepdims=False)


EMITTED: dict[str, Callable] = {
    "array": _array,
    "opaque": lambda call, *operands: call.results(*operands),
    "output": _output,
    "entry": _entry,
}


AT_PROBES: dict[str, Callable] = {
    "array": lambda about, *entries: np.stack(entries, axis=-1).reshape(-1, *about[0]).astype(about[1]),
    "opaque": lambda call, *operands: call.at_probes(*operands),
    "output": _output,
    "entry": lambda index, x: x.reshape(len(x), -1)[:, index[0]],
}


_SEVERAL = tuple, list  # defined once, because writing a union creates a new type each time


def description(x) -> Hashable:
    """Return a hashable key of a jaxpr or of a primitive's parameter. Two traces of a function have equal
    keys, unless it creates other functions.
    """
    if isinstance(x, _SEVERAL):
        return tuple(map(description, x))
    if isinstance(x, dict):
        return tuple((key, description(value)) for key, value in sorted(x.items()))
    if hasattr(x, "consts"):  # from JAX 0.12 on, every jaxpr has them
        return "closed", _of_jaxpr(x.jaxpr), tuple(map(description, x.consts))
    if hasattr(x, "eqns"):
        return _of_jaxpr(x)
    if (is_array(x) and not np.asarray(x).dtype.hasobject) or isinstance(x, float):
        return str(np.asarray(x).dtype), np.shape(x), np.asarray(x).tobytes()
    try:
        hash(x)
    except TypeError:
        return id(x)
    return x


def _of_jaxpr(x) -> Hashable:
    number = {v: k for k, v in enumerate([*x.constvars, *x.invars])}
    atom = lambda v: description(np.asarray(v.val, v.aval.dtype)) if isinstance(v, Literal) else number[v]
    lines: list = [tuple(v.aval for v in number)]
    for equation in x.eqns:
        inputs = tuple(map(atom, equation.invars))
        number |= {v: len(number) + k for k, v in enumerate(equation.outvars)}
        lines.append(
            (
                equation.primitive,
                inputs,
                description(equation.params),
                tuple(v.aval for v in equation.outvars),
            )
        )
    return *lines, tuple(map(atom, x.outvars))


LARGEST = 4096  # tuning: maximum number of entries of an array of scalars


class _Variable:
    """A value, or a placeholder for one."""

    __slots__ = ("aval",)

    def __init__(self, aval):
        self.aval = aval

    @property
    def is_large(self) -> bool:
        # next to a call, larger arrays are not split into scalars
        return self.aval.size > 16

    @property
    def may_be_scalars(self) -> bool:
        kind = np.issubdtype(self.aval.dtype, np.floating) or self.aval.dtype == bool
        return bool(kind) and self.aval.size <= LARGEST


@dataclass(eq=False)
class _Step:
    """Equation whose inputs are variables or numbers."""

    equation: Any
    around: Any  # the enclosing jaxpr
    inputs: list
    outputs: list[_Variable]
    opaque: bool = False
    reason: str = ""
    level: int = 0
    part: "list[_Step]" = field(default_factory=list)

    @property
    def variables(self) -> list[_Variable]:
        return [x for x in self.inputs if isinstance(x, _Variable)]

    def results(self, inputs: list) -> list:
        """Return JAX's results for the inputs."""
        given = {
            v: x for v, x in zip(self.equation.invars, inputs, strict=True) if not isinstance(v, Literal)
        }
        alone = self.around.replace(
            constvars=[], invars=list(given), outvars=list(self.equation.outvars), eqns=[self.equation]
        )
        return jaxpr_as_fun(ClosedJaxpr(alone, []))(*given.values())


@dataclass(frozen=True)
class _Opaque:
    """A value without scalar form: the node of an array."""

    node: int


def interpret_with_calls(graph: Graph, closed, arguments: list[Nodes]) -> list[Value]:
    """Return the outputs of a closed jaxpr as `interpret`, with calls for parts that have no scalar form."""
    inputs: list[_Variable] = [_Variable(v.aval) for v in closed.jaxpr.invars]
    steps: list[_Step] = []
    outputs = _flat(needed_only(closed), inputs, steps)
    numbers = _judged(Graph(graph.most_multiplications, graph.keeps_rules), steps, inputs)
    steps = [step for step in steps if any(v not in numbers for v in step.outputs)]
    for step in steps:
        step.inputs = [numbers.get(x, x) if isinstance(x, _Variable) else x for x in step.inputs]
    users = _users(steps)
    asked = {v for v in outputs if isinstance(v, _Variable)}
    _put_together(steps, users, asked)
    values: dict = dict(zip(inputs, arguments, strict=True)) | numbers
    # by level, scalars last, otherwise in their original order
    for step in sorted(steps, key=lambda step: (step.level, not step.opaque)):
        if not step.opaque:
            results = apply(
                graph, step.equation, [values[x] if isinstance(x, _Variable) else x for x in step.inputs]
            )
            values |= dict(zip(step.outputs, results, strict=True))
        elif step is step.part[0]:
            values |= _called(graph, step.part, values, users, asked)
    return [values[x] if isinstance(x, _Variable) else x for x in outputs]


def _flat(closed: ClosedJaxpr, arguments, steps: list[_Step]) -> list:
    """Append all equations to `steps`, including those of inner jaxprs without a custom derivative; return
    the outputs.
    """

    def results(equation, inputs: list) -> list:
        name = equation.primitive.name
        refuse(equation)
        inner = None if name.startswith("custom_") else called(name, equation.params)
        if inner is not None:
            return _flat(inner, inputs, steps)
        steps.append(_Step(equation, closed.jaxpr, inputs, [_Variable(v.aval) for v in equation.outvars]))
        return steps[-1].outputs

    return evaluated(closed, arguments, results)


def _judged(scratch: Graph, steps: list[_Step], inputs: list[_Variable]) -> dict:
    """Find the steps without scalar form by trial and mark them as opaque; return the known numbers."""
    values: dict = {}

    def introduce(v: _Variable) -> Nodes | None:
        """Return new symbols if a variable may be scalars."""
        if not v.may_be_scalars:
            return None
        names = [f"{len(scratch.op)}_{i}" for i in range(v.aval.size)]
        return Nodes(np.array([scratch.input(name, True) for name in names], np.int64).reshape(v.aval.shape))

    for v in inputs:
        values[v] = introduce(v)
    for step in steps:
        given = [values[x] if isinstance(x, _Variable) else x for x in step.inputs]
        size = max((v.aval.size for v in step.outputs), default=0)
        try:
            if any(x is None for x in given):
                raise Unsupported("")  # follows an opaque step
            if size > LARGEST and any(isinstance(x, Nodes) for x in given):
                raise Unsupported(f"an array of {size} numbers")
            results = apply(scratch, step.equation, given)
        except Unsupported as reason:
            step.opaque, step.reason = True, str(reason)
            results = [introduce(v) for v in step.outputs]
        values |= dict(zip(step.outputs, results, strict=True))
    return {v: x for v, x in values.items() if isinstance(x, np.ndarray)}


def _users(steps: list[_Step]) -> dict[_Variable, list[_Step]]:
    """Return the steps that need each variable."""
    users: dict[_Variable, list[_Step]] = {}
    for step in steps:
        for v in dict.fromkeys(step.variables):
            users.setdefault(v, []).append(step)
    return users


def _put_together(steps: list[_Step], users: dict[_Variable, list[_Step]], asked: set[_Variable]) -> None:
    """Extend opaque steps to their large neighbours, assign levels, and group the steps of each call."""
    maker = {v: step for step in steps for v in step.outputs}
    number = {id(step): k for k, step in enumerate(steps)}

    def from_opaque(step: _Step) -> list[_Variable]:
        return [v for v in step.variables if v in maker and maker[v].opaque]

    for step in steps:
        step.opaque = step.opaque or any(v.is_large for v in from_opaque(step))
    for step in reversed(steps):
        inside = all(
            v not in asked and v in users and all(user.opaque for user in users[v]) for v in step.outputs
        )
        beside = any(v.is_large for v in step.outputs) or bool(from_opaque(step))
        step.opaque = step.opaque or (inside and beside)
    for step in steps:
        made_by = [maker[v] for v in step.variables if v in maker]
        if not step.opaque:
            step.level = max((other.level for other in made_by), default=0)
            continue
        step.level = max((other.level + (not other.opaque) for other in made_by), default=1)
        step.part = [step]
        for other in made_by:
            if other.opaque and other.level == step.level and other.part is not step.part:
                joined = sorted([*other.part, *step.part], key=lambda member: number[id(member)])
                for member in joined:
                    member.part = joined


def _called(
    graph: Graph, part: list[_Step], values: dict, users: dict[_Variable, list[_Step]], asked: set[_Variable]
) -> dict:
    """Add the call of a part to the graph; return the values of its results."""
    made = [v for step in part for v in step.outputs]
    operands = [v for v in dict.fromkeys(v for step in part for v in step.variables) if v not in made]
    results = [v for v in made if v in asked or any(user.part is not part for user in users.get(v, ()))]
    given = [(values[v], v.aval) for v in operands]
    arrays = [
        x.node if isinstance(x, _Opaque) else graph.array(x.ids.ravel().tolist(), aval.shape, str(aval.dtype))
        for x, aval in given
    ]
    found = graph.results(
        graph.opaque(_call(part, operands, results), arrays),
        {k: (v.aval.shape, str(v.aval.dtype)) for k, v in enumerate(results)},
    )
    taken_apart = [v in asked or not all(user.opaque for user in users[v]) for v in results]
    return {
        v: Nodes(graph.entries(node)) if apart else _Opaque(node)
        for v, node, apart in zip(results, found, taken_apart, strict=True)
    }


def _call(part: list[_Step], operands: list[_Variable], results: list[_Variable]) -> Call:
    """Return the part as a call of its operands."""

    def function(*arrays):
        known = dict(zip(operands, arrays, strict=True))
        for step in part:
            given = [known[x] if isinstance(x, _Variable) else x for x in step.inputs]
            known |= dict(zip(step.outputs, step.results(given), strict=True))
        return [known[v] for v in results]

    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in operands))
    reasons = tuple(dict.fromkeys(step.reason for step in part if step.reason))
    return Call(closed, reasons or ("a result of arrays of another call",))
