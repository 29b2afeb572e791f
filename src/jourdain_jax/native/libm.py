"""Functions of C's library on vectors of doubles, lane by lane: of what is seldom used."""

import math

from jourdain_jax.native.ir import Value, Writer

PREFIX = "jourdain_libm_"  # of libm's functions in a module


def by_libm(name: str, w: Writer, *args: Value) -> Value:
    """A function of libm, lane by lane."""
    result = w.number(math.nan)
    for lane in range(w.lanes):
        ones = [w.instruction("double", f"extractelement {a.type} {a.name}, i64 {lane}") for a in args]
        one = w.external(PREFIX + name, "double", *ones)
        result = w.instruction(result.type, f"insertelement {result.type} {result.name}, double {one.name}, i64 {lane}")
    return result
