"""Conversion and checks of users' numbers: plain numbers, arrays of NumPy and JAX, nested lists."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import lru_cache
from types import ModuleType
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
from jax import dtypes
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Real

Entries: TypeAlias = Array | np.ndarray
Number = ArrayLike  # one number
Numbers = Real[Array | np.ndarray, "_"] | Sequence[ArrayLike]  # any number of them
Vector = Real[Array | np.ndarray, "3"] | Sequence[ArrayLike]  # three numbers
# most frequent annotations
Scalar = Float[Array, ""]
Parameter = Scalar | float  # parameter as the user gives it; the scene stores an array
Flag = Bool[Array, ""]
Count = Int[Array, ""]
Vector3 = Float[Array, "3"]
Matrix3 = Float[Array, "3 3"]
Speeds = Float[Array, "speeds"]
PerCoordinate = Float[Array, "coordinates"]
PerRow = Float[Array, "rows"]
PerTime = Float[Array, "times"]
PerContact = Float[Array, "contacts"]
ContactVectors = Float[Array, "contacts 3"]
ContactFlags = Bool[Array, "contacts"]
PerLane = Float[Array, "*lanes"]
Shape = tuple[int, ...]
Indices = tuple[int, ...]  # indices into an array, or of constraints, coordinates or speeds


def real_type() -> np.dtype:
    """Return the default floating-point type: double precision if enabled."""
    return dtypes.canonicalize_dtype(float)  # a fortieth of the time of `jnp.result_type(float)`


def rank_cutoff(dtype: jnp.dtype) -> float:
    """Return the relative cutoff below which singular values count as zero: 4096 eps of `dtype`."""
    return 4096 * float(jnp.finfo(dtype).eps)


def passing_cutoff(dtype: jnp.dtype) -> float:
    """Return the relative cutoff for motions *through* a loss of rank: sqrt(eps) of `dtype`.

    Round-off e in a row of size sigma causes a velocity e/sigma and an acceleration e/sigma^2; adaptive steps
    resolve these down to sigma of about `sqrt(e)`.
    """
    return max(rank_cutoff(dtype), float(jnp.finfo(dtype).eps) ** 0.5)


def undecided(dtype: jnp.dtype) -> float:
    """Return the relative row size below which round-off decides the branch of a motion: `8 sqrt(eps)` of
    `dtype`.

    Round-off e turns two crossing branches of g = 0 into the hyperbola g = e. Within about sqrt(e) of the
    crossing, a motion on the hyperbola passes from one branch to the other.
    """
    return 8 * float(jnp.finfo(dtype).eps) ** 0.5


def is_array(x) -> bool:
    """Return whether x is an array of JAX, NumPy or another library."""
    return hasattr(x, "__array__") and not isinstance(x, type)


def as_real(x) -> Float[Array, "*shape"]:
    """Return `x` as a floating-point array. Integers become the default float; floats keep their type. The
    result is never weakly typed, which would cause a second trace.

    Raises TypeError for complex numbers and booleans.
    """
    array = _of_jax(x)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return jnp.asarray(array, array.dtype) if array.weak_type else array
    if not jnp.issubdtype(array.dtype, jnp.integer):
        raise TypeError(f"real numbers are expected, but these are of type {array.dtype}")
    return jnp.asarray(array, real_type())


def _of_jax(x) -> Array:
    """Return `x` as a JAX array; extended precision becomes double. Raises TypeError for a quantity with a
    unit.
    """
    if isinstance(x, jax.Array):
        return x
    if has_unit(x):
        raise TypeError(f"real numbers are expected, but this is {described(x)}")
    try:
        if type(x) in (int, float) or getattr(x, "dtype", None) == np.longdouble:
            x = np.asarray(x, real_type())
        # without a dtype, JAX compiles a program for each shape of a NumPy array
        is_float = isinstance(x, np.ndarray) and x.dtype.kind == "f"
        return jnp.asarray(x, jax.dtypes.canonicalize_dtype(x.dtype) if is_float else None)
    except OverflowError:
        raise ValueError("an integer is too large for a floating-point number; use a smaller one") from None


def checked_real(
    value, what: str, shape: Shape | None = None, *, advice: str = "check how it was built"
) -> Array:
    """Return `value` as a floating-point array.

    **Arguments**

    - `value`: a number, an array, or a list of numbers; integers and extended precision are converted, other
      floats keep their type.
    - `what`: name of the value in error messages.
    - `shape`: required shape; None: any. Shapes are static, so the check costs nothing at run time.
    - `advice`: what to do, for error messages.

    **Raises** ValueError for values that are not real numbers, or for another shape.
    """
    try:
        array = _of_jax(value)
    except (TypeError, ValueError):
        if getattr(value, "dtype", None) == np.clongdouble:
            _check(value, what, shape, advice)
        raise ValueError(f"{what} is {described(value)}, expected real numbers; {advice}") from None
    _check(array, what, shape, advice)
    return as_real(array)


def checked_positive(value, what: str, shape: Shape | None = (), *, advice: str = "use metres") -> Array:
    """Return the result of `checked_real`. Also raise ValueError for concrete numbers that are
    not positive.
    """
    found = checked_real(value, what, shape, advice=advice)
    if not np.all(known_numbers(found) > 0):
        raise ValueError(f"{what} is {np.asarray(found).tolist()}, expected positive numbers; {advice}")
    return found


def checked_known(
    value, what: str, shape: Shape | None = None, *, advice: str = "check how it was built"
) -> np.ndarray:
    """Return a concrete `value` as a NumPy array of the default float, even inside `jit`. Arguments and
    errors as for `checked_real`.
    """
    if type(value) is float and not shape:
        return np.array(value, real_type())
    try:
        array = np.array(None) if has_unit(value) else np.asarray(value)
    except (TypeError, ValueError):
        array = np.array(None)
    if array.dtype.kind in "OUSMm" or np.ma.is_masked(value):
        raise ValueError(f"{what} is {described(value)}, expected real numbers; {advice}")
    _check(array, what, shape, advice)
    return array.astype(real_type())


def checked_unless_traced(value, what: str, shape: Shape | None = None, *, advice: str):
    """Return `value` in the default float: a concrete value as a NumPy array, even inside `jit`; a traced
    value as a JAX array. Raises the same errors as `checked_real`.
    """
    if type(value) is not float and is_traced(value):
        return checked_real(value, what, shape, advice=advice).astype(real_type())
    return checked_known(value, what, shape, advice=advice)


def checked_whole(value, what: str, low: int, high: int | None = None, *, expected: str) -> int:
    """Return an integer from `low` to `high`, or raise ValueError with the `expected` range."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < low or (high is not None and value > high):
        raise ValueError(f"{what} is {value!r}, expected a whole number {expected}")
    return int(value)


def holds(condition: Callable, *numbers) -> bool:
    """Return whether a condition holds for all numbers; traced numbers count as satisfying it."""
    return is_traced(*numbers) or bool(np.all(condition(*map(np.asarray, numbers))))


def has_unit(x) -> bool:
    """Return whether `x` is a quantity with a unit, or a list that contains one. As a number it would lose
    the unit, so 1,300 g would become 1,300 kg.
    """
    if isinstance(x, list | tuple):
        return any(has_unit(part) for part in x if type(part) is not float)
    return _may_have_unit(type(x)) and any(
        hasattr(type(x), name) or name in getattr(x, "__dict__", ()) for name in _UNITS
    )


def as_array(x, dtype):
    """Return an array of the given `dtype`: a NumPy array if concrete, a JAX array if traced."""
    return array_module(x).asarray(x, dtype)


def in_default_precision(tree):
    """Return the tree with floating-point arrays converted to the default type."""
    is_real = lambda x: is_array_type(type(x)) and jnp.issubdtype(x.dtype, jnp.floating)
    return jax.tree.map(lambda x: x.astype(real_type()) if is_real(x) else x, tree)


def _check(array, what: str, shape: Shape | None, advice: str) -> None:
    real = jnp.issubdtype(array.dtype, jnp.integer) or jnp.issubdtype(array.dtype, jnp.floating)
    if array.dtype.kind not in "iuf" and not real:
        raise ValueError(f"{what} is of type {array.dtype}, expected real numbers; {advice}")
    if shape is not None and array.shape != shape:
        expected = "one number" if shape == () else str(shape)
        raise ValueError(f"{what} has shape {array.shape}, expected {expected}; {advice}")


def static(**default) -> Any:
    """Declare a static field of a module, which is part of the compilation key."""
    return eqx.field(static=True, **default)


def check_kind(value, kind, what: str, expected: str) -> None:
    """Raise a ValueError that describes `value` unless it is an instance of `kind`, a class or union of
    classes.
    """
    if not isinstance(value, kind):
        raise ValueError(f"{what} is {described(value)}, expected {expected}")


def described(value) -> str:
    """Describe a value for an error message: `None`, the text 'abc', the class `Skate`, a list."""
    if value is None:
        return "`None`"
    if has_unit(value):
        return f"a quantity with a unit (`{type(value).__name__}`), which would be lost"
    if isinstance(value, str):
        return f"the text {value!r}"
    if isinstance(value, complex):
        return f"the complex number {value}"
    if isinstance(value, type):
        return f"the class `{value.__name__}`"
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        numbers = getattr(value.dtype, "kind", "O") not in "OUSMm"
        masked = ", of which some are masked" if np.ma.is_masked(value) else ""
        return (
            f"an array of shape {tuple(value.shape)}{masked}"
            if numbers
            else f"an array of {value.dtype}, shape {tuple(value.shape)}"
        )
    name = type(value).__name__
    return f"an {name}" if name[0] in "aeioAEIO" else f"a {name}"


def is_traced(*trees) -> bool:
    """Return whether any leaf is traced."""
    # plain numbers and NumPy arrays are not traced; this check takes a tenth of the time of the next line
    unknown = [tree for tree in trees if not isinstance(tree, float | int | np.ndarray)]
    return bool(unknown) and any(map(is_traced_type, map(type, jax.tree.leaves(unknown))))


def known_numbers(x) -> np.ndarray:
    """Return concrete numbers for a check; an empty array, which passes every check, if they are traced."""
    return np.zeros(0) if is_traced(x) else np.asarray(x)


def largest(x, axis: int | Indices | None = None, keepdims: bool = False):
    """Return the largest magnitude of an array (JAX or NumPy) or along its axes; zero if empty."""
    return abs(x).max(axis, keepdims=keepdims, initial=0.0)


def all_finite(x, axis: int | Indices | None = None):
    """Return whether all concrete numbers of an array, or all along the given axes, are finite."""
    return np.isfinite(x).all(axis)


def eps_of(x):
    """Return the machine epsilon of an array's type."""
    return jnp.finfo(x.dtype).eps


def tiny_of(x):
    """Return the smallest normal number of an array's type."""
    return jnp.finfo(x.dtype).tiny


def at_index(tree, index):
    """Return the tree with `x[index]` for each array `x`. NumPy indexes arrays in this machine's memory,
    since JAX would compile two programs for each shape.
    """
    known = not is_traced((tree, index))
    here = lambda x: known and isinstance(x, jax.Array) and {d.platform for d in x.devices()} == {"cpu"}
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[index]) if here(x) else x[index], tree)


def array_module(x) -> ModuleType:
    """Return `jax.numpy` if anything in `x` is traced, otherwise NumPy."""
    return jnp if is_traced(x) else np


def nothing_is_traced() -> bool:
    """Return whether this call is outside all JAX transformations."""
    return jax.extend.core.get_opaque_trace_state(convention="flax") == _NOTHING_TRACED


def at_once():
    """Return a context that evaluates concrete numbers immediately, even inside a trace."""
    return nullcontext() if nothing_is_traced() else jax.ensure_compile_time_eval()


with jax.ensure_compile_time_eval():
    _NOTHING_TRACED = jax.extend.core.get_opaque_trace_state(convention="flax")

_UNITS = "units", "unit", "magnitude"  # attributes of quantities with units in pint, astropy, unyt and others
_PLAIN = bool, int, float, complex, np.ndarray
_NEVER = np.generic | jax.Array | jax.core.Tracer | type
_may_have_unit: Callable[[type], bool] = lru_cache(maxsize=1024)(
    lambda kind: (
        kind not in _PLAIN
        and not issubclass(kind, _NEVER)
        and (hasattr(kind, "__float__") or hasattr(kind, "__array__"))
    )
)

# Cached by type: a tenth of the time of an isinstance check against the classes of JAX.
is_traced_type: Callable[[type], bool] = lru_cache(maxsize=1024)(
    lambda kind: issubclass(kind, jax.core.Tracer)
)
is_array_type: Callable[[type], bool] = lru_cache(maxsize=1024)(
    lambda kind: issubclass(kind, jax.Array | jax.core.Tracer | np.ndarray | np.generic)
)
