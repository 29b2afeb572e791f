"""Functions of C's library on vectors of doubles, lane by lane: of what is seldom used, or far from where a polynomial serves."""

import math
from collections.abc import Sequence

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


def by_libm_where(w: Writer, far: Value, args: Sequence[Value], quick: Sequence[Value], names: Sequence[str]) -> list[Value]:
    """The quick values, but libm's in the lanes that are far."""
    found = [w.room(w.real) for _ in quick]
    for value, place in zip(quick, found, strict=True):
        w.store(value, place)
    with w.when(w.any(far)):
        for value, place, name in zip(quick, found, names, strict=True):
            w.store(w.where(far, by_libm(name, w, *args), value), place)
    return [w.load(w.real, place) for place in found]
