"""A study on the disk: a Zarr group (format 3) with one array per quantity along `lane`, and beside it what is needed to go on after an interruption.

    NAME/zarr.json, NAME/c/0, ...    arrays, cut into chunks of lanes; every chunk ends in its CRC-32C, as Zarr's codec `crc32c` has it
    run/study.json                   what study this is: format, digests, settings, versions; written once
    run/grid.json                    the grid of the statistics
    run/chunks/K                     receipt of chunk K: written when all its arrays are, with their checksums, its counts and its sums
    run/skipped.json                 lanes that are not computed, since processes died on them
    run/lock                         held by the process that runs the study

A chunk counts as done if its receipt is whole and its arrays are there with the checksums of the receipt; otherwise it is computed again.
"""

import contextlib
import errno
import json
import math
import os
import secrets
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jourdain_jax.calculus.on_first_use import needed
from jourdain_jax.calculus.writing import write_whole
from jourdain_jax.ensembles import optional
from jourdain_jax.ensembles.files import locked

FORMAT = 1
_BEGIN = b"jourdain-jax chunk 1\n"


@dataclass(frozen=True)
class Column:
    """One array of a study: its type, axes after the first (name, length), what stands for nothing, attributes. `every`: of which lanes it is kept."""

    dtype: str
    fill: float | int
    attributes: Mapping
    more: tuple[tuple[str, int], ...] = ()
    every: int = 1

    def length(self, lanes: int) -> int:
        """How many of so many lanes are kept."""
        return -(-lanes // self.every)


@dataclass(frozen=True)
class Receipt:
    """What is known of a chunk that was done."""

    first: int
    last: int
    arrays: Mapping[str, np.ndarray]  # result codes and their counts, failed lanes, sums per block, cells and their counts, extremes
    checksums: Mapping[str, int]

    @property
    def lanes(self) -> tuple[int, int]:
        """How many lanes the chunk has, and how many of them failed."""
        return self.last - self.first, self.arrays["failed"].size


class Store:
    """A study's folder, `path`."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.study = self._read_study()
        self.lanes, self.chunk = int(self.study["samples"]), int(self.study["chunk"])
        self.columns = {name: Column(**{**entry, "more": tuple(map(tuple, entry["more"]))}) for name, entry in self.study["columns"].items()}

    @staticmethod
    def make(path: str | os.PathLike, study: Mapping, columns: Mapping[str, Column], constants: Mapping[str, tuple], attributes: Mapping) -> "Store":
        """A new folder, whole or absent; an existing one is not touched. `constants`: name -> axis, values, attributes."""
        zarr = needed("zarr", "storing a study", "ensembles")
        path = Path(path)
        if path.is_file():
            raise ValueError(f"`{path}` is a file, expected a folder for the study; give another name")
        beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        lanes, chunk = study["samples"], study["chunk"]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that consolidated metadata are not yet in the standard: xarray looks for them
                group = zarr.create_group(beside, zarr_format=3, attributes=dict(attributes))
                check = [zarr.codecs.Crc32cCodec()]
                for name, column in columns.items():
                    shape = (column.length(lanes), *(length for _, length in column.more))
                    chunks = (chunk // column.every, *shape[1:])
                    axis = "lane" if column.every == 1 else "saved_lane"
                    options = {"compressors": check, "fill_value": column.fill, "dimension_names": (axis, *(name for name, _ in column.more))}
                    group.create_array(name, shape=shape, chunks=chunks, dtype=column.dtype, attributes=dict(column.attributes), **options)
                for name, (axis, values, about) in constants.items():
                    array = group.create_array(name, shape=values.shape, chunks=values.shape, dtype=values.dtype, compressors=check,
                                               dimension_names=(axis,), attributes=dict(about))  # fmt: skip
                    array[:] = values
                group.create_group("run")
                zarr.consolidate_metadata(beside, zarr_format=3)
            (beside / "run" / "chunks").mkdir()
            for name in columns:
                (beside / name / "c").mkdir(exist_ok=True)
            entries = {name: vars(column) | {"attributes": dict(column.attributes)} for name, column in columns.items()}
            write_whole(beside / "run" / "study.json", json.dumps({"format": FORMAT, **study, "columns": entries}, indent=1).encode(), wait=True)
            with contextlib.suppress(OSError):  # an empty folder, whose place Windows does not give to another one
                path.rmdir()
            try:
                os.rename(beside, path)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                    raise
        except OSError as error:
            text = f"cannot write the study ({os.strerror(error.errno or 0)}); choose a folder that can be written to"
            raise OSError(error.errno, text, str(path)) from error
        finally:
            shutil.rmtree(beside, ignore_errors=True)
        return Store(path)

    def _read_study(self) -> dict:
        file = self.path / "run" / "study.json"
        try:
            found = json.loads(file.read_bytes())
            if not isinstance(found, dict):
                raise ValueError("it is no dictionary")
        except FileNotFoundError:
            what = "is not a study: it holds no `run/study.json`" if self.path.exists() else "does not exist"
            raise ValueError(f"`{self.path}` {what}; give the folder of a study, or a new name") from None
        except NotADirectoryError:
            raise ValueError(f"`{self.path}` is a file, expected the folder of a study") from None
        except ValueError as error:
            raise ValueError(f"`{file}` is damaged ({error}); the study cannot be continued: move the folder away and run it anew") from None
        if found.get("format") != FORMAT:
            raise ValueError(f"`{self.path}` has format {found.get('format')}, this version of jourdain-jax reads {FORMAT}; use the version that wrote it")
        return found

    @property
    def attributes(self) -> dict:
        """Attributes of the whole store, by name."""
        return json.loads((self.path / "zarr.json").read_bytes())["attributes"]

    @staticmethod
    def is_taken(path: str | os.PathLike) -> bool:
        """Whether something is at `path`; an empty folder does not count."""
        path = Path(path)
        return path.exists() and not (path.is_dir() and not any(path.iterdir()))

    def lock(self):
        """A context in which no other process can run this study."""
        return locked(self.path / "run" / "lock")

    @property
    def chunks(self) -> int:
        """How many there are."""
        return -(-self.lanes // self.chunk)

    def span(self, number: int) -> tuple[int, int]:
        """First lane of a chunk, and first of the next."""
        return number * self.chunk, min((number + 1) * self.chunk, self.lanes)

    def _file(self, name: str, number: int) -> Path:
        """The file of a chunk: of an array with more axes than that of lanes, which are not cut, every chunk has a folder of its own."""
        return (self.path / name / "c" / str(number)).joinpath(*["0"] * len(self.columns[name].more))

    def _write(self, name: str, number: int, content: bytes) -> None:
        """Put the file of a chunk in its place."""
        file = self._file(name, number)
        if self.columns[name].more:
            file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content)

    def _receipt_file(self, number: int) -> Path:
        return self.path / "run" / "chunks" / str(number)

    def write(self, number: int, values: Mapping[str, np.ndarray], arrays: Mapping[str, np.ndarray]) -> None:
        """Keep a chunk: the values of all columns, then its receipt with `arrays`."""
        crc32c = optional.crc32c()
        checksums = {}
        try:
            for name, column in self.columns.items():
                full = np.full((self.chunk // column.every, *(length for _, length in column.more)), column.fill, np.dtype(column.dtype).newbyteorder("<"))
                full[: len(values[name])] = values[name]
                content = full.tobytes()
                checksums[name] = crc32c.value(content)
                self._write(name, number, content + checksums[name].to_bytes(4, "little"))
            write_whole(self._receipt_file(number), _packed(Receipt(*self.span(number), arrays, checksums), crc32c))
        except OSError as error:
            done = len(self.receipts())
            text = f"{os.strerror(error.errno or 0)}; {done} of {self.chunks} chunks are kept: make room or mend the folder, and run the study again to go on"
            raise OSError(error.errno, text, str(self.path)) from error

    def receipt(self, number: int) -> Receipt | None:
        """The receipt of a chunk; None where there is none or it is torn."""
        try:
            return _unpacked(self._receipt_file(number).read_bytes(), optional.crc32c())
        except (FileNotFoundError, ValueError):
            return None

    def receipts(self) -> list[int]:
        """Numbers of chunks that have a receipt, whole or not, in order."""
        return sorted(int(entry.name) for entry in os.scandir(self.path / "run" / "chunks") if entry.name.isdigit() and int(entry.name) < self.chunks)

    def is_whole(self, number: int) -> bool:
        """Whether a chunk has its receipt and all its arrays, and all of them are as they were written."""
        crc32c = optional.crc32c()
        receipt = self.receipt(number)
        if receipt is None or (receipt.first, receipt.last) != self.span(number) or set(receipt.checksums) != set(self.columns):
            return False
        for name, column in self.columns.items():
            try:
                content = self._file(name, number).read_bytes()
            except FileNotFoundError:
                return False
            size = np.dtype(column.dtype).itemsize * (self.chunk // column.every) * math.prod(length for _, length in column.more)
            if len(content) != size + 4 or not int.from_bytes(content[-4:], "little") == receipt.checksums[name] == crc32c.value(content[:-4]):
                return False
        return True

    def done(self) -> tuple[list[int], list[int]]:
        """Numbers of the chunks that are whole, and of those that have a receipt and are not; the receipts of the latter are removed."""
        receipts = self.receipts()
        whole = [number for number in receipts if self.is_whole(number)]
        torn = sorted(set(receipts) - set(whole))
        for number in torn:
            self._receipt_file(number).unlink()
        return whole, torn

    def read_grid(self) -> dict | None:
        """What `write_grid` kept; None where nothing was, or it is damaged (it is then found again)."""
        found = self._read("grid.json", None)
        return found if isinstance(found, dict) and {"low", "high", "centre"} <= found.keys() else None

    def write_grid(self, grid: dict) -> None:
        """Keep the grid of the statistics."""
        write_whole(self.path / "run" / "grid.json", json.dumps(grid).encode(), wait=True)

    def skipped(self) -> tuple[int, ...]:
        """Numbers of the lanes that `skip` noted, since processes died on them."""
        return tuple(self._read("skipped.json", ()))

    def skip(self, lane: int) -> None:
        """Note that a lane is not to be computed."""
        write_whole(self.path / "run" / "skipped.json", json.dumps(sorted({*self.skipped(), lane})).encode(), wait=True)

    def _read(self, name: str, otherwise):
        try:
            return json.loads((self.path / "run" / name).read_bytes())
        except (FileNotFoundError, ValueError):
            return otherwise

    def take_chunk(self, other: "Store", number: int) -> None:
        """Copy a chunk that another folder of the same study holds."""
        for name in self.columns:
            self._write(name, number, other._file(name, number).read_bytes())
        write_whole(self._receipt_file(number), other._receipt_file(number).read_bytes())


def _packed(receipt: Receipt, crc32c) -> bytes:
    """A receipt as bytes: a first line, a line of JSON that says what follows, the arrays, and the CRC-32C of all that."""
    arrays = {name: np.ascontiguousarray(array) for name, array in receipt.arrays.items()}
    listed = [(name, array.dtype.str, array.shape) for name, array in arrays.items()]
    head = {"first": receipt.first, "last": receipt.last, "checksums": dict(receipt.checksums), "arrays": listed}
    content = _BEGIN + json.dumps(head).encode() + b"\n" + b"".join(array.tobytes() for array in arrays.values())
    return content + crc32c.value(content).to_bytes(4, "little")


def _unpacked(content: bytes, crc32c) -> Receipt:
    if not content.startswith(_BEGIN) or crc32c.value(content[:-4]) != int.from_bytes(content[-4:], "little"):
        raise ValueError("the receipt of a chunk is torn")
    end = content.index(b"\n", len(_BEGIN))
    head, at, arrays = json.loads(content[len(_BEGIN) : end]), end + 1, {}
    for name, dtype, shape in head["arrays"]:
        count = math.prod(shape)
        arrays[name] = np.frombuffer(content, dtype, count, at).reshape(shape)
        at += count * np.dtype(dtype).itemsize
    return Receipt(head["first"], head["last"], arrays, head["checksums"])
