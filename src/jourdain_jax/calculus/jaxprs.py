"""What JAX traced, without the operations that nobody asks for."""

from collections.abc import Sequence

from jax.extend.core import ClosedJaxpr
from jax.interpreters.partial_eval import dce_jaxpr


def needed_only(closed: ClosedJaxpr, outputs: Sequence[int] | None = None) -> ClosedJaxpr:
    """`closed` with the operations alone that its `outputs` (numbers of them, in order; default: all) depend on, also inside of what it calls."""
    jaxpr = closed.jaxpr
    of_wanted = jaxpr if outputs is None else jaxpr.replace(outvars=[jaxpr.outvars[i] for i in outputs])
    return ClosedJaxpr(dce_jaxpr(of_wanted, [True] * len(of_wanted.outvars), instantiate=True)[0], closed.consts)
