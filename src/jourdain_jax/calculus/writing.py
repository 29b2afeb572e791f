"""Files that are whole or absent: written beside their place under another name and moved there in one step.

A process that is killed leaves files whole. A machine that loses power may leave torn ones, unless the writer waits until they are on the disk.
"""

import contextlib
import os
import secrets
from pathlib import Path

from jourdain_jax.calculus.reals import described

_BINARY = getattr(os, "O_BINARY", 0)  # without it, Windows writes two bytes for every one that is a line feed


def check_place(path: str | os.PathLike) -> None:
    """Raise a ValueError where a file cannot be written at `path`: its folder does not exist, or it is one itself."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` is {described(path)}, expected the name of a file")
    place, folder = os.fspath(path), os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"cannot write `{place}`: there is no folder `{folder}`; make it first")
    if os.path.isdir(path):
        raise ValueError(f"cannot write `{place}`: it is a folder; give the name of a file in it")


def write_whole(path: str | os.PathLike, content: bytes | memoryview, *, wait: bool = False, mode: int = 0o666) -> None:
    """Put a file of this `content` in the place `path`; `wait`: until it is on the disk; `mode`: who may read and write it, as of `open`."""
    path = Path(path)
    beside = f"{path.parent}/.{path.name[:200]}.{secrets.token_hex(8)}"
    file = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY, mode)
    try:
        try:
            written, content = 0, memoryview(content)
            while written < len(content):
                written += os.write(file, content[written:])
            if wait:
                os.fsync(file)
        finally:
            os.close(file)
        os.replace(beside, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(beside)
        raise
