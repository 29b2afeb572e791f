"""The receipt of a finished chunk of a study: its samples, its share of the statistics, its checksums."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.studies.statistics import Tally

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
        """Return the receipt as bytes: a first line, a line of JSON that describes the arrays, the arrays,
        and the CRC-32C of all these.
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
        """Return the receipt in these bytes, for a study with this number of `outputs`. Raises ValueError, or
        another error of the reader, for damaged bytes.
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
