"""A function by two ways of computing it: one for this process and its CPU, and one for programs that run elsewhere.

Which of them a program takes is known when JAX lowers it: for other devices, and where it is exported and so may run in another process, it takes the
other way, which is traced only then.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

PLATFORMS: dict[str, Callable[[], bool]] = {"cpu": lambda: True}  # of JAX, and whether programs for it may take the first way


def or_elsewhere(here: Callable, elsewhere: Callable) -> Callable:
    """`here`, with `elsewhere` in its place in programs for other devices, and in those that are exported. Both compute the same.

    They take trees of arrays and of anything else, and return trees of arrays. JAX differentiates the result where it does both, forwards alone.
    """

    def run(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        leaves, treedef = jax.tree.flatten(arrays)
        kept: list = []  # what is returned, without its arrays

        def on_leaves(function):
            def flat(*leaves):
                arrays, others = eqx.partition(function(*eqx.combine(jax.tree.unflatten(treedef, leaves), rest)), _is_array)
                found, structure = jax.tree.flatten(arrays)
                kept[:] = structure, others
                return found

            return flat

        found = _bound(on_leaves(here), on_leaves(elsewhere), leaves)
        structure, others = kept
        return eqx.combine(jax.tree.unflatten(structure, found), others)

    return run


def _is_array(x) -> bool:
    """Whether x is an array; the tangent of an integer is none."""
    return eqx.is_array_like(x) and jnp.result_type(x) != jax.dtypes.float0


def _bound(here: Callable, elsewhere: Callable, values: Sequence) -> list:
    traced = jax.make_jaxpr(here)(*values)
    count = len(traced.consts)  # what `here` closes over is handed on, too: it may be traced
    return _either_p.bind(*traced.consts, *values, here=traced.jaxpr, elsewhere=lambda *values: elsewhere(*values[count:]))


def _as_function(here: Jaxpr) -> Callable:
    count = len(here.constvars)
    return lambda *values: jaxpr_as_fun(ClosedJaxpr(here, values[:count]))(*values[count:])


def _lowered(ctx, *values, here, elsewhere):
    module = ctx.module_context
    if all(x in PLATFORMS and PLATFORMS[x]() for x in module.platforms) and len(module.platforms) == 1 and not module.lowering_parameters.for_export:
        return mlir.lower_fun(_as_function(here))(ctx, *values)

    def of_same_types(*values):
        return [jnp.asarray(x, v.aval.dtype) for x, v in zip(elsewhere(*values), here.outvars, strict=True)]

    return mlir.lower_fun(of_same_types)(ctx, *values)


def _batched(values, axes, *, here, elsewhere):
    some = all(x.shape[axis] != 0 for x, axis in zip(values, axes, strict=True) if axis is not None)
    has_lanes = [not some] * len(here.outvars)  # found while `here` is traced; without lanes there is no first one to take what all share from

    @jax.custom_batching.custom_vmap
    def watched(*found):
        return found

    @watched.def_vmap
    def watch(_, batched, *found):
        has_lanes[:] = batched if some else has_lanes
        return found, tuple(batched)

    def mapped(function, watched):
        of_lanes = jax.vmap(lambda *values: list(watched(*function(*values))), axes)
        return lambda *values: [x if has else jax.lax.index_in_dim(x, 0, keepdims=False) for x, has in zip(of_lanes(*values), has_lanes, strict=True)]

    found = _bound(mapped(_as_function(here), watched), mapped(elsewhere, lambda *found: found), values)
    return found, [0 if has else None for has in has_lanes]


def _pushed(primals, tangents, *, here, elsewhere):
    moving = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]
    count = len(primals)

    def pushed(function):
        def with_tangents(*values):
            def of_moving(*moved):
                return list(function(*[dict(zip(moving, moved, strict=True)).get(i, x) for i, x in enumerate(values[:count])]))

            found, rates = jax.jvp(of_moving, [values[i] for i in moving], list(values[count:]))
            return [*found, *filter(_is_array, rates)]

        return with_tangents

    both = _bound(pushed(_as_function(here)), pushed(elsewhere), [*primals, *(tangents[i] for i in moving)])
    found, rates = both[: len(here.outvars)], iter(both[len(here.outvars) :])
    avals = [v.aval for v in here.outvars]
    return found, [next(rates) if jnp.issubdtype(x.dtype, jnp.inexact) else ad.Zero(x.to_tangent_aval()) for x in avals]


def _computed(*values, here, elsewhere):
    """What is computed at once, without a program."""
    on_cpu = all(device.platform == "cpu" for x in values if isinstance(x, jax.Array) for device in x.devices())
    return _as_function(here)(*values) if on_cpu else elsewhere(*values)


_either_p = Primitive("jourdain_or_elsewhere")
_either_p.multiple_results = True
_either_p.is_high = lambda *_, **__: False  # what JAX 0.12 still has to lower in a program, it lowers where that is written
_either_p.def_impl(_computed)
_either_p.def_abstract_eval(lambda *_, here, elsewhere: [v.aval for v in here.outvars])
mlir.register_lowering(_either_p, _lowered)
batching.primitive_batchers[_either_p] = _batched
ad.primitive_jvps[_either_p] = _pushed
