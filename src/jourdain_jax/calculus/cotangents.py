"""Taps: identities that call a Python function with the derivatives that pass through them.

`tap_cotangents(values, look)` hands `look` the cotangents in reverse mode. `tap_tangents(values, look)` hands it the tangents in forward mode, with a first
axis of directions. Both act outside of `jit` only, where derivatives are numbers: no compiled program calls back to Python.
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.interpreters import ad, batching

from jourdain_jax.calculus.identities import identity

_shown_p, _forwards_p, _tangents_p = (identity(f"jourdain_shown_{name}") for name in ("backwards", "forwards", "tangents"))


def _transposed(cotangents, *values, look: Callable):
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    if not any(isinstance(ct, jax.core.Tracer) for ct in cotangents):
        look([np.asarray(ct) for ct in cotangents])
    return cotangents


ad.deflinear2(_shown_p, _transposed)


def _pushed(primals, tangents, *, look: Callable):
    tangents = [ad.instantiate_zeros(tangent) for tangent in tangents]
    return _forwards_p.bind(*primals, look=look), _tangents_p.bind(*tangents, look=look)


def _seen(*tangents, look: Callable):
    look([np.asarray(tangent)[None] for tangent in tangents])
    return list(tangents)


def _seen_in_batch(tangents, dims, *, look: Callable):
    """Several directions at once, of `jacfwd`."""
    if not any(isinstance(tangent, jax.core.Tracer) for tangent in tangents):
        look([np.asarray(x)[None] if dim is None else np.moveaxis(np.asarray(x), dim, 0) for x, dim in zip(tangents, dims, strict=True)])
    return list(tangents), dims


_tangents_p.def_impl(_seen)
batching.primitive_batchers[_tangents_p] = _seen_in_batch
ad.primitive_jvps[_forwards_p] = _pushed
ad.deflinear2(_tangents_p, lambda cotangents, *values, look: [ad.instantiate_zeros(ct) for ct in cotangents])
ad.primitive_jvps[_tangents_p] = lambda primals, tangents, *, look: (_tangents_p.bind(*primals, look=look), list(tangents))


def tap_tangents(values: tuple, look: Callable) -> tuple:
    """`values`, a tuple of arrays; `look` is called with the list of their tangents, with a first axis of directions, where these are numbers."""
    return tuple(_forwards_p.bind(*values, look=look))


def tap_cotangents(values: tuple, look: Callable) -> tuple:
    """`values`, a tuple of arrays; `look` is called with the list of their cotangents where these are numbers."""
    return tuple(_shown_p.bind(*values, look=look))
