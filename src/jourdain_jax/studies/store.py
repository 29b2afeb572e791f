"""A study on disk: a Zarr group (format 3) with one array per quantity, whose first axis `lane` runs over the
samples, and files for continuing after an interruption.

    NAME/zarr.json, NAME/c/0, ...   arrays, cut into chunks; each ends in its CRC-32C (Zarr's codec `crc32c`)
    run/study.json      identity of the study: format, digests, settings, versions; written once
    run/grid.json       grid of the statistics, written by the first process that completes block 0
    run/manifest.json   digests of all files that are written once, and of itself; replaced in one step
    run/chunks/K        receipt of chunk K with checksums, counts and sums; written after its arrays
    run/lock            held by the process that runs the study

A chunk is finished if its receipt is intact, belongs to this study and grid, and matches the checksums of its
arrays. Otherwise it is computed again. Files that are not in the manifest count as missing. The grid is
written before the manifest that lists it. Processes that compute the grid at the same time write the same
numbers. If two machines compute different grids, chunks that belong to the replaced grid are computed again.
"""

import contextlib
import errno
import json
import math
import os
import secrets
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jourdain_jax.calculus.files import FilePath, name_of, parsed, read_bytes, shortened, write_whole
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.studies.design import MOST_SAMPLES
from jourdain_jax.studies.records import (
    GRID,
    MANIFEST,
    Receipt,
    crc32c,
    digest,
    digest_of,
    locked,
    with_checksum,
    write_manifest,
)
from jourdain_jax.studies.statistics import Tally

FORMAT = 2  # code
MOST_CHUNKS, MOST_LANES = 2**24, 2**40  # tuning: chunks of a study, samples of a chunk


@dataclass(frozen=True)
class Column:
    """One array of a study: its type, its axes after the first as (name, length), its value for missing
    entries, and its attributes. `every`: the interval of stored samples.
    """

    dtype: str
    fill: float | int
    attributes: Mapping
    more: tuple[tuple[str, int], ...] = ()
    every: int = 1


class Store:
    """A study's folder, `path`."""

    def __init__(self, path: FilePath):
        self.path = Path(name_of(path))
        self.study = self._read_study()
        self._digests = self._read_manifest()
        self.lanes, self.chunk = self.study["samples"], self.study["chunk"]
        self.columns = {
            name: Column(**entry | {"more": tuple(map(tuple, entry["more"]))})
            for name, entry in self.study["columns"].items()
        }
        self.outputs = tuple(self.study.get("outputs", ()))
        # these entries are equal in all shares
        own = [self.study.get(name) for name in ("identity", "samples", "chunk", "block", "outputs")]
        self.identity = digest(json.dumps(own).encode())

    @staticmethod
    def make(
        path: FilePath,
        study: Mapping,
        columns: Mapping[str, Column],
        constants: Mapping[str, tuple],
        attributes: Mapping,
    ) -> "Store":
        """Create the folder, completely or not at all; an existing one is not changed. `constants`: name ->
        axis, values, attributes.
        """
        zarr = needed("zarr", "storing a study", "studies")
        path = Path(path)
        if fault := _beyond(study):
            raise ValueError(f"the study is too large: {fault}; take fewer samples, or a larger `chunk`")
        beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
        lanes, chunk = study["samples"], study["chunk"]
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with warnings.catch_warnings():
                # Zarr warns that consolidated metadata, which xarray reads, are not yet standard
                warnings.simplefilter("ignore")
                group = zarr.create_group(beside, zarr_format=3, attributes=dict(attributes))

                def array(name: str, axes: Sequence[str], shape, chunks, about: Mapping, **kind):
                    options = {
                        "dimension_names": axes,
                        "compressors": [zarr.codecs.Crc32cCodec()],
                        "attributes": dict(about),
                    }
                    return group.create_array(name, shape=shape, chunks=chunks, **options, **kind)

                for name, column in columns.items():
                    lane = "lane" if column.every == 1 else "saved_lane"
                    axes, more = zip((lane, 0), *column.more, strict=True)
                    shape, chunks = ((-(-count // column.every), *more[1:]) for count in (lanes, chunk))
                    kind = {"dtype": column.dtype, "fill_value": column.fill}
                    array(name, axes, shape, chunks, column.attributes, **kind)
                    (beside / name / "c").mkdir(exist_ok=True)
                for name, (axis, values, about) in constants.items():
                    array(name, (axis,), values.shape, values.shape, about, dtype=values.dtype)[:] = values
                group.create_group("run")
                zarr.consolidate_metadata(beside, zarr_format=3)
            (beside / "run" / "chunks").mkdir()
            entries = {
                name: vars(column) | {"attributes": dict(column.attributes)}
                for name, column in columns.items()
            }
            write_whole(
                beside / "run" / "study.json",
                json.dumps({"format": FORMAT, **study, "columns": entries}, indent=1).encode(),
                wait=True,
            )
            files = [file for file in beside.rglob("*") if file.is_file()]
            write_manifest(
                beside, {file.relative_to(beside).as_posix(): digest(file.read_bytes()) for file in files}
            )
            with contextlib.suppress(OSError):  # an empty folder, which blocks a rename on Windows
                path.rmdir()
            try:
                os.rename(beside, path)
            except OSError as error:
                if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                    raise
        except OSError as error:
            text = (
                f"cannot write the study ({os.strerror(error.errno or 0)}); choose a folder that can be"
                " written to"
            )
            raise OSError(error.errno, text, str(path)) from error
        finally:
            shutil.rmtree(beside, ignore_errors=True)
        return Store(path)

    def _read_study(self) -> dict:
        """Return the description of the study, with its numbers checked."""
        if not os.path.exists(self.path / "run" / "study.json"):
            if os.path.isfile(self.path):
                raise ValueError(f"`{self.path}` is a file, expected the folder of a study")
            if os.path.exists(self.path):
                what = "is not a study: it holds no `run/study.json`"
            else:
                what = "does not exist"
            raise ValueError(
                f"`{shortened(self.path, 300)}` {what}; give the folder of a study, or a new name"
            )
        found = self._json("run/study.json")
        if found.get("format") != FORMAT:
            text = (
                f"has format {found.get('format')}, this version of jourdain-jax reads {FORMAT}; use the"
                " version that wrote it, or run the study anew"
            )
            raise ValueError(f"`{self.path}` {text} in another folder")
        if fault := _beyond(found):
            raise self._damaged("run/study.json", fault)
        return found

    def _read_manifest(self) -> dict[str, str]:
        """Return the digests, by name, of files that are written once. Each file must exist and match, except
        the grid, which can be computed again.
        """
        found = self._json(MANIFEST)
        digests = found.get("digests")
        if not isinstance(digests, dict) or found.get("digest") != digest_of(digests):
            raise self._damaged(MANIFEST)
        for name in digests:
            if name != GRID and digest(self._read(name)) != digests[name]:
                raise self._damaged(name)
        return digests

    def _json(self, name: str) -> dict:
        """Return the dictionary in a JSON file."""
        found = parsed(json.loads, self._read(name), f"{self.path}/{name}", "valid JSON")
        if not isinstance(found, dict):
            raise self._damaged(name)
        return found

    def _read(self, name: str) -> bytes:
        # a file that is written once
        return read_bytes(self.path / name, 100_000_000, "the folder of a study with all its files")

    def _damaged(self, name: str, what: str = "its content has changed") -> ValueError:
        return ValueError(
            f"`{self.path / name}` is damaged ({what}); the study cannot be continued: move "
            "the folder away and run it anew"
        )

    @property
    def attributes(self) -> dict:
        """Return attributes of the whole store, by name."""
        return json.loads(self._read("zarr.json"))["attributes"]

    def lanes_of(self, numbers: Sequence[int]) -> str:
        """Return a text with the sample numbers of some chunks."""
        spans = (f"{first} to {last - 1}" for first, last in map(self.span, numbers[:5]))
        return f"samples {', '.join(spans)}{' ...' if len(numbers) > 5 else ''} of `{self.path}`"

    @staticmethod
    def is_taken(path: FilePath) -> bool:
        """Return whether `path` exists and is not an empty folder."""
        path = name_of(path)
        return os.path.exists(path) and not (os.path.isdir(path) and not os.listdir(path))

    def lock(self):
        """Return a context in which no other process can run this study."""
        return locked(self.path / "run" / "lock")

    @property
    def chunks(self) -> int:
        """Return the number of chunks."""
        return -(-self.lanes // self.chunk)

    def span(self, number: int) -> tuple[int, int]:
        """Return the first sample of a chunk, and the first of the next."""
        return number * self.chunk, min((number + 1) * self.chunk, self.lanes)

    def _file(self, name: str, number: int) -> Path:
        """Return the file of a chunk. An array with several axes has one folder per chunk, since only the
        first axis is divided.
        """
        return (self.path / name / "c" / str(number)).joinpath(*["0"] * len(self.columns[name].more))

    def _write(self, name: str, number: int, content: bytes) -> None:
        """Write the file of a chunk."""
        file = self._file(name, number)
        if self.columns[name].more:
            file.parent.mkdir(exist_ok=True)  # without parents: a folder that was moved away is not recreated
        write_whole(file, content)

    def _receipt_file(self, number: int) -> Path:
        return self.path / "run" / "chunks" / str(number)

    @contextlib.contextmanager
    def _named(self) -> Iterator[None]:
        """Return a context that adds the state of the study to errors of the operating system."""
        try:
            yield
        except OSError as error:
            if not (self.path / "run").is_dir():
                text = (
                    "the folder is gone: it was moved or removed while the study ran; put it back, or run it "
                    f"again under its new name ({error.strerror})"
                )
            else:
                kept = f"{len(self.receipts())} of {self.chunks} chunks are kept"
                text = (
                    f"{error.strerror or type(error).__name__}; {kept}: free disk space or repair the "
                    "folder, and run the study again to continue"
                )
            raise OSError(error.errno, text, str(self.path)) from error

    def write(self, number: int, values: Mapping[str, np.ndarray], tally: Tally) -> None:
        """Store a chunk: the values of all columns, then its receipt."""
        checksums = {}
        with self._named():
            for name, column in self.columns.items():
                full = np.full(
                    (self.chunk // column.every, *(length for _, length in column.more)),
                    column.fill,
                    np.dtype(column.dtype).newbyteorder("<"),
                )
                full[: len(values[name])] = values[name]
                content = with_checksum(full.tobytes())
                checksums[name] = int.from_bytes(content[-4:], "little")
                self._write(name, number, content)
            of = self.identity, self._digests.get(GRID, "")
            write_whole(
                self._receipt_file(number), Receipt(*self.span(number), tally, checksums, of).packed()
            )

    def receipt(self, number: int) -> Receipt | None:
        """Return the receipt of a chunk; None if it is missing, damaged, or belongs to another chunk, study
        or grid.
        """
        try:
            found = Receipt.unpacked(self._receipt_file(number).read_bytes(), len(self.outputs))
            own = self.span(number), [self.identity, self._digests.get(GRID, found.of[-1])], {*self.columns}
            stored = (found.first, found.last), list(found.of), {*found.checksums}
            return found if stored == own else None
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            return None

    def receipts(self) -> list[int]:
        """Return the indices of chunks that have a receipt, intact or not, in order."""
        try:
            names = os.listdir(self.path / "run" / "chunks")
        except OSError as error:
            raise ValueError(
                f"`{self.path}` no longer contains the chunks of a study ({error.strerror}); it was "
                "moved or removed"
            ) from None
        return sorted(
            int(name)
            for name in names
            if name.isdecimal() and name == str(int(name)) and int(name) < self.chunks
        )

    def is_whole(self, number: int) -> bool:
        """Return whether the receipt and all arrays of a chunk exist and are unchanged."""
        return self._wrong(number) is None

    def _wrong(self, number: int) -> str | None:
        """Return the name of an array of a chunk whose file has another length or checksum than its receipt
        states; None if there is none.
        """
        receipt = self.receipt(number)
        for name, column in self.columns.items():
            size = (
                np.dtype(column.dtype).itemsize
                * (self.chunk // column.every)
                * math.prod(length for _, length in column.more)
            )
            try:
                with open(self._file(name, number), "rb") as file:
                    content, stated = file.read(size), file.read(5)
            except OSError:
                return name
            known = receipt and receipt.checksums[name]
            if (int.from_bytes(stated, "little"), len(stated)) != (known, 4) or crc32c(content) != known:
                return name
        return "receipt" if receipt is None else None

    def check_arrays(self, numbers: Iterable[int]) -> None:
        """Raise ValueError if arrays of chunks do not match their receipts."""
        for number in numbers:
            if self.columns and (wrong := self._wrong(number)):
                text = (
                    f"`{wrong}` is damaged in {self.lanes_of([number])}: its file, or the receipt of the"
                    " chunk, has changed"
                )
                raise ValueError(f"{text}; run the study again, which computes them anew")

    def done(self) -> tuple[list[int], list[int]]:
        """Remove the receipts of damaged chunks, and return the indices of intact and of damaged chunks."""
        receipts = self.receipts()
        whole = [number for number in receipts if self.is_whole(number)]
        torn = sorted(set(receipts) - set(whole))
        for number in torn:
            self._receipt_file(number).unlink()
        return whole, torn

    def read_grid(self) -> dict | None:
        """Return the grid stored by `write_grid`; None if it is missing or damaged (it is then computed
        again).
        """
        self._digests = self._read_manifest()
        with contextlib.suppress(ValueError, OSError):
            content = self._read(GRID)
            if digest(content) == self._digests.get(GRID):
                return json.loads(content)
        return None

    def write_grid(self, grid: dict) -> dict:
        """Store the grid of the statistics, and return it."""
        content = json.dumps(grid).encode()
        with self._named():
            write_whole(self.path / GRID, content, wait=True)
            self._digests = self._read_manifest() | {GRID: digest(content)}
            write_manifest(self.path, self._digests)
        return grid

    def take_chunk(self, other: "Store", number: int) -> None:
        """Copy a chunk from another folder of the same study."""
        for name in self.columns:
            self._write(name, number, other._file(name, number).read_bytes())
        write_whole(self._receipt_file(number), other._receipt_file(number).read_bytes())


def _beyond(study: Mapping) -> str:
    """Return a sentence on a number of the study that is out of range; empty if there is none."""
    for name, most in {"samples": MOST_SAMPLES, "chunk": MOST_LANES, "block": MOST_LANES}.items():
        value = study.get(name)
        if type(value) is not int or not 1 <= value <= most:
            return f"`{name}` is {shortened(value)}, expected a whole number from 1 to {most}"
    if study["samples"] > MOST_CHUNKS * study["chunk"]:
        return f"{study['samples']} samples are more than {MOST_CHUNKS} chunks of {study['chunk']}"
    return ""
