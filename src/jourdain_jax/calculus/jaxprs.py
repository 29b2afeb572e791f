"""What JAX traced, without the operations that nobody asks for."""

from collections.abc import Sequence

from jax.extend.core import ClosedJaxpr, Literal


def needed_only(closed: ClosedJaxpr, outputs: Sequence[int] | None = None) -> ClosedJaxpr:
    """`closed` with the operations alone that its `outputs` (numbers of them; default: all) depend on."""
    jaxpr = closed.jaxpr
    wanted = jaxpr.outvars if outputs is None else [jaxpr.outvars[i] for i in outputs]
    needed, kept = {v for v in wanted if not isinstance(v, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if not needed.isdisjoint(equation.outvars):
            kept.append(equation)
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
    return ClosedJaxpr(jaxpr.replace(eqns=kept[::-1], outvars=wanted), closed.consts)
