"""Consistent starts: project a guess of q and u onto the constraints, and report the size of the change.

g(t, q) = 0,  phi(t, q, u) = 0
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import (
    Number,
    Numbers,
    all_finite,
    at_once,
    check_kind,
    described,
    eps_of,
    is_traced,
    known_numbers,
    nothing_is_traced,
)
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows, velocity_residual
from jourdain_jax.integrate.constraint_projection import (
    OFF,
    Guess,
    contradiction,
    left_of,
    put_onto_constraints,
)
from jourdain_jax.integrate.inputs import inputs_at
from jourdain_jax.integrate.state import State
from jourdain_jax.motion.model import Model, modelled
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.program.evaluate import depend_on
from jourdain_jax.scene.arguments import (
    BuiltFor,
    InputLike,
    as_coordinates,
    as_input_vector,
    as_scene,
    as_speeds,
    one_time,
    shown_from_users_lines,
)
from jourdain_jax.scene.coordinates import Labels, check_names, nearest
from jourdain_jax.scene.scene import Scene, vectors_named
from jourdain_jax.structure.sampling import guesses_of
from jourdain_jax.structure.structure import Structure, structure_of

_NOTHING: Mapping = MappingProxyType({})


def consistent(
    scene: Scene | BuiltFor, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None, *, held: Labels = ()
) -> State:
    """Return the state nearest to (q, u) that satisfies the constraints g(t, q) = 0 and phi(t, q, u) = 0.
    Coordinates are projected by Gauss-Newton steps, speeds orthogonally in the metric of the mass matrix M.

    `inputs`: values of the scene's inputs (default: zero). `held`: names of coordinates and speeds that stay
    fixed.

    Differentiable in any mode. `residual` of the result is the remaining violation, infinite if a number is
    not finite; a large residual raises no error, so the function works inside jit and vmap. The quaternion
    (0, 0, 0, 0) has no direction and stays unchanged, with a residual of 1/2. Raises ValueError for wrong
    shapes.
    """
    model, scene = modelled(scene), as_scene(scene)
    coordinates, speeds = scene.coordinate_names.entries, scene.speed_names.entries
    t, q, u = one_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    check_names(held, coordinates + speeds, "`held` names `{}`, which is not a coordinate or speed")
    free_q, free_u = (free_entries(names, tuple(held)) for names in (coordinates, speeds))
    guess = Guess(q, u, free_q, free_u, ~free_entries(coordinates, ()), model.usual(False))
    return _consistent(scene, t, guess, _as_input_vector(scene, inputs, q.dtype))


def _consistent(scene: Scene, t, start: Guess, inputs, guesses: Callable | None = None) -> State:
    """Return the nearest state. If Newton's method fails, search by damped steps from q, then from the
    configurations `guesses()`.
    """
    given = scene, t, start, inputs
    if not nothing_is_traced() and is_traced(given):  # cheaper check first
        return _compiled_projection(*given, None if guesses is None else guesses())[0]
    # evaluate concrete numbers at once, even within a trace, which would otherwise compile each operation
    with at_once():
        state, arrived = _compiled_projection(*given, None)
        # not compiled: rarely needed, and slow to compile
        if guesses is not None and len(start.usual.closures) and not np.asarray(arrived):
            by_xla = start._replace(usual=replace(start.usual, program=None))
            state = jax.tree.map(jnp.asarray, _uncompiled_projection(scene, t, by_xla, inputs, guesses())[0])
    return state


def _as_input_vector(scene: Scene, inputs, dtype):
    """Return the input vector; a NumPy vector is returned without tracing."""
    if isinstance(inputs, np.ndarray) and inputs.shape == (len(scene.inputs),):
        return inputs
    return as_input_vector(scene, inputs, dtype)


# one program for every choice of held variables
_compiled_projection = compiled_quickly(put_onto_constraints)
_uncompiled_projection = eval_numpy(put_onto_constraints)


@shown_from_users_lines
def start(
    scene: Scene | BuiltFor,
    given: Any = None,
    *,
    near: Any = None,
    t0: Number = 0.0,
    inputs: Any = None,
    **values: Any,
) -> State:
    """Return a consistent start from named coordinates and speeds: `start(disc, lean=0.3, spin_rate=-3.0)`,
    or `start(disc, {"lean": 0.3, "spin_rate": -3.0})`.

    `values` at time `t0` (s), by keyword or in a dictionary `given` (keywords take precedence), stay fixed.
    If they violate the constraints by at most 1.5e-5, as rounded numbers may, they are moved onto the
    constraints.

    The search for omitted coordinates begins at zero (for a quaternion: at the identity). If it fails or
    leaves the scene's `domain`, it begins again at other states of the domain, nearest first; `guess` of the
    result counts these attempts. `near`: initial guesses of coordinates by name. Guessed coordinates, and
    coordinates that the constraints determine uniquely, may end outside the domain. If only some components
    of a quaternion are given, as in `attitude_w=cos(a / 2), attitude_x=sin(a / 2)`, the others are zero.

    Omitted independent ("privileged") speeds are zero, and dependent speeds follow from the constraints. If a
    dependent speed is given, the omitted speeds change as little as possible from zero, in the metric of the
    mass matrix, to satisfy the constraints.

    `inputs`: inputs by name, as in `simulate`; velocity constraints may depend on their values at `t0`. In a
    program to export, pass `jj.build(scene, backend="xla")` instead of the scene.

    Raises ValueError for an unknown name, a value that is not finite, and concrete values that contradict the
    constraints or leave no state within the domain. For traced values, `residual` is then infinite, and a
    motion from this start ends with a result code.
    """
    model = modelled(scene)
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(
            f"`start` was given {described(given)}, expected named values: `jj.start(scene, "
            "lean=0.3)`, or a dictionary of them"
        )
    check_kind(near, Mapping | None, "`near`", 'a dictionary of coordinates: near={"z": -0.4}')
    t = one_time(t0)
    _check_finite("t0", t)
    with model.standing_in:
        return named_start(
            model, {**(given or {}), **values}, t, inputs_at(model.inputs(inputs), t), near=near or {}
        )


def named_start(model: Model, values: Mapping, t, inputs, *, near: Mapping = _NOTHING) -> State:
    """Return the start from named values, as documented in `start`. `inputs`: values at time `t` (an array),
    as a vector or by name (None: zero).
    """
    scene = model.scene
    q, u, given = vectors_named(scene, {**near, **values})
    about = given if near else ()
    if near:
        given = vectors_named(scene, values)[2]
        for name in near:
            if name not in scene.coordinate_names:
                raise ValueError(
                    f"`near` names `{name}`, which is not a coordinate; "
                    f"{nearest(name, scene.coordinate_names.entries)}"
                )
    inputs = _as_input_vector(scene, inputs, q.dtype)
    held, contradict = model.once((given, about), lambda: _held(model, given, about))
    guess = Guess(q, u, *held)

    def check_finite() -> None:
        for name, value in {**near, **values}.items():
            _check_finite(name, value)

    def guesses():
        check_finite()
        known = structure_of(scene)
        return guesses_of(scene, known.coordinates[: known.random], q, guess.free_q)

    state = _consistent(scene, t, guess, inputs, guesses)
    if not (known_numbers(state.residual) < contradiction(q.dtype)).all():
        check_finite()
        _refuse(scene, guess, state, inputs, given)
    return _moved_if_near(model, state, inputs) if contradict else state


def _check_finite(name: str, value) -> None:
    if not all_finite(known_numbers(value)):
        raise ValueError(
            f"start value `{name}` is {value}, expected a finite number; check where it was computed"
        )


def _held(model: Model, given: Labels, about: Labels) -> tuple[tuple, bool]:
    """Return masks of free coordinates, free speeds, and coordinates that must stay in the domain; typical
    sizes; and whether given values may contradict each other.

    Omitted independent speeds stay zero unless a dependent speed is given. Coordinates that are neither given
    nor guessed must lie in the domain, unless the constraints are affine and determine them uniquely.
    """
    scene, known = model.scene, structure_of(model.scene)
    coordinates, speeds = scene.coordinate_names.entries, scene.speed_names.entries
    privileged = [speeds[i] for i in known.independent]
    resting = () if any(name in speeds and name not in privileged for name in given) else privileged
    free_q, free_u = free_entries(coordinates, given), free_entries(speeds, (*given, *resting))
    usual = model.usual(known.affine and not any(free_u[i] for i in known.independent))
    bounded, program = free_q & free_entries(coordinates, about), usual.program
    if program is not None:
        slopes = [n for (_, k), n in program.G.items() if free_q[k]]
        bounded = bounded & any(depend_on(program.graph, slopes, np.array(program.q)[free_q].tolist()))
    with at_once():
        # JAX arrays are passed to a program three times faster than NumPy arrays
        on_device = jax.device_put((free_q, free_u, bounded))
    return (*on_device, usual), may_contradict(scene, known, free_q, free_u)


def _moved_if_near(model: Model, start: State, inputs) -> State:
    """Project the whole start onto the constraints if its residual is too small for a contradiction.

    If the residual is only round-off, the start is unchanged. Traced values always get the derivatives of the
    projection, because values that agree for these parameters may contradict each other for others.
    """
    near = start.residual < contradiction(start.q.dtype)
    if not known_numbers(near & (start.residual > OFF * eps_of(start.q))).all():  # more than round-off
        return start
    state = consistent(model, start.t, start.q, start.u, inputs)
    moved = [jnp.maximum(a, b) for a, b in ((start.moved_q, state.moved_q), (start.moved_u, state.moved_u))]
    state = eqx.tree_at(lambda s: (s.moved_q, s.moved_u, s.guess), state, (*moved, start.guess))
    return jax.tree.map(lambda x, y: jnp.where(near, x, y), state, start)


def _refuse(scene: Scene, start: Guess, state: State, inputs, given: Labels) -> None:
    """Raise a ValueError that names the violated constraint."""
    who, held = type(scene).__name__, ", ".join(f"`{name}`" for name in given) or "none"
    g = np.abs(np.asarray(closure_residual(scene, state.t, state.q)))
    outside = np.flatnonzero(~np.asarray(start.inside(state.q)))
    for k in outside[:1] if float(left_of(jnp.asarray(g))) == 0 else ():
        name, found = scene.coordinate_names.entries[k], float(state.q[k])
        raise ValueError(
            f"no start of `{who}` has `{name}` in its `domain`, {scene.domain[name]}, with the given values "
            f"held ({held}); the nearest start has {found:.6g}. Change the values or the `domain`, or pass "
            f'near={{"{name}": {found:.2g}}} to search outside'
        )
    phi = np.abs(np.asarray(velocity_residual(scene, state.t, state.q, state.u, inputs)))
    names = list(names_of_position_rows(scene))
    names += [f"norm of quaternion {k + 1}" for k in range(len(g) - len(names))] + list(names_of_rows(scene))
    worst = int(np.argmax(np.concatenate([g, phi])))
    within = any(
        bounded and name in scene.domain
        for name, bounded in zip(scene.coordinate_names.entries, start.bounded, strict=True)
    )
    elsewhere = ", pass some as guesses with `near=` to search outside the `domain`" if within else ""
    raise ValueError(
        f"the start of `{who}` violates constraint `{names[worst]}`: residual "
        f"{np.concatenate([g, phi])[worst]:.3g} remains with the given values held ({held}). Give fewer "
        f"values{elsewhere}, or use `jj.consistent(scene, t, q, u)` to move all of them"
    )


def free_entries(names: tuple[str, ...], held: Sequence[str]) -> Bool[np.ndarray, "entries"]:
    """Return a mask of the names that are not held."""
    return np.array([name not in held for name in names], bool)


def may_contradict(
    scene: Scene,
    known: Structure,
    free_q: Bool[np.ndarray, "coordinates"],
    free_u: Bool[np.ndarray, "speeds"],
) -> bool:
    """Return whether held values (entries that are not free) may contradict each other. `known`: structure of
    the scene. If

        rank G_f = rank G,   rank A_f = rank A,      G = dg/dq, A = dphi/du, f: columns of the free variables

    values can contradict each other only at isolated configurations.
    """
    # if all dependent speeds are free, the constraints determine them
    of_speeds = not all(free or k in known.independent for k, free in enumerate(free_u))
    of_coordinates = not free_q.all() and bool(names_of_position_rows(scene) or scene.coordinates.quaternions)
    if of_speeds and not known.affine:
        return True
    return (of_coordinates and _loses_rank(known.closure_slopes, free_q)) or (
        of_speeds and _loses_rank(known.row_slopes, free_u)
    )


def _loses_rank(matrices, free) -> bool:
    return any(np.linalg.matrix_rank(one * free) < np.linalg.matrix_rank(one) for one in matrices)
