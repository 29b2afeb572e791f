"""The lock of a study's folder."""

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # not available on this system, which then has no locks
    fcntl = None  # type: ignore[assignment]


class InUseError(RuntimeError):
    """Error for a folder in which another process runs a study."""


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock file `path`. Raises `InUseError`, naming the holder, if another process holds it. The
    system releases the lock when its holder ends for any reason.
    """
    with open(path, "a+b") as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InUseError(
                    f"`{path.parent.parent}` is in use{_owner(file)}; wait for that run, end it, or give "
                    "another folder"
                ) from None
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
