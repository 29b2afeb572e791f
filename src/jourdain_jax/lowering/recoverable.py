"""Coordinates that a quadrature recovers: on whose value nothing depends that shapes the motion.

    ydot, events, projections, rates of the other coordinates: functions of (t, y, k) alone       k: coordinates that are needed
    rdot_i = f_i(t, y, k, r_1 .. r_(i-1))                                                          r: recoverable, in some order

So x and y of a rolling disc, which depend on its yaw, and its yaw and spin, on which else nothing depends. Read off the scalar program, hence
a statement about these equations, not only about the numbers at some probes. Wang and Pao (2003), after eq. (42), for cyclic coordinates.
"""

from collections.abc import Iterable, Mapping


def recoverable(rates: Mapping[int, frozenset[int]], wanted: Iterable[int]) -> tuple[int, ...]:
    """Coordinates that are not `wanted`, directly or through the rates of others, and whose rates do not lead back to themselves.

    `rates[i]`: the coordinates on which the rate of coordinate i depends.
    """
    needed = reached(rates, wanted)
    while turning := {i for i in rates if i not in needed and i in reached(rates, rates[i])}:
        needed = reached(rates, needed | turning)
    return tuple(i for i in rates if i not in needed)


def reached(rates: Mapping[int, frozenset[int]], wanted: Iterable[int]) -> set[int]:
    """All coordinates on which those that are wanted depend, themselves included."""
    found: set[int] = set()
    left = list(wanted)
    while left:
        i = left.pop()
        if i not in found:
            found.add(i)
            left.extend(rates[i])
    return found
