"""Consistent starts: a guess of q and u put onto the constraints, with a report of how far it moved.

g(t, q) = 0,  phi(t, q, u) = 0
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jourdain_jax.build.sampling import guesses_of
from jourdain_jax.build.structure import structure_of
from jourdain_jax.calculus.compiled import RUN_SELDOM, compiled
from jourdain_jax.calculus.damped import first_root
from jourdain_jax.calculus.reals import Number, Numbers, at_once, checked_unless_traced, described, is_traced, known_numbers, nothing_is_traced
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.listed import names_of_position_rows, names_of_rows
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.motion.inputs import as_inputs, inputs_at
from jourdain_jax.motion.model import Model, modelled
from jourdain_jax.motion.put_on_rows import State, Usual, functions_of_rows, may_contradict, put_positions, put_speeds
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.scene.arguments import BuiltFor, as_coordinates, as_input_vector, as_scene, as_speeds
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene, vectors_named
from jourdain_jax.scene.tracebacks import shown_from_users_lines

_NOTHING: Mapping = MappingProxyType({})
_OFF = 1e4  # units of round-off: a residual that is more


def consistent(scene: Scene | BuiltFor, t, q: Numbers, u: Numbers, inputs=None, *, held: tuple[str, ...] = ()) -> State:
    """The state on the constraints nearest to (q, u): positions by Gauss-Newton, speeds M-orthogonally; g(t, q) = 0, phi(t, q, u) = 0.

    `inputs`: values of the scene's inputs (default: zero). `held`: names of coordinates and speeds that do not move.

    Differentiable in any mode. What cannot be met stays in `residual`, which is infinite where numbers are not finite (no error: this also runs
    inside jit and vmap); the quaternion (0, 0, 0, 0) has no direction and stays as it is, with a residual of 1/2. ValueError for wrong shapes.
    """
    model, scene = modelled(scene), as_scene(scene)
    coordinates, speeds = scene.coordinate_names.entries, scene.speed_names.entries
    t, q, u = one_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    for name in held:
        if name not in coordinates + speeds:
            raise ValueError(f"`held` names `{name}`, which is no coordinate or speed; {nearest(name, coordinates + speeds)}")
    free_q, free_u = (_free(names, tuple(held)) for names in (coordinates, speeds))
    guess = _Guess(q, u, free_q, free_u, ~_free(coordinates, ()), model.usual(False))
    return _consistent(scene, t, guess, _as_input_vector(scene, inputs, q.dtype))


def projected(scene: Scene, t, start: State, inputs, usual: Usual) -> State:
    """Project a state as `consistent` does, as a part of a larger compiled function."""
    every_q, every_u = (_free(names, ()) for names in (scene.coordinate_names.entries, scene.speed_names.entries))
    return _put_onto_constraints(scene, t, _Guess(start.q, start.u, every_q, every_u, ~every_q, usual), inputs, None)[0]


class _Guess(NamedTuple):
    """Coordinates and speeds that are to be projected, and which of them may move."""

    q: Float[Array | np.ndarray, "coordinates"]
    u: Float[Array | np.ndarray, "speeds"]
    free_q: Bool[np.ndarray, "coordinates"]
    free_u: Bool[np.ndarray, "speeds"]
    bounded: Bool[np.ndarray, "coordinates"]  # which must end inside the domain that the scene states
    usual: Usual

    def inside(self, q) -> Bool[Array, "coordinates"]:
        """Which coordinates are where they may be found."""
        q = jax.lax.stop_gradient(q)
        return ~self.bounded | ((q >= self.usual.low) & (q <= self.usual.high))


def _free(names: tuple[str, ...], held: Sequence[str]) -> Bool[np.ndarray, "entries"]:
    """Which of these entries are not held."""
    return np.array([name not in held for name in names], bool)


def _consistent(scene: Scene, t, start: _Guess, inputs, guesses: Callable | None = None) -> State:
    """Return the nearest state; where Newton's method does not arrive, what a damped search finds from q, and then from other configurations, `guesses()`."""
    given = scene, t, start, inputs
    if not nothing_is_traced() and is_traced(given):
        return _compiled_projection(*given, None if guesses is None else guesses())[0]
    # numbers are put onto the rows at once, also where a function around this call is being traced; elsewhere that would compile constants one by one
    with at_once():
        state, arrived = _compiled_projection(*given, None)
        if guesses is not None and not np.asarray(arrived) and len(start.usual.closures):  # rare, and long to compile
            by_xla = start._replace(usual=replace(start.usual, program=None))
            state = jax.tree.map(jnp.asarray, _uncompiled_projection(scene, t, by_xla, inputs, guesses())[0])
    return state


def one_time(t, name: str = "t"):
    """A time on NumPy, unless it is traced; None stays. A ValueError that names it where it is no number."""
    return None if t is None else checked_unless_traced(t, f"`{name}`", (), advice="give one time in s; use `jax.vmap` for many")


def _as_input_vector(scene: Scene, inputs, dtype):
    """A vector on NumPy as it is, which is not traced and takes no time."""
    return inputs if isinstance(inputs, np.ndarray) and inputs.shape == (len(scene.inputs),) else as_input_vector(scene, inputs, dtype)


def _is_off(state: State) -> Bool[Array | np.ndarray, ""]:
    """Whether more than round-off is left of the rows; also where that is no number."""
    return ~(state.residual <= _OFF * np.finfo(state.q.dtype).eps)


def _put_onto_constraints(scene: Scene, t, start: _Guess, inputs, guesses) -> tuple[State, Bool[Array, ""]]:
    """The start on the constraints, and whether its coordinates arrived, where they may be found; no search where `guesses` is None.

    The residual is infinite where a number is not finite, or a coordinate was found where it may not be.
    """
    given_q, u, free, usual = jnp.asarray(start.q), jnp.asarray(start.u), jnp.asarray(start.free_q), start.usual
    q = given_q
    here, at, begin = jax.lax.stop_gradient((scene, t, q))
    near_q, g = put_positions(here, at, begin, free, usual)
    arrived, found = _arrived(begin, near_q, g, start), _Put(near_q, g, jnp.zeros((), jnp.int32), begin, jnp.array(True))
    if guesses is not None and len(usual.closures):
        other = jax.lax.cond(eqxi.unvmap_any(~arrived), lambda: _searched(here, at, begin, start, jax.lax.stop_gradient(guesses)), lambda: found)
        better = ~arrived & (_left(other.g) <= _left(g))
        found = jax.tree.map(lambda x, y: jnp.where(better, x, y), other, found)
        q = jnp.where(better & free, found.begin, q)
    # derivatives are those of Newton's method from where it began; where the rows cannot be met, they would run away
    near_q, g = put_positions(scene, t, q, free, usual, (found.q, found.g))
    near_q, guess = jnp.where(found.met, near_q, q), found.guess
    near_u, phi = put_speeds(scene, t, near_q, u, jnp.asarray(inputs), jnp.asarray(start.free_u), usual)
    left = jnp.concatenate([g, phi])
    right = jnp.all(jnp.isfinite(jnp.concatenate([near_q, near_u, left]))) & jnp.all(start.inside(near_q))
    moved_q, moved_u, residual = (jnp.max(jnp.abs(x), initial=0.0) for x in (near_q - given_q, near_u - u, left))
    names = scene.coordinate_names, scene.speed_names
    state = State(jnp.asarray(t), near_q, near_u, moved_q, moved_u, jnp.where(right, residual, jnp.inf), names, guess.astype(q.dtype))
    return state, arrived


def _left(g: Float[Array, "closures"]) -> Float[Array, ""]:
    """Largest residual of the geometric rows that counts: what is no number is infinite, what is round-off is zero."""
    left = jax.lax.stop_gradient(jnp.max(jnp.abs(g), initial=0.0))
    return jnp.where(left < _tolerance(g.dtype), 0.0, jnp.where(jnp.isfinite(left), left, jnp.inf))


def _arrived(q, near_q, g, start: _Guess) -> Bool[Array, ""]:
    """Whether the rows are met, where coordinates may be found and without running far away."""
    # a coordinate that Newton's method moves by more than ten widths of the domain has run away; never close where it is not a number
    close = jnp.all(jnp.abs(near_q - q) <= 10.0 * start.usual.width)
    return jax.lax.stop_gradient(close & (_left(g) == 0)) & jnp.all(start.inside(near_q))


class _Put(NamedTuple):
    """Coordinates put onto the rows, without derivatives."""

    q: Float[Array, "coordinates"]
    g: Float[Array, "closures"]
    guess: Int[Array, ""]
    begin: Float[Array, "coordinates"]  # where Newton's method began
    met: Bool[Array, ""]  # whether it was worth while


def _searched(scene: Scene, t, q, start: _Guess, guesses) -> _Put:
    """Coordinates from the first guess that leads to the rows, q itself counting as the first."""
    free, usual = jnp.asarray(start.free_q), start.usual
    size = jnp.where(free, jnp.asarray(usual.width, q.dtype), 0.0)
    every = jnp.where(free, jnp.concatenate([q[None], guesses]), q)
    by = functions_of_rows(usual)
    given = by.given(scene)
    G = jax.vmap(lambda q: by.closures(given, t, q)[1])(every)
    low, high = (jnp.where(start.bounded, x, side * jnp.inf) for x, side in ((usual.low, -1), (usual.high, 1)))
    every = jnp.clip(jnp.where(jnp.any(G != 0, axis=(0, 1)), every, q), low, high)  # coordinates that no row depends on stay
    d = row_scale(jnp.max(jnp.abs(G), axis=0) * size, usual.closures * jnp.mean(usual.width))
    tolerance = 16 * float(jnp.finfo(q.dtype).eps)
    scaled = lambda q: jax.tree.map(lambda x: (x.T * d).T, by.closures(given, t, q))  # noqa: E731
    good = float(jnp.finfo(q.dtype).eps) ** 0.5
    found, guess = first_root(scaled, every, size, tolerance, good, low, high)
    begin, met = jnp.where(free, found.x, q), found.left <= good
    near_q = jnp.where(met, put_positions(scene, t, begin, free, usual)[0], begin)
    return _Put(near_q, by.closures(given, t, near_q)[0], guess, begin, met)


def _tolerance(dtype) -> float:
    """The residual (m, rad) from which on given values contradict each other: that of numbers typed with a few digits, or of round-off."""
    return max(1.5e-5, _OFF * float(np.finfo(dtype).eps))  # the first: of numbers typed with a few digits


_compiled_projection = compiled(_put_onto_constraints, options=RUN_SELDOM)  # one program for every choice of what is held
_uncompiled_projection = eval_numpy(_put_onto_constraints)


@shown_from_users_lines
def start(scene: Scene | BuiltFor, given=None, *, near=None, t0: Number = 0.0, inputs=None, **values) -> State:
    """A consistent start from named coordinates and speeds: `start(disc, lean=0.3, spin_rate=-3.0)`, or `start(disc, {"lean": 0.3, "spin_rate": -3.0})`.

    `values`, by keyword or in a dictionary `given` (where both name one, the keyword counts), are kept, at time `t0` (s); values that contradict each other by
    no more than a few typed digits do, 1.5e-5, move onto the constraints.
    Coordinates that are not given begin at zero (a quaternion at the identity) and follow from the rows; where that leads nowhere, or out of the `domain`
    that the scene states, they begin at those of states of the domain, nearest first, and the state says so (`guess`). `near`: coordinates by name, with
    values from which they begin but at which they are not held; those may be found outside of the domain, as may coordinates of which the rows leave no choice.
    Of a quaternion that is given in part, `attitude_w=cos(a / 2), attitude_x=sin(a / 2)`, the other parts are zero.
    Privileged speeds that are not given stay zero and the dependent speeds follow from the rows;
    where dependent speeds are given, all others are solved for: the smallest change that meets the constraints, in the metric of the mass matrix.
    `inputs`: as in `simulate`, name -> number, function of time, or `Sampled`; what they are at `t0` counts where velocity rows depend on them.
    In a program that is exported, pass `jj.build(scene, backend="xla")` in the place of the scene.
    ValueError, where values are known: an unknown name, a value that is not finite, given values that contradict the constraints or that no state of the
    domain has; where they are not, `residual` is infinite, and a motion from there ends with a code.
    """
    model = modelled(scene)
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(f"`start` was given {described(given)}, expected named values: `jj.start(scene, lean=0.3)`, or a dictionary of them")
    if near is not None and not isinstance(near, Mapping):
        raise ValueError(f'`near` is {described(near)}, expected a dictionary of coordinates: near={{"z": -0.4}}')
    with model.standing_in:
        return named_start(model, {**(given or {}), **values}, t0, inputs_at(as_inputs(model.scene, inputs), one_time(t0)), near=near or {})


def named_start(model: Model, values: Mapping, t0, inputs, *, near: Mapping = _NOTHING) -> State:
    """Return the start that `start` describes; `inputs` at time `t0`: a vector, or by name (None: zero)."""
    scene = model.scene
    q, u, given = vectors_named(scene, {**near, **values})
    about = given if near else ()
    if near:
        given = vectors_named(scene, values)[2]
        for name in near:
            if name not in scene.coordinate_names:
                raise ValueError(f"`near` names `{name}`, which is no coordinate; {nearest(name, scene.coordinate_names.entries)}")
    inputs = _as_input_vector(scene, inputs, q.dtype)
    t = one_time(t0)
    if is_traced(q, u, t) or not (np.isfinite(q).all() and np.isfinite(u).all() and np.isfinite(t)):  # one look where all is known, and right
        for name, value in {**near, **values, "t0": t0}.items():
            if not np.all(np.isfinite(known_numbers(value))):
                raise ValueError(f"start value `{name}` is {value}, expected a finite number; check where it was computed")
    held, contradict = model.once((given, about), lambda: _held(model, given, about))
    guess = _Guess(q, u, *held)

    def guesses() -> Float[Array | np.ndarray, "guesses coordinates"]:
        known = structure_of(scene)
        return guesses_of(scene, known.coordinates[: known.random], q, guess.free_q)

    state = _consistent(scene, t, guess, inputs, guesses)
    _check_residual(scene, guess, state, inputs, given)
    return _moved_if_near(model, state, inputs) if contradict else state


def _held(model: Model, given: tuple[str, ...], about: tuple[str, ...]) -> tuple[tuple, bool]:
    """Return what is left to the rows where values of names are given, or are guesses about which to look, as a `_Guess` has it; and whether given values may
    contradict each other.

    Privileged speeds that are not given stay at zero, unless a dependent speed is given. Rows may not find coordinates outside of the domain that are neither
    given nor guessed; but where the rows, affine in them, leave one place.
    """
    scene, known = model.scene, structure_of(model.scene)
    coordinates, speeds = scene.coordinate_names.entries, scene.speed_names.entries
    privileged = [speeds[i] for i in known.independent]
    resting = () if any(name in speeds and name not in privileged for name in given) else privileged
    free_q, free_u = _free(coordinates, given), _free(speeds, (*given, *resting))
    usual = model.usual(known.affine and not any(free_u[i] for i in known.independent))
    bounded, program = free_q & _free(coordinates, about), usual.program
    if program is not None:
        slopes = [n for (_, k), n in program.G.items() if free_q[k]]
        bounded = bounded & any(depend_on(program.graph, slopes, np.array(program.q)[free_q].tolist()))
    return (free_q, free_u, bounded, usual), may_contradict(scene, known, free_q, free_u)


def _moved_if_near(model: Model, start: State, inputs) -> State:
    """Move the start as a whole where it is off the rows by less than counts as a contradiction.

    Where it is off by round-off alone, its numbers stay as they are, but what is traced gets the derivatives of a start that is moved: values that agree at
    these parameters contradict each other at others.
    """
    near = start.residual < _tolerance(start.q.dtype)
    if not np.all(known_numbers(near & _is_off(start))):
        return start
    state = consistent(model, start.t, start.q, start.u, inputs)
    moved = [jnp.maximum(a, b) for a, b in ((start.moved_q, state.moved_q), (start.moved_u, state.moved_u))]
    state = eqx.tree_at(lambda s: (s.moved_q, s.moved_u, s.guess), state, (*moved, start.guess))
    return jax.tree.map(lambda x, y: jnp.where(near, x, y), state, start)


def _check_residual(scene: Scene, start: _Guess, state: State, inputs, given: tuple[str, ...]) -> None:
    if np.all(known_numbers(state.residual) < _tolerance(state.q.dtype)):
        return
    who, held = type(scene).__name__, ", ".join(f"`{name}`" for name in given) or "none"
    g = np.abs(np.asarray(closure_residual(scene, state.t, state.q)))
    outside = np.flatnonzero(~np.asarray(start.inside(state.q)))
    for k in outside[:1] if float(_left(jnp.asarray(g))) == 0 else ():
        name, found = scene.coordinate_names.entries[k], float(state.q[k])
        raise ValueError(
            f"no start of `{who}` was found with `{name}` in its `domain`, {scene.domain[name]}, while the given values are held ({held}): the nearest one has "
            f'{found:.6g}; give other values, a wider `domain`, or near={{"{name}": {found:.2g}}}, from where it is looked for, outside of the domain as well'
        )
    phi = np.abs(np.asarray(velocity_residual(scene, state.t, state.q, state.u, inputs)))
    names = list(names_of_position_rows(scene))
    names += [f"norm of quaternion {k + 1}" for k in range(len(g) - len(names))] + list(names_of_rows(scene))
    worst = int(np.argmax(np.concatenate([g, phi])))
    within = any(bounded and name in scene.domain for name, bounded in zip(scene.coordinate_names.entries, start.bounded, strict=True))
    elsewhere = ", give some as guesses by `near=`, which are looked for outside of the `domain` as well" if within else ""
    raise ValueError(
        f"the start of `{who}` contradicts row `{names[worst]}`: residual {np.concatenate([g, phi])[worst]:.3g} is left with the given values "
        f"held ({held}); give fewer values and let the constraints decide the rest{elsewhere}, or use `jj.consistent(scene, t, q, u)` to move all of them"
    )
