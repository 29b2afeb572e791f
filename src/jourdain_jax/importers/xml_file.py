"""Reading XML: files, numbers in attributes, and what is left out: refused or listed, never passed over without a word."""

import os
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.names import as_names
from jourdain_jax.scene.tracebacks import users_level

Element = ElementTree.Element


class XmlFile:
    """A file of a robot while it is read: its root, where it lies, and what of it is left out."""

    def __init__(self, path, root_tag: str, format_name: str, ignore: Iterable[str]):
        """The file at `path`, or the text itself, whose root is `root_tag`. ValueError where it cannot be read or is another kind of file."""
        if not isinstance(path, str | os.PathLike):
            raise ValueError(f"`path` is {described(path)}, expected the path of a {format_name} file, or its text")
        self.ignore = as_names(ignore)
        text = str(path) if isinstance(path, str) and path.lstrip().startswith("<") else None
        self.folder = Path.cwd() if text is not None else Path(path).resolve().parent
        self.source = f"the {format_name} text" if text is not None else str(path)
        try:
            content = Path(path).read_bytes() if text is None else text
            self.root = ElementTree.fromstring(content)
        except OSError as error:
            raise ValueError(f"{self.source}: cannot be read ({error.strerror or type(error).__name__}); give the path of a {format_name} file") from None
        except ElementTree.ParseError as error:
            raise ValueError(f"{self.source}: is no XML ({error}); give a {format_name} file") from None
        if self.root.tag != root_tag:
            raise ValueError(f"{self.source}: its root is `{self.root.tag}`, expected `{root_tag}` of a {format_name} file")
        self._left_out: Counter[str] = Counter()

    def leave_out(self, what: str) -> None:
        """Note that something is left out that moves nothing, or that the user wants to be left out."""
        self._left_out[what] += 1

    def refuse(self, key: str, what: str, advice: str = "state it in a subclass") -> None:
        """A ValueError for something that is not read and would change the motion, unless `ignore` has its `key`."""
        if key not in self.ignore:
            raise ValueError(f'{self.source}: {what} is not read; {advice}, and give ignore=("{key}",) to read the file without')

    def warn(self) -> None:
        """A warning that lists what was left out, apart from what `ignore` names."""
        listed = [f"`{what}`" if count == 1 else f"`{what}` ({count})" for what, count in sorted(self._left_out.items()) if what not in self.ignore]
        if listed:
            warnings.warn(f"{self.source}: left out {', '.join(listed)}; `ignore` silences this", UserWarning, stacklevel=users_level())

    def fault(self, what: str) -> ValueError:
        """The error of this file."""
        return ValueError(f"{self.source}: {what}")

    def name(self, element: Element, what: str) -> str:
        """The name of an element that must have one."""
        name = element.get("name")
        if not name:
            raise self.fault(f"a {what} has no `name`; give it one")
        return name

    def numbers(self, text: str | None, count: int | None, what: str, default=None) -> Float[np.ndarray, "_"]:
        """The numbers in an attribute, as many as `count` (None: any). `default` where there is no attribute; ValueError without one."""
        if text is None:
            if default is None:
                raise self.fault(f"{what} is missing")
            return np.asarray(default, float)
        try:
            found = np.array([float(word) for word in text.split()], float)
        except ValueError:
            raise self.fault(f"{what} is `{text}`, expected numbers") from None
        if len(found) != (count or len(found)) or not np.all(np.isfinite(found)):
            raise self.fault(f"{what} is `{text}`, expected {count or 'finite'} number{'' if count == 1 else 's'}")
        return found

    def number(self, text: str | None, what: str, default: float | None = None) -> float:
        """The one number in an attribute."""
        return float(self.numbers(text, 1, what, None if default is None else [default])[0])
