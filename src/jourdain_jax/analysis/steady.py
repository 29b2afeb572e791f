"""Find steady motions: independent speeds are constant, and only ignorable coordinates change.

    g(t, q) = 0,   phi(t, q, u) = 0,   dy/dt = 0,   qdot_j = 0

y: the independent speeds; j: the coordinates that are not ignorable. Families of steady motions use the same
equations (`motion_derivatives.py`). The Levenberg-Marquardt method solves them from the guess
(`calculus/roots.py`). The residual of the result contains dy/dt and d2y/dt2 along the motion, and so does not
rely on the list of ignorable coordinates.
"""

from collections.abc import Mapping
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.analysis.families.equations import sizes
from jourdain_jax.analysis.linear_matrices import privileged_speeds
from jourdain_jax.analysis.motion_derivatives import (
    ByMatrices,
    ByProgram,
    entries_of,
    instant_of,
    on_rows,
    places_of,
    steadiness,
    unseen,
)
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Flag, Indices, Number, Scalar, check_kind, eps_of, largest, static
from jourdain_jax.calculus.roots import smooth_root
from jourdain_jax.equations.contact_laws import SLOW, moves
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.phases import At, contacts_at_start
from jourdain_jax.integrate.state import State, state_of
from jourdain_jax.motion.options import OPTION_NAMES, SPAN, OptionFields, Options, as_options
from jourdain_jax.motion.sensitivity import numbers_where_known
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.arguments import (
    BuiltFor,
    InputLike,
    as_input_vector,
    as_scene,
    as_time,
    shown_from_users_lines,
)
from jourdain_jax.scene.coordinates import Labels, as_names, check_names
from jourdain_jax.scene.modes import SLIPS, Switching, switched
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene

_REFUSED = dict.fromkeys(
    {*SPAN, *OPTION_NAMES} - {"max_steps"},
    "no motion is integrated; `max_steps` bounds the search, and a backend is an option of `jj.build`",
)


class SteadyMotion(Printed, eqx.Module):
    """State of a steady motion, and a residual that shows how steady it is."""

    state: State
    acceleration: Scalar  # largest remaining |dy/dt|
    residual: Scalar  # largest of `acceleration`, |d2y/dt2| along the motion and constraint residuals
    converged: Flag  # whether `residual` is below the root of round-off

    def __getitem__(self, name: str):
        """Return a coordinate, speed, quaternion or angular velocity by name."""
        return self.state[name]

    def _text(self) -> str:
        if self.residual.ndim:
            return f"{int(self.converged.sum())} of {self.converged.size} steady motions found\n{self.state}"
        found = "steady motion" if self.converged else "no steady motion found near the guess"
        return f"{found}: residual {self.residual:.1e} (accelerations {self.acceleration:.1e})\n{self.state}"


@shown_from_users_lines
def steady(
    scene: Scene | BuiltFor,
    guess: "State | Mapping[str, Any]",
    *,
    held: str | Labels = (),
    moving: str | Labels | None = None,
    t0: Number = 0.0,
    inputs: InputLike = None,
    privileged: str | Labels | None = None,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> SteadyMotion:
    """Find the steady motion near a guess: `g = 0, phi = 0, dy/dt = 0`. Only coordinates that do not affect
    accelerations change.

        guess = {"lean": 0.3, "yaw_rate": 2.0, "spin_rate": -3.0}
        steady(disc, guess, held=("lean", "yaw_rate"))["spin_rate"]

    **Arguments**

    - `guess`: a `State`, or named values (omitted ones are zero) at time `t0` (s). It may violate the
      constraints. Contacts with friction keep the modes of the guess, which must be known.
    - `held`: names of coordinates and speeds that keep the value of the guess; all others are unknown. If
      several steady motions have these values, the result is one near the guess.
    - `moving`: names of the coordinates that may change during the motion; default: those that do not affect
      accelerations (ignorable coordinates).
    - `inputs`: values of the scene's inputs (default: zero).
    - `privileged`: names of the speeds that must be constant (default: the scene's own). Choose speeds that
      are constant in the motion, for example rates of yaw, lean and spin instead of velocities along fixed
      axes.
    - `options`: a `jj.Options`. Only its `max_steps` has an effect: the largest number of steps of the search
      (default: 60). `by_name`: `max_steps`. The search runs to round-off.

    **Returns** a `SteadyMotion`. Inspect `converged` and `residual`: a failed search raises no error. The
    result is differentiable, in any mode, wherever it is a smooth function of the scene's parameters and the
    held values.

    **Raises** ValueError for an unknown name, and TypeError for any other option given by name.
    """
    most_steps = as_options(
        Options(max_steps=60) if options is None else options, by_name, "steady", _REFUSED
    ).max_steps
    built, scene = scene, as_scene(scene)
    whole = scene
    t, q, u = guessed(scene, guess, t0)
    f = as_input_vector(scene, inputs, q.dtype).astype(q.dtype)
    scene, q, f = in_phase(scene, t, q, u, f)
    built = built if scene is whole else scene
    held, entries = as_names(held), scene.coordinate_names.entries
    names = entries + scene.speed_names.entries
    unknown = f"`{type(scene).__name__}` has no `{{}}` to hold or to move"
    check_names(held, names, unknown)
    instant = instant_of(built, y := privileged_speeds(scene, privileged))
    ignorable = unseen(instant, scene)
    moving = ignorable if moving is None else as_names(moving)
    check_names(carried := entries_of(scene, moving), entries, unknown)
    resting = tuple(i for i, name in enumerate(entries) if name not in carried)
    # no equation depends on these coordinates: they keep the value of the guess, so that no step diverges
    idle = ignorable - set(np.array(entries)[on_rows(scene)])
    free = jnp.array([name not in held and name not in idle for name in names], bool)
    found = _solve(_Problem(scene, t, f, instant, y, resting), q, u, free, most_steps)
    if scene is whole:
        return found
    at = found.state
    q = jnp.append(at.q, jnp.zeros(len(whole.coordinate_names) - len(at.q)))
    at = state_of(whole, at.t, q, at.u, at.moved_q, at.moved_u, at.residual)
    return eqx.tree_at(lambda x: x.state, found, at)


def in_phase(scene: Scene, t, q, u, f) -> tuple:
    """Return the scene with its contacts in the modes of a state, its coordinates and inputs.

        rolls    the constraints of a contact without friction
        slips    the constraint of its gap, and the load -mu L_n e against the slip
        flies    no contact

    Raises ValueError if the modes are unknown or end in this state, or if a velocity constraint may slip.
    """
    if not (names := scene.switching.contacts):
        return scene, q, f
    known = numbers_where_known((scene, t, q, u, f))
    unclear = known is None or scene.switching.rows
    modes = () if unclear else tuple(zip(names, _modes(*known).tolist(), strict=False))
    if not modes or min(dict(modes).values()) < 0:
        raise ValueError(
            f"contacts with friction of `{type(scene).__name__}` ({', '.join(names)}) must fly, roll or slip "
            "in a state whose numbers are known: call this outside `jit` and `vmap`; velocity constraints "
            "that may slip are not supported"
        )
    phase = switched(scene, Switching(phase=modes))
    return phase, q[: len(phase.coordinate_names)], f[1 : 1 + len(phase.inputs)]


@eval_numpy
def _modes(scene: Scene, t, q, u, f):
    at = At(scene, motion_at(scene, t, q, u, f))
    numbers = contacts_at_start(at)[: len(at.w)]
    # slip that begins has no direction yet
    return jnp.where((numbers == SLIPS) & ~moves(at.w, SLOW), -1.0, numbers)


def guessed(scene: Scene, guess, t0) -> tuple[Array, Array, Array]:
    """Return t, q, u of a guess."""
    if isinstance(guess, State):
        return guess.t, guess.q, guess.u
    check_kind(guess, Mapping, "`guess`", "a State or a dictionary of named values; omitted values are zero")
    q, u, _ = scene.named(**guess)
    return as_time(t0), q, u


class _Problem(eqx.Module):
    """The residual of a steady motion, as a function of z = (q, u)."""

    scene: Scene
    t: Scalar
    f: Float[Array, "inputs"]
    instant: ByProgram | ByMatrices = static()
    privileged: Indices = static()
    resting: Indices = static()  # coordinates that must not change

    def __call__(self, z: Float[Array, "unknowns"]) -> tuple[Array, Array, list[Scalar]]:
        """Return the residual, its Jacobian, and the largest magnitudes of the constraint residuals, of dy/dt
        and of d2y/dt2.
        """
        at = places_of(self.scene)
        v, D, _ = self.instant(self.scene, self.t, z[: len(at.q)], z[len(at.q) :], self.f)
        y = at.udot[np.array(self.privileged, int)]
        of_rows = np.concatenate([at.g, at.phi])
        rows = np.concatenate([of_rows, y, at.qdot[np.array(self.resting, int)]])
        slopes = D[rows][:, np.concatenate([at.q, at.u])]
        return v[rows], slopes, [largest(v[of_rows]), *steadiness(self.scene, v, D, y)]


@compiled_quickly
def _solve(problem: _Problem, q, u, free: Bool[Array, "unknowns"], most_steps: int) -> SteadyMotion:
    guess, n, still = jnp.concatenate([q, u]), len(q), jax.lax.stop_gradient(problem)
    size = jnp.where(free, jnp.asarray(sizes(problem.scene), guess.dtype), 0.0)
    eps = float(eps_of(guess))
    round_off = eps**0.5
    z = smooth_root(
        lambda z: still(z)[:2], lambda z: problem(z)[0], guess, guess, size, eps, round_off, most_steps
    )
    of_rows, first, _ = left = jnp.stack(problem(z)[2])
    residual = largest(left)
    state = state_of(problem.scene, problem.t, z[:n], z[n:], largest(z[:n] - q), largest(z[n:] - u), of_rows)
    return SteadyMotion(state, first, residual, residual < round_off)
