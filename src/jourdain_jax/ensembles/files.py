"""Files that are whole or absent: written beside their place and moved there in one step, with checksums; and the lock of a folder.

A process that is killed leaves files whole. A machine that loses power may leave torn ones, which their checksums show. Small files that are written once
are waited for until they are on the disk.
"""

import contextlib
import itertools
import json
import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on this system: no lock is held there
    fcntl = None  # type: ignore[assignment]

_BINARY = getattr(os, "O_BINARY", 0)  # without it, Windows writes two bytes for every one that is a line feed
_OURS, _count = secrets.token_hex(4), itertools.count()  # in names of files, other than those of all processes


def write_whole(path: Path, content: bytes, *, wait: bool = False) -> None:
    """Put a file in its place; `wait`: until it is on the disk."""
    beside = f"{path.parent}/.{path.name}.{os.getpid()}.{_OURS}.{next(_count)}"
    try:
        file = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY, 0o666)
        try:
            written = 0
            while written < len(content):
                written += os.write(file, content[written:] if written else content)
            if wait:
                os.fsync(file)
        finally:
            os.close(file)
        os.replace(beside, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(beside)
        raise


class InUseError(RuntimeError):
    """Another process runs a study in this folder."""


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock file `path`; an `InUseError` that says who holds it otherwise. The system lets go of it when its owner dies, in whatever way."""
    with open(path, "a+b") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InUseError(f"`{path.parent.parent}` is in use{_owner(file)}; wait for that run, or end it, or give another folder") from None
        file.truncate(0)
        file.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def _owner(file) -> str:
    file.seek(0)
    try:
        found = json.loads(file.read())
        return f" by process {found['pid']} on {found['host']}"
    except (ValueError, KeyError, TypeError):
        return ""
