"""Project a start onto the constraints, search from other guesses, and detect contradictory values.

    g(t, q) = 0,   phi(t, q, u) = 0

First the coordinates q are projected, then the speeds u (`constraint_projection.py`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.markers import stopped
from jourdain_jax.calculus.reals import (
    Count,
    Entries,
    Flag,
    PerCoordinate,
    Scalar,
    Speeds,
    eps_of,
    real_type,
    static,
)
from jourdain_jax.calculus.roots import first_root
from jourdain_jax.equations.reductions import row_scale
from jourdain_jax.equations.rows import names_of_position_rows
from jourdain_jax.integrate.constraint_projection import (
    Usual,
    functions_of_rows,
    put_positions,
    put_speeds,
    usual_sizes,
)
from jourdain_jax.integrate.loop.value_kernels import entries
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.printing import Printed, in_digits
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import elsewhere, faults_at
from jourdain_jax.structure.structure import Structure

OFF = 1e4  # numerics: a residual above this many eps is more than round-off


class State(Printed, eqx.Module):
    """State on the constraints, and its distance from the guess: `state["yaw"]`, `print(state)`.

    q and u are in the units of the scene's coordinates and speeds (SI, rad).
    """

    t: Scalar  # s
    q: PerCoordinate
    u: Speeds
    moved_q: Scalar  # largest change of a coordinate by the projection
    moved_u: Scalar  # largest change of a speed by the projection
    residual: Scalar  # remaining residual of constraints and quaternion norms
    names: tuple[Names, Names] = static()
    # index of the successful guess: 0 for the given values, higher for others (`start`). A float, so that
    # losses can be differentiated with respect to a whole state
    guess: Scalar = eqx.field(default=0, converter=lambda k: jnp.asarray(k, real_type()))

    def __getitem__(self, name: str):
        """Return a coordinate, speed, quaternion or angular velocity by name."""
        coordinates, speeds = (names.view(x) for names, x in zip(self.names, (self.q, self.u), strict=True))
        return coordinates[name] if name in coordinates else speeds[name]

    def __contains__(self, name: str) -> bool:
        return any(name in names for names in self.names)

    def _text(self) -> str:
        if self.q.ndim > 1:
            return (
                f"States of shape {self.q.shape[:-1]}:"
                f" {', '.join((*self.names[0].entries, *self.names[1].entries))}"
            )
        entries = (*self.names[0].entries, *self.names[1].entries)
        values = in_digits(np.concatenate([self.q, self.u]))
        pairs = [f"{name} = {value}" for name, value in zip(entries, values, strict=True)]
        moved = (
            f"moved by {self.moved_q:.2e} (q), {self.moved_u:.2e} (u) onto the constraints; residual"
            f" {self.residual:.1e}"
        )
        if int(self.guess):
            moved += (
                f"; from guess {int(self.guess)}: the search for omitted coordinates failed and began again"
                " elsewhere in the domain"
            )
        return f"State at t = {self.t:.6g} s: " + ", ".join(pairs) + f"\n{moved}"


def state_of(scene: Scene, t, q, u, moved_q=0.0, moved_u=0.0, residual=0.0) -> State:
    """Return a state of a scene before projection."""
    t, moved_q, moved_u, residual = (jnp.asarray(x, real_type()) for x in (t, moved_q, moved_u, residual))
    return State(t, q, u, moved_q, moved_u, residual, (scene.coordinate_names, scene.speed_names))


class Guess(NamedTuple):
    """Coordinates and speeds to project, and which of them may change."""

    q: Float[Entries, "coordinates"]
    u: Float[Entries, "speeds"]
    free_q: Bool[Entries, "coordinates"]
    free_u: Bool[Entries, "speeds"]
    bounded: Bool[Entries, "coordinates"]  # whether a coordinate must end inside the scene's domain
    usual: Usual

    def inside(self, q) -> Bool[Array, "coordinates"]:
        """Return which coordinates are within their bounds."""
        q = jax.lax.stop_gradient(q)
        return ~self.bounded | ((q >= self.usual.low) & (q <= self.usual.high))


def free_entries(names: tuple[str, ...], held: Sequence[str]) -> Bool[np.ndarray, "entries"]:
    """Return a mask of the names that are not held."""
    return np.array([name not in held for name in names], bool)


def projected(scene: Scene, t, start: State, inputs, usual: Usual) -> State:
    """Project a state as `consistent` does, as a part of a larger compiled function."""
    every_q, every_u = np.ones(len(start.q), bool), np.ones(len(start.u), bool)
    return put_onto_constraints(
        scene, t, Guess(start.q, start.u, every_q, every_u, ~every_q, usual), inputs, None
    )[0]


def put_onto_constraints(scene: Scene, t, start: Guess, inputs, guesses) -> tuple[State, Flag]:
    """Project the start onto the constraints. Also return whether the projection of the coordinates converged
    within the domain. If it did not, search from `guesses`, if any.

    The residual is infinite if a number is not finite or a coordinate is out of its permitted range.
    """
    q, u, usual = jnp.asarray(start.q), jnp.asarray(start.u), start.usual
    near_q, g, guess, arrived = q, jnp.zeros(0, q.dtype), jnp.int32(0), jnp.array(True)
    if len(usual.closures):
        near_q, g, guess, arrived = _put_coordinates(scene, t, q, start, guesses)
    near_u, phi = put_speeds(scene, t, near_q, u, jnp.asarray(inputs), jnp.asarray(start.free_u), usual)
    left = jnp.concatenate([g, phi])
    left = stopped(jnp.concatenate([left, 0.0 * near_q, 0.0 * near_u]))  # NaN if a number is not finite
    moved_q, moved_u, residual = (jnp.max(jnp.abs(x), initial=0.0) for x in (near_q - q, near_u - u, left))
    right = ~jnp.isnan(residual) & jnp.all(start.inside(near_q))
    names = scene.coordinate_names, scene.speed_names
    moved = moved_q, moved_u, jnp.where(right, residual, jnp.inf)
    return State(jnp.asarray(t), near_q, near_u, *moved, names, guess.astype(q.dtype)), arrived


def _put_coordinates(scene: Scene, t, q, start: Guess, guesses) -> tuple[Array, Array, Count, Flag]:
    """Return the nearest coordinates, the residual, the index of the guess, and whether q converged."""
    free, usual = jnp.asarray(start.free_q), start.usual
    here, at, begin = stopped((scene, t, q))
    near_q, g = put_positions(here, at, begin, free, usual)
    arrived = _arrived(begin, near_q, g, start)
    found = _Put(near_q, g, jnp.zeros((), jnp.int32), begin, jnp.array(True))
    if guesses is not None:
        other = jax.lax.cond(
            eqxi.unvmap_any(~arrived),
            lambda: _searched(here, at, begin, start, jax.lax.stop_gradient(guesses)),
            lambda: found,
        )
        better = ~arrived & (left_of(other.g) <= left_of(g))
        found = jax.tree.map(lambda x, y: jnp.where(better, x, y), other, found)
        q = jnp.where(better & free, found.begin, q)
    # add the derivatives of Newton's method from its starting point; without a solution they would diverge
    near_q, g = put_positions(scene, t, q, free, usual, (found.q, found.g))
    return jnp.where(found.met, near_q, q), g, found.guess, arrived


def coordinates_elsewhere(scene: Scene, native: bool) -> Float[Array, "3 coordinates"]:
    """Return the coordinates of the states `elsewhere`, projected onto the geometric constraints. Those
    without a solution in the domain are NaN.

    `native`: machine code may project them.
    """
    t, q, u = jax.tree.map(lambda x: jnp.asarray(x, real_type()), elsewhere(scene))
    if not names_of_position_rows(scene):
        return q
    here, usual = jax.lax.stop_gradient(scene), usual_sizes(scene, False, native)
    every = jnp.ones(q.shape[1], bool)

    def put(state):
        t, q = state
        near_q, g = put_positions(here, t, q, every, usual)
        return jnp.where(_arrived(q, near_q, g, Guess(q, u[0], every, every, every, usual)), near_q, jnp.nan)

    return jax.lax.map(put, (t, q))  # constraints may be callbacks that cannot be batched


@eval_numpy
def known_faults_at(scene: Scene, t, q, u, inputs) -> dict[str, Flag]:
    """Return for each possible fault whether a concrete scene has it, at this state or elsewhere."""
    return faults_at(scene, t, q, u, inputs, coordinates_elsewhere(scene, False))


def left_of(g: Float[Array, "closures"]) -> Scalar:
    """Return the largest residual of the geometric constraints. NaN counts as infinite, a residual too small
    for a contradiction as zero.
    """
    left = jax.lax.stop_gradient(jnp.max(jnp.abs(g), initial=0.0))
    return jnp.where(left < contradiction(g.dtype), 0.0, jnp.where(jnp.isfinite(left), left, jnp.inf))


def _arrived(q, near_q, g, start: Guess) -> Flag:
    """Return whether the coordinates satisfy the constraints, are in their permitted range, and are near the
    guess.
    """
    # a change by more than ten widths of the domain, or NaN, counts as divergence
    close = jnp.all(jnp.abs(near_q - q) <= 10.0 * start.usual.width)
    return jax.lax.stop_gradient(close & (left_of(g) == 0)) & jnp.all(start.inside(near_q))


class _Put(NamedTuple):
    """Projected coordinates, without derivatives."""

    q: PerCoordinate
    g: Float[Array, "closures"]
    guess: Count
    begin: PerCoordinate  # starting point of Newton's method
    met: Flag  # whether a solution was found


def _searched(scene: Scene, t, q, start: Guess, guesses) -> _Put:
    """Return the solution from the first successful guess, beginning with q itself."""
    free, usual = jnp.asarray(start.free_q), start.usual
    size = jnp.where(free, jnp.asarray(usual.width, q.dtype), 0.0)
    every = jnp.where(free, jnp.vstack([q, guesses]), q)
    by = functions_of_rows(usual)
    given = by.given(scene)
    G = jax.vmap(lambda q: by.closures(given, t, q)[1])(every)
    low, high = (
        jnp.where(start.bounded, x, side * jnp.inf) for x, side in ((usual.low, -1), (usual.high, 1))
    )
    # coordinates on which no constraint depends keep the value of q
    every = jnp.clip(jnp.where(jnp.any(G != 0, axis=(0, 1)), every, q), low, high)
    d = row_scale(jnp.max(jnp.abs(G), axis=0) * size, usual.closures * jnp.mean(usual.width))
    tolerance = 16 * float(eps_of(q))
    scaled = lambda q: jax.tree.map(lambda x: (x.T * d).T, by.closures(given, t, q))
    good = float(eps_of(q)) ** 0.5
    found, guess = first_root(scaled, every, size, tolerance, good, low, high)
    begin, met = jnp.where(free, found.x, q), found.left <= good
    near_q = jnp.where(met, put_positions(scene, t, begin, free, usual)[0], begin)
    return _Put(near_q, by.closures(given, t, near_q)[0], guess, begin, met)


def contradiction(dtype) -> float:
    """Return the residual (m, rad) above which given values count as contradictory. It allows for values with
    few digits, and for round-off.
    """
    return max(1.5e-5, OFF * float(np.finfo(dtype).eps))  # 1.5e-5: for values with few digits


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
