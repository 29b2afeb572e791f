"""A bound on the memory of a process that computes a study: how much is resident, how large blocks and chunks may be.

What a process needs is estimated before it compiles anything, and looked at after every block:

    resident now + COMPILED + BLOCKS (bytes of a block's saved states) + CHUNKS (bytes of a chunk's arrays)

Blocks are chosen so that this is within the bound, and a study whose process is seen beyond it stops. The allocator of glibc keeps freed arrays for later
ones, and grows by hundreds of megabytes as sizes change; where a bound is stated, large arrays are given back at once, which costs a tenth of the time of
studies that keep trajectories.
"""

import ctypes
import os
from typing import Any

COMPILED = 500e6  # bytes for compilers and what they compile; the disc takes 220 MB, the bicycle 400 MB
BLOCKS = 4.0  # copies of a block's states that are there at once; seen: 3.7
CHUNKS = 2.0  # the arrays of a chunk's blocks, and these put together
_NOT_HERE = "`memory` is held on Linux with glibc only; omit it here"


def resident() -> int:
    """Return the bytes of this process that are now in memory. Raises ValueError on systems that do not
    report them.
    """
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    except (OSError, ValueError, IndexError):
        raise ValueError(_NOT_HERE) from None


def give_back_at_once() -> None:
    """Make the allocator return large freed arrays to the system at once. Raises ValueError unless it is that
    of glibc.
    """
    library: Any = ctypes.CDLL(None) if os.name == "posix" else None
    # M_MMAP_THRESHOLD is -3, M_TRIM_THRESHOLD -1 in glibc's malloc.h
    if not hasattr(library, "mallopt") or not library.mallopt(-3, 2**20) or not library.mallopt(-1, 2**24):
        raise ValueError(_NOT_HERE)


def of_each(memory: int, processes: int) -> int:
    """Return the bytes for each computing process, from the `memory` of all of them and, if there are
    several, of this one.
    """
    return memory if processes == 1 else max(0, (memory - resident()) // processes)


def room(allowed: int, *, here: bool) -> float:
    """Return the bytes for blocks and chunks in a process that may use `allowed` bytes: this process
    (`here`), or a new one. Raises ValueError where none remain.
    """
    # bytes that a process holds with this package and before it computes
    held = resident() if here else 240e6
    give_back_at_once()
    if allowed < held + COMPILED:
        need = f"{'this process' if here else 'a new process'} holds {held / 1e6:.0f} MB before it begins, and compiling may take {COMPILED / 1e6:.0f} MB"
        raise ValueError(f"`memory` allows {allowed / 1e6:.0f} MB for each computing process, but {need}; "
            "give more, or use fewer processes")
    return allowed - held - COMPILED


def check(allowed: int) -> None:
    """MemoryError where this process holds more than `allowed` bytes now."""
    if (held := resident()) > allowed:
        text = f"a process holds {held / 1e6:.0f} MB, and `memory` allows {allowed / 1e6:.0f} MB for each; all finished chunks are kept"
        raise MemoryError(f"{text}. Run the study again with more memory, fewer processes, or fewer times "
            "`ts`")
