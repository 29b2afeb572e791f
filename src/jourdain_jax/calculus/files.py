"""Reading of foreign files with limits on size, nesting and numbers, and atomic writing of this package's
files.

Any fault in a foreign file raises a ValueError with the path and, if known, the line or element.

Files are written under a temporary name and renamed in one step, so a killed process never leaves a partial
file. After a power failure a file may be incomplete, unless `write_whole` has waited for the disk.
"""

import contextlib
import difflib
import math
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from jourdain_jax.calculus.reals import described

FilePath = str | os.PathLike[str]
DEEPEST = 250  # tuning: nesting depth of elements: bodies of a chain, in MJCF
_NUMBER = re.compile(
    r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf(inity)?|nan)", re.ASCII | re.IGNORECASE
)


def read_bytes(path: FilePath, limit: int, what: str = "a file") -> bytes:
    """Return the content of the file `path`, at most `limit` bytes. `what`: kind of file for error messages,
    such as "a URDF file".
    """
    with opened(path, what) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"{path}: larger than {limit} bytes, the limit for {what}")
    return content


@contextlib.contextmanager
def opened(path: FilePath, what: str) -> Iterator[BinaryIO]:
    """Open the file `path` for reading; `what` as in `read_bytes`. Raises ValueError if it cannot be read or
    `path` is not a path.
    """
    try:
        with open(name_of(path), "rb") as file:
            yield file
    except OSError as error:
        said = error.strerror or type(error).__name__
        raise ValueError(
            f"{shortened(path, 300)}: cannot be read ({said}); pass the path of "
            f"{what}{_near(Path(path), error)}"
        ) from None


def name_of(path) -> str:
    """Return the path of a file or folder as a string. Raises ValueError if it is not a path."""
    try:
        found = os.fsencode(path)
    except (TypeError, UnicodeError):
        found = b"\0"
    if b"\0" in found:
        said = shortened(described(path), 300)
        raise ValueError(f"`path` is {said}, expected the name of a file or folder")
    return os.fsdecode(found)


def read_text(path: FilePath, limit: int, what: str = "a text file") -> str:
    """Return the text of the file `path`, which must be UTF-8 without zero bytes; arguments as in
    `read_bytes`.
    """
    content = read_bytes(path, limit, what)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: not UTF-8 text (byte {error.start} is {content[error.start]:#04x}), expected {what}"
        ) from None
    if "\0" in text:
        raise ValueError(f"{path}: a binary file (it contains zero bytes), expected {what}")
    return text


def number(text: str, what: str, *, finite: bool = True, advice: str = "") -> float:
    """Convert `text` (ASCII digits, point, exponent) to a number; with `finite=False` also inf and nan.

    `what`: source and name of the number for error messages; `advice`: end of the message. Raises ValueError
    also for grouped digits (`1_0`) and digits of other scripts.
    """
    plain = text.strip(" \t\r\n")
    value = float(plain) if _NUMBER.fullmatch(plain) else None
    if value is None or (finite and not math.isfinite(value)):
        hint = ", with `.` as the decimal point" if "," in plain else ""
        raise ValueError(
            f"{what} is `{shortened(plain)}`, expected a "
            f"{'finite ' if value is not None else ''}number{hint}{advice}"
        )
    return value


def whole_number(text: str, what: str, high: int) -> int:
    """Return the integer from 1 to `high` in `text`; `what` as in `number`."""
    plain = text.strip(" \t\r\n")
    if not re.fullmatch(r"[+-]?\d{1,30}", plain, re.ASCII) or not 1 <= int(plain) <= high:
        raise ValueError(f"{what} is `{shortened(plain)}`, expected a whole number from 1 to {high}")
    return int(plain)


def parsed(parse: Callable, content, source: str, what: str):
    """Return `parse(content)`. Any error of the parser becomes a ValueError that names the source and the
    expected format `what`, such as "valid XML".
    """
    try:
        return parse(content)
    except RecursionError:
        raise _too_deep(source) from None
    except Exception as error:
        raise ValueError(f"{source}: not {what} ({shortened(error, 200) or type(error).__name__})") from None


def check_depth(root, inner: Callable[..., Iterable], source: str) -> None:
    """Raise a ValueError for nesting deeper than `DEEPEST`. `inner(value)`: the values nested
    directly in a value.
    """
    level = [root]
    for _ in range(DEEPEST):
        level = [thing for holder in level for thing in inner(holder)]
        if not level:
            return
    raise _too_deep(source)


def shortened(text: object, length: int = 60) -> str:
    """Return foreign text truncated for an error message."""
    text = str(text)
    return text if len(text) <= length else f"{text[: length - 3]}..."


def _too_deep(source: str) -> ValueError:
    return ValueError(f"{source}: nested more than {DEEPEST} levels deep; give a flatter file")


def _near(path: Path, error: Exception) -> str:
    """Return a suggestion for a missing file: the nearest name in its folder."""
    found: list[str] = []
    with contextlib.suppress(OSError):
        if isinstance(error, FileNotFoundError):
            found = difflib.get_close_matches(path.name, os.listdir(path.parent), 1)
    return f". Did you mean `{found[0]}`?" if found else ""


_BINARY = getattr(os, "O_BINARY", 0)  # without it, Windows writes a line feed as two bytes


def check_place(path: FilePath) -> None:
    """Raise ValueError if no file can be written at `path`: its folder is missing, or it is a folder."""
    place = name_of(path)
    folder = os.path.dirname(place) or "."
    try:
        if not os.path.basename(place) or stat.S_ISDIR(os.stat(place).st_mode):
            raise ValueError(f"cannot write `{place}`: it is a folder; pass the name of a file in it")
    except FileNotFoundError:
        if not os.path.isdir(folder):
            said = f"cannot write `{place}`: there is no folder `{folder}`; create it first"
            raise ValueError(said) from None
    except OSError as error:
        raise ValueError(f"cannot write `{shortened(place, 300)}`: {error.strerror}") from None


def write_whole(
    path: FilePath, content: bytes | memoryview, *, wait: bool = False, mode: int = 0o666
) -> None:
    """Write `content` to `path` atomically. `wait`: return only when it is on the disk; `mode`: permissions
    as in `open`.
    """
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
