"""Call LLVM modules as JAX functions, to compute values of graph nodes and the quantities of a motion that
are needed outside its steps.

Arguments have no batch axis; under `vmap`, one call computes the whole batch. A batch runs in the widest
registers, a single sample in narrow, faster ones. Results do not depend on the width.

    o = f(x),   f'(x) v,   g f'(x),   f''(x) w v,   g f''(x) v          o: values of nodes, x: of variables

Each of these expressions is separate machine code, compiled when it is needed; derivatives are computed on
the graph. If a program is too large, JAX differentiates the program as run by XLA.

Quantities outside the steps are numbers that depend only on parameters, and all speeds, pivots and energies
at saved states. XLA differentiates speeds with few operations (`lowering/lowered_equations.py`).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jourdain_jax.calculus.derivative_errors import OtherDeviceError
from jourdain_jax.calculus.derivatives import (
    Rules,
    differentiated_as,
    filled,
    is_zero,
    with_derivatives_of,
    with_rules,
)
from jourdain_jax.calculus.markers import entries_of, lanes_of, stopped
from jourdain_jax.calculus.progress import all_objects_kept
from jourdain_jax.calculus.reals import Indices, Scalar, Speeds, real_type
from jourdain_jax.integrate.explicit_steps import off
from jourdain_jax.integrate.loop.lanes import MachineWriter, Operands
from jourdain_jax.kernels import ffi, gpu, host, nvidia
from jourdain_jax.kernels.ffi import write_rows
from jourdain_jax.kernels.scalar_program import as_real, unsupported, written_in_turn
from jourdain_jax.lowering.lowered_equations import Lowered, smallest_pivot
from jourdain_jax.program.derivative import cotangents, derivatives, on_its_own
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.scene.scene import Scene


def called(
    write: Callable[[MachineWriter], None],
    shapes: Callable,
    of_samples: int = 0,
    effort: int = 2,
    constant: Mapping[int, tuple[float, ...]] = MappingProxyType({}),
    counted: bool = False,
) -> Callable:
    """Return an LLVM module as a function of arrays without batch axis. `write`: writes the module; `shapes`:
    function from arguments to the shapes of results; `effort`: as for `host.object_code`.

    The first `of_samples` arguments belong to sampled inputs, and lanes may share them. The next argument is
    a sequence of vectors and numbers, the rows of a start; `constant`: its rows that are not passed.
    `counted`: the last argument is the number of trial steps, the size of the record on a GPU.
    """

    @cache
    @all_objects_kept()
    def handler(lanes: int, threads: int) -> str:
        w = MachineWriter(lanes, host.fuses(), threads)
        write(w)
        return ffi.registered(w.text, effort)

    @cache
    def kernel(shared: tuple[bool, ...]) -> gpu.Kernel:
        w = MachineWriter(1, True, device=True)
        w.common = shared
        write(w)
        return gpu.registered(w.text, w.record)

    def call(lanes: int, threads: int, batch: tuple[int, ...], ranks: tuple[int, ...], arguments: tuple):
        others = len(arguments) - of_samples - 1
        operands = Operands(batch, ranks, of_samples, others, tuple(constant.items()), counted)
        how = handler, kernel, lanes, threads, shapes, operands
        return tuple(_call_p.bind(*jax.tree.leaves(arguments), **dict(zip(_HOW, how, strict=True))))

    @jax.custom_batching.custom_vmap
    def run(*arguments):
        # 2 lanes for a single motion. Measured for 10 s of a disc at 1e-8: 64 us with 2 lanes, 66 with 1 or
        # 4, 99 with 8
        return call(2, 1, (), tuple(map(jnp.ndim, jax.tree.leaves(arguments))), arguments)

    @run.def_vmap
    def run_many(count, batched: list, *arguments):
        ranks = tuple(
            x.ndim - has_axis for x, has_axis in zip(*map(jax.tree.leaves, (arguments, batched)), strict=True)
        )
        found = call(host.lanes(), host.threads(), (count,), ranks, arguments)
        return found, (True,) * len(found)

    return run


def _results(*arguments, shapes: Callable, operands: Operands, **_) -> list:
    return [
        arguments[-1].update(shape=(*operands.batch, *shape), weak_type=False) for shape in shapes(*arguments)
    ]


def _more_lanes(values, axes, operands: Operands, **how) -> tuple[list, list]:
    """Return the call with one more leading batch axis. Operands without any batch axis do not get one."""
    count, every = lanes_of(values, axes), []
    for x, axis, rank in zip(values, axes, operands.ranks, strict=True):
        has_lanes = x.ndim - (axis is not None) > rank
        if axis is not None:
            x = jnp.moveaxis(x, axis, 0)
            x = x if has_lanes else jnp.expand_dims(x, tuple(range(1, 1 + len(operands.batch))))
        every.append(jnp.broadcast_to(x, (count, *x.shape)) if axis is None and has_lanes else x)
    found = _call_p.bind(*every, operands=operands._replace(batch=(count, *operands.batch)), **how)
    return found, [0] * len(found)


def _made(
    ctx: mlir.LoweringRuleContext, values: Sequence, make: Callable
) -> tuple[mlir.LoweringRuleContext, Sequence]:
    """Apply `make` to the operands of a call. Return the context of the new call, and its operands."""
    avals: list = []

    def noted(*values):
        avals.extend(map(jax.typeof, made := make(*values)))
        return made

    lowered = mlir.lower_fun(noted)(ctx.replace(primitive=None), *values)
    return ctx.replace(avals_in=avals), lowered


def on_cpu(
    ctx: mlir.LoweringRuleContext,
    *values,
    handler: Callable,
    lanes: int,
    threads: int,
    operands: Operands,
    **_,
):
    """Lower the call in a program for a CPU."""
    _check_here(ctx)
    ctx, arguments = _made(ctx, values, operands.side_by_side)
    return ffi.in_doubles(ctx, arguments, jax.ffi.ffi_lowering(handler(lanes, threads)))


def _on_nvidia(ctx: mlir.LoweringRuleContext, *values, kernel: Callable, operands: Operands, **_):
    """Lower the call in a program for an NVIDIA GPU."""
    _check_here(ctx)
    if reason := nvidia.reason_against():
        raise OtherDeviceError(f"for JAX's platform cuda, and {reason}")
    own = kernel(operands.shared(ctx.avals_in))
    ctx, arguments = _made(ctx, values, operands.given_once)
    return gpu.lowered(ctx, arguments, own, operands.batch, operands.samples)


def _nowhere(ctx: mlir.LoweringRuleContext, *_, **__):
    """Raise OtherDeviceError in programs for any other device."""
    raise OtherDeviceError(f"for JAX's platforms {', '.join(ctx.module_context.platforms)}")


def _check_here(ctx: mlir.LoweringRuleContext) -> None:
    """Raise OtherDeviceError in a program that is exported or for several platforms."""
    if ctx.module_context.lowering_parameters.for_export:
        raise OtherDeviceError("to be exported")
    if len(ctx.module_context.platforms) > 1:
        _nowhere(ctx)


# machine code is compiled when a program that contains this primitive is lowered, not when it is traced
_call_p = Primitive("jourdain_machine_code")
_call_p.multiple_results = True
_HOW = "handler", "kernel", "lanes", "threads", "shapes", "operands"
_call_p.def_impl(jax.jit(lambda *arguments, **how: _call_p.bind(*arguments, **how), static_argnames=_HOW))
_call_p.def_abstract_eval(_results)
mlir.register_lowering(_call_p, _nowhere)
mlir.register_lowering(_call_p, on_cpu, platform="cpu")
mlir.register_lowering(_call_p, _on_nvidia, platform="cuda")
batching.primitive_batchers[_call_p] = _more_lanes


def nodes_called(
    graph: Graph, nodes: Sequence[int], variables: Sequence[int], effort: int = 1, moved: Collection[int] = ()
) -> Callable[..., Array]:
    """Return a function from values of variables, in vectors and numbers, to values of nodes, by machine
    code. With `moved` variables, it also takes rtol and atol, and then returns the values for these variables
    increased by a tolerance (`off`).
    """
    states = 2 if moved else 1

    def write(w: MachineWriter) -> None:
        with w.procedure("row", "state found") as (state, found):
            known = {n: w.load(state, k) for k, n in enumerate(variables)}
            for i in range(states):
                for k, value in written_in_turn(w, graph, nodes, known):
                    w.store(as_real(w, value), found, k + i * len(nodes))
                errors = [w.load(state, len(variables) + k) for k in range(2)] if moved else ()
                known |= {n: off(w.where, w.magnitude, known[n], *errors) for n in moved}
        write_rows(w, len(variables) + 2 * (states - 1), states * len(nodes))

    kernel = called(write, lambda *_: ((states * len(nodes),),), effort=effort)
    return lambda *parts: kernel([jnp.asarray(x, real_type()) for x in parts])[0]


def values_of_nodes(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> Callable[..., Array]:
    """Return the same function as `nodes_called`, with derivatives. Nodes that are structurally zero cost
    nothing. An argument may be a pair of equal arrays: derivatives are with respect to the first; machine
    code takes the second, which may consist of parts that lanes share.
    """
    by_xla, by_machine_code = _both(graph, nodes, variables)
    there = np.flatnonzero([n != graph.zero for n in nodes])

    @cache
    def derivative(back: bool, order: int) -> Callable[..., Array] | None:
        """Return the derivative as a function of the parts of x, v or g, and w; None if it is too large or
        cannot be compiled to machine code.
        """
        own, of, by = on_its_own(graph, nodes, variables)  # derivatives add nodes to it
        weights = [own.input(f"v {i}", True) for i in range(len(there if back else by))]
        w = [own.input(f"w {i}", True) for i in range(len(by))]

        def along(nodes, direction: list[int]) -> list[int]:
            return derivatives(own, nodes, dict(zip(by, direction, strict=True)))

        try:
            first = along(of, w) if order == 2 else of
            found = cotangents(own, [first[i] for i in there], weights, by) if back else along(first, weights)
        except Unsupported:
            return None
        # limit on operations; machine code of this size takes 2.4 MB of stack and 1 s to compile
        if unsupported(own, found) or own.operations(found) > 70_000:
            return None
        return differentiated_as(*_both(own, found, [*by, *weights, *(w if order == 2 else ())]))

    def linear(back: bool) -> Callable[[tuple, tuple, tuple], Array]:
        """Return the Jacobian-vector product as a function of `plain`, x and v, or, with `back`, the
        vector-Jacobian product as a function of `plain`, x and g. Its derivative along x is machine code if
        possible.
        """

        def taken(v: tuple) -> tuple:
            return tuple(g[there] for g in v) if back else v

        @jax.custom_jvp
        def first(plain: tuple, x: tuple, v: tuple):
            if (by_graph := derivative(back, 1)) is not None:
                return by_graph(plain, *x, *taken(v))
            own = partial(by_xla, plain)
            return jnp.hstack(jax.vjp(own, *x)[1](*v)) if back else jax.jvp(own, x, v)[1]

        @partial(first.defjvp, symbolic_zeros=True)
        def rule(at, tangents):
            (plain, x, v), (dx, dv) = at, (tuple(map(filled, part)) for part in tangents[1:])
            still, found = all(map(is_zero, tangents[1])), first(*at)
            second = None if still else derivative(back, 2)
            if not still and second is None:
                return jax.jvp(partial(first.fun, plain), at[1:], (dx, dv))
            rates = [] if all(map(is_zero, tangents[2])) else [first(plain, x, dv)]
            rates += [second(plain, *x, *taken(v), *dx)] if second else []
            return found, sum(rates[1:], rates[0]) if rates else jnp.zeros_like(found)

        return first

    along, back = linear(False), linear(True)

    def push(at: tuple, tangents: tuple):
        plain, *x = at
        v = tuple(jnp.zeros_like(a) if d is None else d for a, d in zip(x, tangents[1:], strict=True))
        return values(*at), along(plain, tuple(x), v)

    def pull(perturbed, at: tuple, found, g):
        plain, *x = at
        parts = jnp.split(back(plain, tuple(x), (g,)), np.cumsum([a.size for a in x])[:-1])
        return plain, *(part.reshape(a.shape) for part, a in zip(parts, x, strict=True))

    values = with_rules(by_machine_code, Rules(push, pull))

    def with_plain(*parts):
        parts = jax.tree.map(lambda x: jnp.asarray(x, real_type()), parts)
        pairs = [(part[0], part[-1]) if isinstance(part, tuple) else (part, part) for part in parts]
        x, plain = zip(*pairs, strict=True)
        return values(stopped(plain), *x)

    return with_plain


def _both(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> tuple[Callable, Callable]:
    """Return two functions from parts of x to values of nodes, by XLA and by machine code. Both first take
    `plain`, parts without derivatives, for machine code, which returns only nonzero nodes to save stack.
    """
    number = {n: k for k, n in enumerate(dict.fromkeys(n for n in nodes if n != graph.zero))}
    which = np.array([number.get(n, len(number)) for n in nodes], int)
    in_order = np.array_equal(which, np.minimum(np.arange(len(which)), len(number)))  # then zeros
    kernel = nodes_called(graph, list(number), variables, effort=0)

    def placed(found):
        padded = jnp.append(found, jnp.zeros(len(which) - len(number) if in_order else 1))
        return padded if in_order else padded[which]

    def by_xla(plain, *parts):
        x = jnp.hstack(parts)
        values = run(graph, list(number), dict(zip(variables, x, strict=True)))
        found = [jnp.asarray(value, x.dtype) for value in values]
        return placed(jnp.stack(found) if found else x[:0])

    return by_xla, lambda plain, *parts: placed(kernel(*jax.tree.leaves(plain), *parts[len(plain) :]))


@dataclass(frozen=True, eq=False)
class Beside:
    """Machine code for quantities outside the steps of a motion, as functions of fixed values, time,
    coordinates, independent speeds and inputs.
    """

    program: Lowered
    needed: tuple[Indices, ...]  # nodes of the parameters' entries that fixed values need, -1 for others
    fixed: Callable[[Array], Array]  # fixed values from these entries
    speeds: Callable[..., Array]  # all speeds, with derivatives
    numbers: Callable[..., Array]  # all speeds and pivots, without derivatives
    energies: Callable[..., Array]  # energies at a state, then with `off` applied to it; without derivatives
    at_start: Callable[..., Array]  # `Lowered.at_start`

    def fixed_values(self, *scenes: Scene) -> tuple[Scalar, ...]:
        """Return the values of `Lowered.fixed_values`. `scenes`: a scene and, if lanes may share its numbers,
        the same scene without derivatives.
        """
        parameters = [*zip(*(entries(scene, self.needed) for scene in scenes), strict=True)]
        if not self.program.fixed or not parameters:  # no fixed values, or none that depends on parameters
            return self.program.fixed_values(scenes[0])
        return entries_of(self.fixed(*parameters))

    def speeds_and_pivot(self, plain: tuple, *state) -> tuple[Speeds, Scalar | None]:
        """Return the values of `Lowered.speeds_and_pivot`. `plain`: as in `VectorField.speeds_and_pivot`."""
        found, count = self.numbers(plain, *state[1:]), len(self.program.speeds)
        pairs = tuple(zip(state[0], plain, strict=True))
        u = with_derivatives_of(lambda _, *state: self.speeds(*state), found[:count], pairs, *state[1:])
        return u, smallest_pivot(found[count:])


@lru_cache(maxsize=64)
def beside(program: Lowered) -> Beside | None:
    """Return the machine code for quantities outside the steps; None if it cannot be compiled."""
    graph, nodes = program.graph, [*program.z, *program.pivots, *program.energies, *program.fixed]
    # limit of 60_000 operations
    if graph.operations(nodes) > 60_000 or unsupported(graph, nodes):
        return None
    used = set(graph.reachable(program.fixed))
    needed = tuple(
        tuple(n if n in used else -1 for n in np.ravel(leaf).tolist()) for leaf in program.traced.parameters
    )
    given = [n for leaf in needed for n in leaf if n >= 0]
    every = [*(int(program.traced.u[k]) for k in program.independent), *program.z]
    u = [every[i] for i in np.argsort([*program.independent, *program.dependent])]
    numbers = _at_state(program, [*u, *program.pivots], nodes_called)
    state = {*program.traced.q.tolist(), *(int(program.traced.u[k]) for k in program.independent)}
    energies = _at_state(program, program.energies, partial(nodes_called, moved=state))
    # From 100 operations on, derivatives of speeds are machine code. Times of gradients in ms, by XLA and by
    # machine code: 256 bicycles (460 operations) 85 and 72; 1,024 chains of 4 trailers (124) 111 and 108; 256
    # rattlebacks (70) 29 and 42.
    return Beside(
        program,
        needed,
        values_of_nodes(graph, program.fixed, given),
        _at_state(program, u, values_of_nodes)
        if graph.operations(program.z) >= 100
        else lambda fixed, *others: program.all_speeds([x for x, _ in fixed], *others),
        lambda *state: numbers(*stopped(state)),
        lambda *state: energies(*stopped(state)),
        _at_state(program, program.at_start, values_of_nodes),
    )


def _at_state(program: Lowered, nodes: Sequence[int], function: Callable) -> Callable[..., Array]:
    """Return `function` of these nodes, which passes only those fixed values on which the nodes depend."""
    used = set(program.graph.reachable(nodes))
    which = [k for k, n in enumerate(program.fixed) if n in used]
    run = function(
        program.graph, nodes, [*(program.fixed[k] for k in which), *program.variables[len(program.fixed) :]]
    )
    return lambda fixed, *others: run(*(fixed[k] for k in which), *others)


def entries(scene: Scene, nodes: Sequence[Sequence[int]]) -> list[Array]:
    """Return the entries of a scene's parameters that have a node, as flat arrays. `nodes`: for each leaf the
    node of each entry, -1 for none.
    """
    found = []
    for leaf, of_leaf in zip(jax.tree.leaves(scene), nodes, strict=True):
        needed = np.flatnonzero(np.ravel(np.asarray(of_leaf, int)) >= 0)
        if needed.size:
            flat = jnp.reshape(jnp.asarray(leaf, real_type()), (-1,))
            found.append(flat if needed.size == flat.shape[0] else flat[needed])
    return found
