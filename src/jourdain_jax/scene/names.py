"""Named access to flat arrays, and error messages that list the valid and the nearest names."""

import difflib
from collections.abc import Iterable

import equinox as eqx
from jaxtyping import Array, Float

Labels = tuple[str, ...]
Sentences = tuple[str, ...]  # messages to the user


class UnknownNameError(KeyError):
    """Raised for a name that does not exist; unlike KeyError, it prints its message without quotes."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return the end of an error message: the nearest valid name, if any is near, and all valid names."""
    valid = list(valid)
    match = difflib.get_close_matches(str(name), valid, n=1, cutoff=0.5)
    names = ", ".join(f"`{v}`" for v in valid) or "none"
    return f"did you mean `{match[0]}`? Valid names: {names}." if match else f"valid names: {names}."


def check_name(name: str, valid: Iterable[str], what: str, error: type[Exception] = ValueError) -> None:
    """Raise an error with the text `what` and the nearest valid name, unless the name is valid."""
    if name not in valid:
        raise error(f"{what}; {nearest(name, valid)}")


def check_names(
    names: Iterable[str], valid: Iterable[str], what: str, error: type[Exception] = ValueError
) -> None:
    """Check several names. `{}` in the text `what` is replaced by the invalid name."""
    for name in names:
        check_name(name, valid, what.replace("{}", str(name)), error)


def as_names(names: "str | Iterable[str]") -> Labels:
    """Return names as a tuple. In a text, names are separated by spaces, as in `jj.coordinates`."""
    if not isinstance(names, str | Iterable):
        raise ValueError(f"`{names}` was given, expected names, in one text or in several")
    return tuple(names.split() if isinstance(names, str) else names)


def as_labels(labels: "str | Iterable[str]") -> Labels:
    """Return names of another tool as a tuple. A text is one name, since such names may contain blanks."""
    return (labels,) if isinstance(labels, str) else as_names(labels)


class Named(eqx.Module):
    """A flat array with access by name to entries and groups of entries: `q.yaw`, `q["yaw"]`, `q.array`."""

    array: Float[Array, "*shape"]
    # name, first entry, length (0 for a scalar)
    slots: tuple[tuple[str, int, int], ...] = eqx.field(static=True)

    def __getitem__(self, name: str):
        for slot, first, length in self.slots:
            if slot == name:
                return self.array[..., first] if length == 0 else self.array[..., first : first + length]
        if not isinstance(name, str):
            raise TypeError(
                f"`{name}` was given, but entries are accessed by name; write `q.yaw` or `q['yaw']`, or "
                "`q.array[0]` for the first entry"
            )
        raise UnknownNameError(f"no entry `{name}`; {nearest(name, [slot for slot, _, _ in self.slots])}")

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __contains__(self, name: str) -> bool:
        return name in self.keys()

    def keys(self) -> Labels:
        """Return the names, in order."""
        return tuple(slot for slot, _, _ in self.slots)
