"""What is found of a scene, kept on disk between processes by a name that is the same wherever the same would be found.

The name is a digest of what was traced of the scene, operation by operation, constants included; of the values of its parameters; of what it states besides
(names, domain, privileged speeds); of the source of this package up to lowering; and of the versions of JAX and NumPy. What a digest cannot tell from
another one, such as a function of Python that a callback runs, makes a scene nameless: nothing of it is kept.
"""

import enum
import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import numpy as np

from jourdain_jax.build.domain import coordinate_bounds, speed_bounds
from jourdain_jax.build.sampling import seen_of
from jourdain_jax.build.trace import jaxpr_of_scene
from jourdain_jax.calculus.jaxprs import called
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.equations.listed import names_of_position_rows, names_of_rows
from jourdain_jax.native import disk
from jourdain_jax.program.calls import description
from jourdain_jax.program.interpret import own_rule
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene

_READ = ("calculus", "eager", "program", "scene", "equations", "build", "dynamics", "lowering")  # packages whose code decides what is found

_PLAIN = bool, int, float, str, bytes, np.dtype, enum.Enum, type(None)


class _Nameless(Exception):
    """Something that has no name of its own."""


def kept_of_scene(kind: str, scene: Scene, find: Callable[[], bytes], of_inputs: tuple[int, ...] = (), *more) -> bytes:
    """What `find` returns for a scene whose parameters are known: from the disk, or found and kept there.

    `of_inputs`: numbers of the loads whose potential depends on inputs; `more`: what else it depends on.
    """
    name = None if disk.folder() is None else name_of(kind, scene, of_inputs, more)
    return find() if name is None else disk.kept(name, find)


def name_of(kind: str, scene: Scene, of_inputs: tuple[int, ...], more: tuple) -> str | None:
    """The name of what is found of a scene (arguments as of `kept_of_scene`); None where something in the scene has no name of its own."""
    leaves = [(jax.tree_util.keystr(path), np.asarray(x)) for path, x in jax.tree_util.tree_leaves_with_path(scene)]
    names = scene.coordinate_names.entries, scene.speed_names.entries, scene.inputs.entries, scene.coordinates.quaternions
    named_rows = names_of_rows(scene), names_of_position_rows(scene), [(name, str(about.get("unit"))) for name, _, about in parameters_of(scene)]
    stated = type(scene).__name__, scene.conventions, scene.privileged, coordinate_bounds(scene), speed_bounds(scene), float(scene.example_span), seen_of(scene)
    traced = _digest_of_trace(scene, of_inputs)
    if traced is None:
        return None
    try:
        digest = _digest(_source(), (kind, jax.__version__, np.__version__, real_type(), traced, leaves, names, named_rows, stated, more))
    except _Nameless:
        return None
    return f"{kind}_{digest.hex()[:32]}"


@once_per_class
def _digest_of_trace(scene: Scene, of_inputs: tuple[int, ...]) -> bytes | None:
    """The digest of what was traced of a scene; None where something in it has no name of its own."""
    closed, shape = jaxpr_of_scene(scene, of_inputs)
    labels = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(shape)]
    try:
        return _digest(b"", (closed, labels))
    except _Nameless:
        return None


def _digest(begun: bytes, x) -> bytes:
    return hashlib.sha256(begun + repr(description(x, _details, _plain)).encode()).digest()


@cache
def _source() -> bytes:
    """A digest of the code that finds."""
    home = Path(__file__).parent.parent
    files = [file for package in _READ for file in sorted((home / package).glob("*.py"))]
    if Path(__file__) not in files:  # the source lies elsewhere, as in an archive
        raise _Nameless
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.parent.name}/{file.name} ".encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.digest()


def _details(equation):
    name, params = equation.primitive.name, equation.params
    if equation.effects or own_rule(name, params):
        raise _Nameless
    inner = called(name, params)
    return params if inner is None else (params.get("name"), inner)  # by their names, functions that bend by intention are told from others


def _plain(x):
    if not isinstance(x, _PLAIN):
        raise _Nameless
    return x
