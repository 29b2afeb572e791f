"""Which values of a long calculation are in registers, and which wait in memory.

Where a register is wanted, the value whose next use is the furthest away gives up its own (L. A. Belady, IBM Systems Journal 5 (1966) 78). The cotangents of a
bicycle's rates take 54 kB of code so, and 73 kB by LLVM's choice. Code that is longer than the first cache of instructions (32 kB) costs time by its length.
"""

import heapq
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field


@dataclass
class Turn:
    """Values that come from memory before a value is worked out, and those that go there after it, each with its place."""

    loaded: list[int]
    stored: list[tuple[int, int]] = field(default_factory=list)


def turns(uses: Sequence[tuple[int, Iterable[int]]], there: Collection[int], registers: int) -> tuple[list[Turn], int]:
    """A turn for each value that is worked out, and how many places in memory they take.

    `uses`: the values in order, each with those that it is made of; `there`: those that are in memory already. A place is taken anew once nothing is made of
    what is there any more.
    """
    made_of = [tuple(dict.fromkeys(values)) for _, values in uses]
    coming: dict[int, list[int]] = {}
    for i in reversed(range(len(uses))):
        for value in made_of[i]:
            coming.setdefault(value, []).append(i)
    held: dict[int, int] = {}  # value in a register -> when it is used next
    places: dict[int, int] = {}
    free: list[int] = []
    found, count = [], 0
    for i, (new, _) in enumerate(uses):
        turn = Turn([value for value in made_of[i] if value not in held])
        found.append(turn)
        for value in made_of[i]:
            coming[value].pop()
            if coming[value]:
                held[value] = coming[value][-1]
            else:
                held.pop(value, None)
                if value in places:
                    heapq.heappush(free, places.pop(value))
        if coming.get(new):
            held[new] = coming[new][-1]
        while len(held) > registers:
            value = max(held, key=held.__getitem__)
            del held[value]
            if value not in places and value not in there:
                if not free:
                    free.append(count)
                    count += 1
                places[value] = heapq.heappop(free)
                turn.stored.append((value, places[value]))
    return found, count
