"""Bounds on the disk space and the memory of a study, which determine the sizes of blocks and chunks.

The memory that a process needs is estimated before it compiles anything, and checked after every block:

    resident now + COMPILED + BLOCKS (bytes of a block's saved states) + CHUNKS (bytes of a chunk's arrays)

Block sizes are chosen to satisfy the bound, and a study stops if its process exceeds it. The glibc allocator
keeps freed arrays for reuse, which takes hundreds of megabytes as sizes change. Under a bound, large arrays
are therefore returned to the system at once; this takes a tenth of the time of studies that store
trajectories.
"""

import ctypes
import os
import shutil
from pathlib import Path
from typing import Any

# tuning: bytes for compilers and compiled programs; the disc takes 220 MB, the bicycle 400 MB
COMPILED = 500e6
BLOCKS = 4.0  # tuning: simultaneous copies of a block's states; measured: 3.7
CHUNKS = 2.0  # tuning: the arrays of a chunk's blocks, and their concatenation
_NOT_HERE = "`memory` is limited only on Linux with glibc; omit it here"


def resident() -> int:
    """Return the resident memory of this process in bytes. Raises ValueError on systems that do not report
    it.
    """
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    except (OSError, ValueError, IndexError):
        raise ValueError(_NOT_HERE) from None


def give_back_at_once() -> None:
    """Make the allocator return large freed arrays to the system at once. Raises ValueError for another
    allocator than glibc's.
    """
    library: Any = ctypes.CDLL(None) if os.name == "posix" else None
    # M_MMAP_THRESHOLD is -3, M_TRIM_THRESHOLD -1 in glibc's malloc.h
    if not hasattr(library, "mallopt") or not library.mallopt(-3, 2**20) or not library.mallopt(-1, 2**24):
        raise ValueError(_NOT_HERE)


def of_each(memory: int, processes: int) -> int:
    """Return the bytes for each computing process. Several processes share what this process leaves of
    `memory`.
    """
    return memory if processes == 1 else max(0, (memory - resident()) // processes)


def room(allowed: int, *, here: bool) -> float:
    """Return the bytes that remain for blocks and chunks in a process that may use `allowed` bytes. `here`:
    whether it is this process, or a new one. Raises ValueError if none remain.
    """
    # bytes of a new process that has imported this package
    held = resident() if here else 240e6
    give_back_at_once()
    if allowed < held + COMPILED:
        need = (
            f"{'this process' if here else 'a new process'} uses {held / 1e6:.0f} MB before the study begins,"
            f" and compiling may take {COMPILED / 1e6:.0f} MB"
        )
        raise ValueError(
            f"`memory` allows {allowed / 1e6:.0f} MB for each computing process, but {need}; "
            "give more, or use fewer processes"
        )
    return allowed - held - COMPILED


def check(allowed: int) -> None:
    """Raise MemoryError if this process now uses more than `allowed` bytes."""
    if (held := resident()) > allowed:
        text = (
            f"a process holds {held / 1e6:.0f} MB, and `memory` allows {allowed / 1e6:.0f} MB for each; all"
            " finished chunks are kept"
        )
        raise MemoryError(
            f"{text}. Run the study again with more memory, fewer processes, or fewer times `ts`"
        )


def check_disk(path, need: float) -> None:
    """Raise ValueError if the disk of a folder, which may not exist yet, has less than `need` bytes free."""
    folder = Path(path).absolute()
    free = shutil.disk_usage(next(above for above in (folder, *folder.parents) if above.exists())).free
    if need > free:
        raise ValueError(
            f"the results take {need / 1e9:,.1f} GB, and the disk of `{path}` has {free / 1e9:,.1f} GB free; "
            "take fewer samples or outputs, a larger `keep_every` or save='statistics', or divide the study "
            "among several disks (`shard`)"
        )
