"""Values as text that holds no code, and back: numbers, texts, tuples of them, arrays and dictionaries by numbers. Every digit stays."""

import json
from typing import Any

import numpy as np


def as_text(value) -> bytes:
    """A text; TypeError for what is none of these."""
    return json.dumps(_plain(value), separators=(",", ":")).encode()


def from_text(text: bytes) -> Any:
    """The value; lists come back as tuples."""
    return _value(json.loads(text))


def _plain(x):
    if isinstance(x, np.ndarray):
        return {"type": x.dtype.str, "shape": list(x.shape), "entries": x.ravel().tolist()}
    if isinstance(x, np.bool_ | np.integer | np.floating):
        return x.item()
    if isinstance(x, tuple | list):
        return [_plain(y) for y in x]
    return {"keys": [_plain(key) for key in x], "values": [_plain(y) for y in x.values()]} if isinstance(x, dict) else x


def _value(x):
    if isinstance(x, list):
        return tuple(map(_value, x))
    if isinstance(x, dict) and "keys" in x:
        return dict(zip(_value(x["keys"]), _value(x["values"]), strict=True))
    return np.array(x["entries"], x["type"]).reshape(x["shape"]) if isinstance(x, dict) else x
