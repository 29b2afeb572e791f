"""Reading of XML: files, contents of elements, numbers in attributes. Unsupported contents raise an error or
are listed in a warning.
"""

import difflib
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.files import check_depth, number, parsed, read_bytes, shortened
from jourdain_jax.calculus.reals import check_kind
from jourdain_jax.importers.tree import Mass, Matrix, Vector
from jourdain_jax.scene.arguments import warn
from jourdain_jax.scene.coordinates import Labels, as_labels, check_name, nearest

Element = ElementTree.Element
LARGEST = 100_000_000  # tuning: bytes of the largest permitted file


@dataclass(frozen=True)
class Holds:
    """Supported contents of an element, by name, separated by spaces."""

    read: str = ""  # attributes
    one: str = ""  # children, each at most once
    many: str = ""  # children, any number of each
    idle: str = ""  # attributes and children without effect on the motion, skipped silently
    listed: str = ""  # children without effect on the motion, listed in a warning
    # attributes that may affect the motion -> their values without effect
    off: Mapping[str, str] = field(default_factory=dict)
    words: Mapping[str, Labels] = field(default_factory=dict)  # attributes -> their permitted values


class XmlFile:
    """A robot file that is being read: its root element, its location, and omitted parts."""

    def __init__(self, path, table: Mapping[str, Holds], format_name: str, ignore: Iterable[str]):
        """Read the file at `path`, or the text `path` itself. `table`: the permitted contents of each
        element, the root first. Raises ValueError for an unreadable file and for other contents.
        """
        check_kind(path, str | os.PathLike, "`path`", f"the path of a {format_name} file, or its text")
        self.ignore, self.table = as_labels(ignore), table
        text = str(path) if isinstance(path, str) and path.lstrip().startswith("<") else None
        self.source = f"the {format_name} text" if text is not None else str(path)
        content = read_bytes(path, LARGEST, f"a {format_name} file") if text is None else text
        self.folder = Path.cwd() if text is not None else Path(path).resolve().parent
        self.root = _parsed(content, self.source)
        root_tag = next(iter(table))
        if self.root.tag != root_tag:
            raise self.fault(f"its root is `{self.root.tag}`, expected `{root_tag}` of a {format_name} file")
        if any("xacro" in str(element.tag) for element in self.root.iter()):
            raise self.fault("it has elements of xacro; let `xacro FILE > robot.urdf` write the URDF first")
        self._left_out: Counter[str] = Counter()
        if "include" in table:
            self._include(self.root, set())
            check_depth(self.root, list, self.source)
        self._check(self.root, f"`{root_tag}`", root_tag)

    def _include(self, holder: Element, known: set[Path]) -> None:
        """Replace elements `include` by the contents of other files. Raises ValueError for a file that is
        included twice, or in itself.
        """
        for k, child in reversed(list(enumerate(holder))):
            if child.tag != "include":
                self._include(child, known)
                continue
            path = self.folder / child.get("file", "")
            if path in known:
                raise self.fault(f"`{path.name}` is included twice; expected once")
            known.add(path)
            inner = _parsed(read_bytes(path, LARGEST, "an included file"), str(path))
            self._include(inner, known)
            holder[k : k + 1] = list(inner)

    def _check(self, element: Element, what: str, kind: str) -> None:
        """Raise ValueError for contents of an element that are neither in the table nor in `ignore`. `what`:
        name of the element in messages.
        """
        holds = self.table[kind]
        self.check_attributes(kind, element.attrib, what)
        self.check_text(element, what)
        counts = Counter(child.tag for child in element)
        if twice := next((tag for tag in holds.one.split() if counts[tag] > 1), None):
            raise self.fault(f"{what} has {counts[twice]} elements `{twice}`, expected one")
        where = "" if element is self.root else f" of {what}"
        for child in element:
            tag, name = str(child.tag).rpartition("}")[2], child.get("name")
            if child.tag in holds.one.split() + holds.many.split():
                inner = f"{kind}/{tag}" if f"{kind}/{tag}" in self.table else tag
                self._check(
                    child,
                    f"{tag} `{name}`" if name and tag in holds.many.split() else f"`{tag}`{where}",
                    inner,
                )
            elif child.tag in holds.listed.split():
                self.leave_out(child.tag)
            elif child.tag not in holds.idle.split():
                # names of another XML namespace resemble no valid name
                valid = f"{holds.one} {holds.many}" if tag == child.tag else ""
                self.refuse(tag, f"`{child.tag}`{f' `{name}`' if name else ''} in {what}", valid=valid)

    def check_text(self, element: Element, what: str) -> None:
        """Raise ValueError for text in an element, unless `ignore` contains "text"."""
        if text := "".join([element.text or "", *(child.tail or "" for child in element)]).strip():
            self.refuse("text", f"the text `{shortened(text)}` in {what}", "state numbers in attributes")

    def check_attributes(self, kind: str, attributes: Mapping[str, str], what: str) -> None:
        """Raise ValueError for an unknown attribute of this kind of element, unless ignored, and for an
        unknown value of a known attribute.
        """
        holds = self.table[kind]
        for name, value in attributes.items():
            if value not in holds.words.get(name, (value,)):
                raise self.fault(
                    f"`{name}` of {what} is `{shortened(value)}`; {nearest(value, holds.words[name])}"
                )
            if name not in f"{holds.read} {holds.idle}".split() and not (
                name in holds.off and _is_off(value, holds.off[name])
            ):
                self.refuse(
                    name.rpartition("}")[2],
                    f'`{name.rpartition("}")[2]}="{shortened(value)}"` of {what}',
                    valid=holds.read,
                )

    def leave_out(self, what: str) -> None:
        """Record an omitted element, which has no effect on the motion or is ignored by the user."""
        self._left_out[what] += 1

    def refuse(self, key: str, what: str, advice: str = "state it in a subclass", valid: str = "") -> None:
        """Raise ValueError for unsupported contents, unless `ignore` contains its `key`. `valid`: names to
        suggest.
        """
        if key not in self.ignore:
            meant = "".join(
                f"did you mean `{name}`? Otherwise "
                for name in difflib.get_close_matches(key, valid.split(), 1, 0.7)
            )
            raise ValueError(
                f"{self.source}: {what} is not supported; {meant}{advice}, and give "
                f'ignore=("{shortened(key)}",) to read the file without it'
            )

    def warn(self) -> None:
        """Issue a warning that lists omitted elements, except those in `ignore`."""
        counted = {what: count for what, count in sorted(self._left_out.items()) if what not in self.ignore}
        listed = [
            f"`{shortened(what)}`{f' ({count})' if count > 1 else ''}" for what, count in counted.items()
        ]
        if listed:
            warn(f"{self.source}: omitted {', '.join(listed)}; `ignore` silences this")

    def fault(self, what: str) -> ValueError:
        """Return a ValueError about this file."""
        return ValueError(f"{self.source}: {what}")

    def check_name(self, name: str, valid: Iterable[str], what: str) -> None:
        """Raise ValueError with the text `what` unless the name is one of the `valid` names."""
        check_name(name, valid, f"{self.source}: {what}")

    def named(self, kind: str) -> "dict[str, Part]":
        """Return the elements of a kind in the root by name. Raises ValueError for a missing or repeated
        name.
        """
        found: dict[str, Part] = {}
        for element in self.root.findall(kind):
            name = element.get("name")
            if not name:
                raise self.fault(f"a {kind} has no `name`; give it one")
            if name in found:
                raise self.fault(f"two {kind}s are called `{name}`; give each its own name")
            found[name] = Part(self, f"{kind} `{name}`", element)
        return found


def _parsed(content: str | bytes, source: str) -> Element:
    root = parsed(ElementTree.fromstring, content, source, "valid XML")
    check_depth(root, list, source)
    return root


class Part:
    """An XML element that is being read: its attributes, its children and its name `what` in messages.
    `element` is None if the file lacks the element.
    """

    def __init__(
        self, file: XmlFile, what: str, element: Element | None, attributes: Mapping[str, str] | None = None
    ):
        """Store the element. `attributes`: used in place of the element's own attributes, if given."""
        self.file, self.what, self.element = file, what, element
        self.given: Mapping[str, str] = attributes or ({} if element is None else element.attrib)

    def __contains__(self, word: str) -> bool:
        return word in self.given

    def children(self, *kinds: str) -> list[Element]:
        """Return the child elements of some kinds."""
        return [] if self.element is None else [child for child in self.element if child.tag in kinds]

    def child(self, kind: str) -> "Part":
        """Return the first child element of a kind."""
        return Part(self.file, f"`{kind}` of {self.what}", next(iter(self.children(kind)), None))

    def numbers(self, word: str, count: int | None, default=None) -> Float[np.ndarray, "_"]:
        """Return the numbers in an attribute, `count` of them (None: any number). If the attribute is
        missing, return `default`, or raise ValueError without one.
        """
        text, what = self.given.get(word), f"{word} of {self.what}"
        if text is None:
            if default is None:
                raise self.file.fault(f"{what} is missing")
            return np.asarray(default, float)
        found = np.array(
            [number(x, f"{self.file.source}: {what}") for x in re.findall(r"[^ \t\r\n]+", text)], float
        )
        if len(found) != (count or max(1, len(found))):
            raise self.file.fault(
                f"{what} is `{shortened(text)}`, expected {count or 'finite'} "
                f"number{'' if count == 1 else 's'}"
            )
        return found

    def number(self, word: str, default: float | None = None) -> float:
        """Return the single number in an attribute."""
        return float(self.numbers(word, 1, None if default is None else [default])[0])

    def direction(self, word: str, default) -> Float[np.ndarray, "3"]:
        """Return the unit vector along three numbers. Raises ValueError for zeros."""
        along = self.numbers(word, 3, default)
        if not np.any(along):
            raise self.fault(word, "zero, expected a direction")
        return along / np.linalg.norm(along)

    def fault(self, word: str, what: str) -> ValueError:
        """Return the error for an invalid attribute."""
        return self.file.fault(f"{word} of {self.what} is {what}")

    def mass(self, mass: float, centre: Vector, inertia: Matrix, *, moved: bool) -> Mass | None:
        """Return the mass properties of an element, or None for a zero mass. Raises ValueError for a mass
        that is not positive, except zero for a link that no joint moves.
        """
        if mass == 0 and not np.any(inertia):
            return None
        if not mass > 0 and (moved or mass < 0):
            raise self.fault("mass", f"{mass:g}, expected a number above zero")
        return Mass(mass, centre, inertia)

    def colour(self) -> tuple[str | None, float]:
        """Return colour and opacity for `jj.Visual`; the body's defaults if none is given."""
        if "rgba" not in self:
            return None, 1.0
        *levels, opacity = np.clip(self.numbers("rgba", 4), 0.0, 1.0)
        return "#{:02x}{:02x}{:02x}".format(*(round(255 * x) for x in levels)), float(opacity)


def _is_off(value: str, off: str) -> bool:
    try:
        return [number(x, "") for x in value.split()] == [number(x, "") for x in off.split()]
    except ValueError:
        return value in off.split()
