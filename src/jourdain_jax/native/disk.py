"""Machine code, and what was found of scenes, kept on disk between processes: in the folder of JAX's compilation cache where one is set, otherwise in
the user's cache.

A file is named by what its content was made from; it begins with a digest of the content, so that one that is torn or changed is made again. It is
written beside and moved to its place, so that many processes may write the same one.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax

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


def kept(name: str, make: Callable[[], bytes]) -> bytes:
    """What `make` returns, from the file of this name where it is whole, otherwise made and kept there; a disk that refuses is no error.

    What is empty is not kept.
    """
    place = folder()
    if place is None:
        return make()
    file = place / f"{name}.o"
    try:
        text = file.read_bytes()
    except OSError:
        text = b""
    digest, code = text[:_DIGEST], text[_DIGEST:]
    if code and hashlib.sha256(code).digest() == digest:
        return code
    code = make()
    if not code:
        return code
    try:
        place.mkdir(parents=True, exist_ok=True)
        _make_room(place)
        with tempfile.NamedTemporaryFile(dir=place, delete=False) as beside:
            beside.write(hashlib.sha256(code).digest() + code)
        try:
            os.replace(beside.name, file)
        except OSError:  # under Windows, while another process reads it
            os.unlink(beside.name)
    except OSError:
        pass
    return code


def _make_room(place: Path) -> None:
    """Removes the oldest files where all take more than `MOST_BYTES`."""
    found = sorted((file.stat().st_mtime, file.stat().st_size, file) for file in place.glob("*.o"))
    excess = sum(size for _, size, _ in found) - MOST_BYTES
    for _, size, file in found:
        if excess <= 0:
            break
        file.unlink(missing_ok=True)
        excess -= size
