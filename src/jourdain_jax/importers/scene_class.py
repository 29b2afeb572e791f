"""Scene classes made from a description: parameters become fields with defaults, as in handwritten classes.

Names of other tools are converted to Python identifiers for fields, coordinates, speeds and inputs.
"""

import keyword
import re
from collections.abc import Iterable
from typing import Any

from jourdain_jax.scene.scene import Scene

_TAKEN = ("t", "array", "slots", "keys")  # names of the time and of attributes of containers


def identifier(name: str) -> str:
    """Return the name as a Python identifier: characters other than letters, digits and underscores become
    underscores, so that `left-wheel` becomes `left_wheel`.
    """
    plain = re.sub(r"\W+", "_", name).strip("_") or "unnamed"
    plain = f"_{plain}" if plain[0].isdigit() else plain
    return f"{plain}_" if keyword.iskeyword(plain) or plain in _TAKEN else plain


def identifiers(names: Iterable[str], kind: str, taken: Iterable[str] = ()) -> dict[str, str]:
    """Return name -> identifier, with a trailing underscore if the identifier is `taken`. Raises ValueError
    for equal names, and for names with equal identifiers.
    """
    found: dict[str, str] = {}
    taken = set(taken)
    for name in names:
        new = identifier(name)
        new = f"{new}_" if new in taken else new
        twin = next((other for other, known in found.items() if known == new), None)
        if twin == name:
            raise ValueError(f"two {kind}s are called `{name}`; give each its own name")
        if twin is not None:
            raise ValueError(
                f"{kind}s `{twin}` and `{name}` would both be called `{new}`; rename one of them"
            )
        found[name] = new
    return found


def scene_class(
    base: type[Scene], name: str, about: str, fields: dict[str, Any], attributes: dict[str, Any]
) -> type[Scene]:
    """Return a subclass of `base` called `name` (`my-robot` becomes `MyRobot`), with docstring `about`,
    `fields` made by `parameter`, and further class `attributes`.
    """
    words = [word for word in re.split(r"[\W_]+", name) if word]
    name = identifier("".join(word[0].upper() + word[1:] for word in words) or "Scene")
    annotations = dict.fromkeys(fields, object)
    namespace = {
        "__module__": base.__module__,
        "__qualname__": name,
        "__doc__": about,
        "__annotations__": annotations,
        **fields,
        **attributes,
    }
    return type(base)(name, (base,), namespace)
