"""Records of a study on disk, with checksums: a receipt for each finished chunk, and the manifest with
digests of all files that are written once.

`locked` locks the folder of a study.
"""

import contextlib
import hashlib
import json
import math
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jourdain_jax.calculus.files import write_whole
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.studies.statistics import Tally

MANIFEST, GRID = "run/manifest.json", "run/grid.json"
_BEGIN = b"jourdain-jax chunk 2\n"


@dataclass(frozen=True)
class Receipt:
    """The record of a finished chunk."""

    first: int
    last: int
    tally: Tally
    checksums: Mapping[str, int]
    of: Sequence[str]  # digests of the study and of its grid

    @property
    def lanes(self) -> tuple[int, int]:
        """Return the number of samples of the chunk, and of failed ones."""
        return self.last - self.first, self.tally.failed.size

    def packed(self) -> bytes:
        """Return the receipt as bytes: a header line, a line of JSON that describes the arrays, the arrays,
        and the CRC-32C of all that.
        """
        arrays = vars(self.tally) | {"cells": self.tally.cells.astype(np.int32)}
        listed = [(name, array.dtype.str, array.shape) for name, array in arrays.items()]
        head = vars(self) | {"checksums": dict(self.checksums), "arrays": listed}
        del head["tally"]
        return with_checksum(
            _BEGIN + json.dumps(head).encode() + b"\n" + b"".join(map(np.ndarray.tobytes, arrays.values()))
        )

    @staticmethod
    def unpacked(content: bytes, outputs: int) -> "Receipt":
        """Return the receipt in the bytes `content`, for a study with this number of `outputs`. Damaged bytes
        raise ValueError or another error.
        """
        if not content.startswith(_BEGIN) or content != with_checksum(content[:-4]):
            raise ValueError("the receipt of a chunk is incomplete")
        end = content.index(b"\n", len(_BEGIN))
        head, at, arrays = json.loads(content[len(_BEGIN) : end]), end + 1, {}
        for name, dtype, shape in head.pop("arrays"):
            count = math.prod(shape)
            if min(shape, default=0) < 0 or np.dtype(dtype).hasobject:
                raise ValueError("the receipt of a chunk holds no numbers")
            arrays[name] = np.frombuffer(content, dtype, count, at).reshape(shape)
            at += count * np.dtype(dtype).itemsize
        return Receipt(tally=Tally.checked(arrays, range(head["first"], head["last"]), outputs), **head)


def with_checksum(content: bytes) -> bytes:
    """Return the content followed by its CRC-32C, in the format of Zarr's codec."""
    return content + crc32c(content).to_bytes(4, "little")


def crc32c(content) -> int:
    return needed("google_crc32c", "storing a study", "studies").value(content)  # a dependency of zarr


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def digest_of(digests: Mapping[str, str]) -> str:
    return digest(json.dumps(digests, sort_keys=True).encode())


def write_manifest(path: Path, digests: Mapping[str, str]) -> None:
    write_whole(
        path / MANIFEST,
        json.dumps({"digests": dict(digests), "digest": digest_of(digests)}, indent=1).encode(),
        wait=True,
    )


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
