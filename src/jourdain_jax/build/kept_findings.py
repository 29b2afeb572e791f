"""What is found of a scene, kept on disk between processes by a name that is the same wherever the same would be found.

The name is a digest of what was traced of the scene, operation by operation, constants included; of the values of its parameters; of what it states besides
(names, domain, privileged speeds); of the source of this package up to lowering; and of the versions of JAX and NumPy. What a digest cannot tell from
another one, such as a function of Python that a callback runs, makes a scene nameless: nothing of it is kept.
"""

import enum
import hashlib
from collections.abc import Callable, Iterable
from functools import cache, lru_cache
from pathlib import Path

import jax
import numpy as np
from jax.extend.core import Literal, Primitive

from jourdain_jax.build.domain import coordinate_bounds, speed_bounds
from jourdain_jax.build.sampling import seen_of
from jourdain_jax.build.trace import jaxpr_of_scene
from jourdain_jax.calculus.jaxprs import called
from jourdain_jax.calculus.reals import is_array, real_type
from jourdain_jax.equations.listed import names_of_position_rows, names_of_rows
from jourdain_jax.native import disk
from jourdain_jax.program.interpret import own_rule
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene

_READ = ("calculus", "eager", "program", "scene", "equations", "build", "dynamics", "lowering")  # packages whose code decides what is found


_SEVERAL = tuple, list  # kept as tuples: a union of types is made anew wherever it stands
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
    digest = hashlib.sha256(begun)
    for part in _parts(x):
        digest.update(part)
    return digest.digest()


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


def _parts(x) -> Iterable[bytes]:
    """What tells an object from others."""
    if isinstance(x, _SEVERAL):
        yield f"{len(x)} of {type(x).__name__}: ".encode()
        for y in x:
            yield from _parts(y)
    elif is_array(x):
        x = np.asarray(x)
        if x.dtype.hasobject:
            raise _Nameless
        yield f"array {x.dtype} {x.shape} ".encode() + x.tobytes()
    elif isinstance(x, _PLAIN):
        yield f"{type(x).__name__} {x!r};".encode()
    elif hasattr(x, "jaxpr") and hasattr(x, "consts"):
        yield from _of_jaxpr(x.jaxpr)
        yield from _parts(tuple(x.consts))
    elif hasattr(x, "eqns"):
        yield from _of_jaxpr(x)
    else:
        raise _Nameless


def _of_jaxpr(jaxpr) -> Iterable[bytes]:
    number = {v: k for k, v in enumerate([*jaxpr.constvars, *jaxpr.invars])}
    for equation in jaxpr.eqns:
        yield from _of_equation(equation, number)
        number |= {v: len(number) + k for k, v in enumerate(equation.outvars)}
    yield from _atoms(jaxpr.outvars, number)


def _of_equation(equation, number: dict) -> Iterable[bytes]:
    primitive: Primitive = equation.primitive
    if equation.effects or own_rule(primitive.name, equation.params):
        raise _Nameless
    yield f"\n{primitive.name} -> {[_said(v.aval) for v in equation.outvars]} ".encode()
    yield from _atoms(equation.invars, number)
    inner = called(primitive.name, equation.params)
    if inner is not None:
        yield from _parts((equation.params.get("name"), inner))  # by their names, functions that bend by intention are told from others
        return
    for key, value in sorted(equation.params.items()):
        yield key.encode()
        yield from _parts(value)


@lru_cache(maxsize=1024)
def _said(aval) -> str:
    """Type and shape as text, which JAX makes anew each time."""
    return str(aval)


def _atoms(atoms, number: dict) -> Iterable[bytes]:
    for atom in atoms:
        yield from _parts((_said(atom.aval), np.asarray(atom.val))) if isinstance(atom, Literal) else (f"{number[atom]},".encode(),)
