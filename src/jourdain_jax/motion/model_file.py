"""Files of models: the findings of `build` as JSON, after a header line with versions and digests.

    {"format", "version", "jax", "precision", "scene", "sha256"}
    [how, {what: finding}]

`scene`: digest of its class, methods and values; `sha256`: digest of the second line; `how`: arguments of
`build`; `what`: the name of the function that computes the finding, and its case. An object of a class in
`KINDS` is written as {class name: fields}, an array as {"array": [type, shape, entries]}, a tuple as
{"tuple": [...]}, a dictionary as {"dict": pairs}.
"""

import hashlib
import json
from collections.abc import Hashable, Mapping
from typing import Any

import jax
import numpy as np

from jourdain_jax.calculus.files import FilePath, check_place, parsed, read_bytes, write_whole
from jourdain_jax.calculus.lazy_imports import version_of
from jourdain_jax.lowering.lowered_equations import Lowered, Stage
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.digests import digest
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.row_program import RowProgram
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import Variables

KINDS = {kind.__name__: kind for kind in (Structure, Lowered, Stage, RowProgram, Variables, Graph)}


def write(path: FilePath, scene: Scene, how: dict, found: Mapping[Hashable, Any]) -> None:
    """Write the findings about a scene and `how` to build it. The key of a finding is the name of the
    function that computes it and the first part of its cache key.
    """
    check_place(path)
    try:
        content = json.dumps(_encoded([how, dict(found)])).encode()
    except TypeError as error:
        raise ValueError(
            f"`{type(scene).__name__}` has parts that remain JAX calls, so its model cannot be "
            f"saved ({error}); build it again instead"
        ) from None
    write_whole(path, json.dumps(_about(scene, content)).encode() + b"\n" + content)


def read(path: FilePath, scene: Scene) -> tuple[dict[Hashable, Any], dict]:
    """Return the findings about a scene and the arguments of its `build`. Raises ValueError if the file is
    damaged or belongs to another scene, version or precision.
    """
    head, _, content = read_bytes(path, 2**30, "a model").partition(b"\n")
    stated, expected = parsed(json.loads, head, f"`{path}`", "a model"), _about(scene, content)
    if stated != expected:
        other = ", ".join(
            name
            for name, value in expected.items()
            if not isinstance(stated, dict) or stated.get(name) != value
        )
        raise ValueError(
            f"`{path}` is not a model of this `{type(scene).__name__}`: file and scene differ in "
            f"{other}; build and save it again"
        )
    how, found = _decoded(json.loads(content))
    return found, how


def _about(scene: Scene, content: bytes) -> dict:
    versions = {
        "format": 3,
        "version": version_of("jourdain-jax"),
        "jax": jax.__version__,
        "precision": bool(jax.config.jax_enable_x64),
    }
    return versions | {"scene": digest((type(scene), scene)), "sha256": hashlib.sha256(content).hexdigest()}


def _encoded(x: Any) -> Any:
    if isinstance(x, list):
        return [_encoded(y) for y in x]
    if isinstance(x, tuple):
        return {"tuple": [_encoded(y) for y in x]}
    if isinstance(x, dict):
        return {"dict": [[_encoded(key), _encoded(y)] for key, y in x.items()]}
    if isinstance(x, np.ndarray):
        return {"array": [x.dtype.str, list(x.shape), x.ravel().tolist()]}
    return {type(x).__name__: _encoded(vars(x))} if type(x) in KINDS.values() else x


def _decoded(x: Any) -> Any:
    if isinstance(x, list):
        return [_decoded(y) for y in x]
    if not isinstance(x, dict):
        return x
    ((kind, value),) = x.items()
    if kind == "array":
        return np.array(value[2], value[0]).reshape(value[1])
    parts = [_decoded(y) for y in value] if kind in ("tuple", "dict") else _decoded(value)
    if kind in ("tuple", "dict"):
        return {"tuple": tuple, "dict": dict}[kind](parts)
    made = object.__new__(KINDS[kind])
    vars(made).update(parts)
    return made
