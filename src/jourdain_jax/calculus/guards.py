"""Markers that turn a mode of differentiation that cannot work into an error of our own that says what to do.

`reverse_only(x)` is the identity. Reverse mode passes; forward mode raises when the tangent is evaluated or compiled, and a
second derivative raises when it is taken. `forward_only(x)` is the identity; its transpose raises. Mark the inputs of a reverse-only
program and the outputs of a forward-only one: that is where the wrong mode arrives first.
The tangent goes through a primitive of its own, because only a primitive is seen after JAX has decided which mode it is in: a
reverse pass transposes it away, a forward pass has to evaluate or lower it.
"""

import equinox as eqx
import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.identities import identity

FORWARD_MESSAGE = (
    "`simulate` was differentiated in forward mode (jvp, jacfwd, hessian), but its adjoint is reverse-only. "
    'Leave `adjoint` at its default for both modes where machine code integrates (not with `backend="xla"` or in exported programs); elsewhere '
    "pass `adjoint=diffrax.ForwardMode()` for forward mode (cheapest for up to about 30 parameters), or use reverse mode (jax.grad, jax.vjp)."
)
SECOND_ORDER_MESSAGE = (
    "`simulate` was differentiated twice, but its adjoint supports first derivatives in reverse mode only. "
    'Leave `adjoint` at its default for second derivatives in any mode where machine code integrates (not with `backend="xla"` or in exported programs); pass '
    "`adjoint=diffrax.ForwardMode()` for forward-over-forward (jax.jacfwd(jax.jacfwd(f))) elsewhere."
)
THIRD_ORDER_MESSAGE = (
    "`simulate` was differentiated three times, and not in forward mode alone. Pass `backend='xla'` and `adjoint=diffrax.ForwardMode()` for forward mode of "
    "any order (jax.jacfwd(jax.jacfwd(jax.jacfwd(f))))."
)
REVERSE_MESSAGE = (
    "`simulate` was differentiated in reverse mode (grad, vjp, jacrev), but its adjoint is forward-only. "
    "Leave `adjoint` at its default, or pass `diffrax.RecursiveCheckpointAdjoint()`, for reverse mode."
)


class DifferentiationModeError(TypeError):
    """The adjoint given to `simulate` does not support the mode of differentiation that was asked; the text says which adjoint does.

    Raised where the derivative is taken, evaluated or compiled; and by functions that need numbers, such as `fit`, inside `jit`, `vmap` or a derivative.
    """


class OtherDeviceError(RuntimeError):
    """Raised where machine code would become part of a program for another process, or for a device without machine code."""

    def __init__(self, program: str) -> None:
        super().__init__(f'machine code of this process cannot be part of a program {program}; give `backend="xla"` to `jj.simulate`, or to `jj.build`')


def _raise_forward(*args, **kwargs):
    raise DifferentiationModeError(FORWARD_MESSAGE)


def _raise_reverse(*args, **kwargs):
    raise DifferentiationModeError(REVERSE_MESSAGE)


def _raise_second(*args, **kwargs):
    raise DifferentiationModeError(SECOND_ORDER_MESSAGE)


_reverse_only_p = identity("jourdain_reverse_only")
_first_order_only_p = identity("jourdain_first_order_only")
_forward_only_p = identity("jourdain_forward_only")

# The tangent in reverse-only programs: it can be transposed, but neither evaluated nor compiled. It exists only after differentiation, so that
# a batching rule meets it only in programs that were pushed forward (jacfwd, vmap of jvp). It is given the value, too: where that alone has lanes, what
# follows would be batched first, and answer in JAX's words.
_tangent_p = Primitive("jourdain_reverse_only_tangent")
_tangent_p.def_impl(_raise_forward)
_tangent_p.def_abstract_eval(lambda tangent, value: tangent)
mlir.register_lowering(_tangent_p, _raise_forward)
batching.primitive_batchers[_tangent_p] = _raise_forward
ad.primitive_jvps[_tangent_p] = _raise_forward
ad.primitive_transposes[_tangent_p] = lambda cotangent, tangent, value: [cotangent, None]

ad.primitive_jvps[_reverse_only_p] = lambda primals, tangents: (_first_order_only_p.bind(*primals), [_push(tangents[0], *primals)])
ad.primitive_jvps[_first_order_only_p] = _raise_second
ad.deflinear2(_forward_only_p, _raise_reverse)


def _push(tangent, value):
    return tangent if type(tangent) is ad.Zero else _tangent_p.bind(tangent, value)


def _on_floats(marker: Primitive, tree):
    return jax.tree.map(lambda x: marker.bind(x)[0] if eqx.is_inexact_array(x) else x, tree)


def reverse_only(tree):
    """The identity on a pytree; forward mode and second derivatives through it raise `DifferentiationModeError`."""
    return _on_floats(_reverse_only_p, tree)


def forward_only(tree):
    """The identity on a pytree; reverse mode through it raises `DifferentiationModeError`."""
    return _on_floats(_forward_only_p, tree)
