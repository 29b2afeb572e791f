"""Machine code kept on disk between processes: in the folder of JAX's compilation cache where one is set, otherwise in the user's cache.

A file is named by what its code was made from. It begins with a digest of that name, of what made it and of the code, so that one that is torn, changed or
exchanged for another is made again. Code from others would run in this process: a folder or a file that somebody else owns or may write is not used.
"""

import contextlib
import functools
import hashlib
import os
import stat
import warnings
from collections.abc import Callable
from pathlib import Path

import jax

from jourdain_jax.calculus.writing import write_whole

MOST_BYTES = 200e6  # of all files; beyond, the oldest go
_DIGEST = 32  # bytes


def folder() -> Path | None:
    """Where code is kept; None where `JOURDAIN_JAX_CACHE` is 0, or there is no place for it."""
    stated = os.environ.get("JOURDAIN_JAX_CACHE", "")
    if stated == "0":
        return None
    if stated:
        return Path(stated)
    if jax.config.jax_compilation_cache_dir:
        return Path(jax.config.jax_compilation_cache_dir) / "jourdain_jax"
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jourdain_jax"
    except RuntimeError:  # a user without a home
        return None


def kept(name: str, made_by: str, make: Callable[[], bytes]) -> bytes:
    """What `make` returns, from the file of this name where it is whole, otherwise made and kept there; a disk that refuses is no error.

    `made_by`: what else must be the same, versions of what makes it, as text.
    """
    place = folder()
    if place is None or not _is_ours(place):
        return make()
    file = place / f"{name}.o"

    def digest(code: bytes) -> bytes:
        return hashlib.sha256(f"machine code\0{name}\0{made_by}\0".encode() + code).digest()

    text = _read(file)
    if digest(text[_DIGEST:]) == text[:_DIGEST]:
        return text[_DIGEST:]
    code = make()
    with contextlib.suppress(OSError):
        _make_room(place)
        write_whole(file, digest(code) + code, mode=0o600)
    return code


def _is_ours(place: Path) -> bool:
    """Whether the folder, made where there is none, can be used; a warning where others may put code into it."""
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        against = _against(os.stat(place))
    except OSError:
        return False
    if against:
        _warn(place, against)
    return not against


def _against(found: os.stat_result) -> str:
    """Why a folder or a file is not believed; empty where it is."""
    if found.st_uid != os.geteuid():
        return f"it belongs to user {found.st_uid}, and this process runs as {os.geteuid()}"
    return "others may write to it" if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH) else ""


@functools.cache
def _warn(place: Path, against: str) -> None:
    warnings.warn(
        f"the folder `{place}` is not used for machine code, which is compiled anew in each process: {against}, and what lies there runs in your process; "
        "take away that right (chmod go-w), or name a folder of your own in JOURDAIN_JAX_CACHE (0: none)",
        stacklevel=2,
    )


def _read(file: Path) -> bytes:
    """The content; nothing where there is none of our own."""
    try:
        with open(os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as opened:
            return b"" if _against(os.fstat(opened.fileno())) else opened.read()
    except OSError:
        return b""


def _make_room(place: Path) -> None:
    """Remove the oldest files where all take more than `MOST_BYTES`."""
    found = sorted((file.stat().st_mtime, file.stat().st_size, file) for file in place.glob("*.o"))
    excess = sum(size for _, size, _ in found) - MOST_BYTES
    for _, size, file in found:
        if excess <= 0:
            break
        file.unlink(missing_ok=True)
        excess -= size
