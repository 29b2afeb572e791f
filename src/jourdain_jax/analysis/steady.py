"""Steady motions by root finding: the privileged speeds are constant, and only coordinates that do not matter to them move.

    g(t, q) = 0,   phi(t, q, u) = 0,   dy/dt = 0,   qdot_j = 0        y: the privileged speeds;  j: the coordinates not ignorable

Whether what was found is steady is then judged without that list, by dy/dt and d2y/dt2 along the motion.
Levenberg-Marquardt from the guess (`calculus/damped`).
"""

from collections.abc import Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.analysis.tangent import flow_of, privileged_speeds
from jourdain_jax.build.assembling import coordinate_bounds
from jourdain_jax.build.probed_on_graph import coordinates_on_rows
from jourdain_jax.calculus.compiled import RUN_SELDOM, compiled
from jourdain_jax.calculus.damped import damped_search
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse
from jourdain_jax.calculus.reals import Number, Numbers, described
from jourdain_jax.dynamics.reduced import ignorable_coordinates
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.motion.put_on_rows import State
from jourdain_jax.scene.arguments import BuiltFor, as_input_vector, as_scene
from jourdain_jax.scene.names import as_names, nearest
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines

_FINAL_STEPS = 3
_SPEEDS = 10.0  # size of a speed, SI units: how far it moves in some steps of the search


class SteadyMotion(Printed, eqx.Module):
    """A state of steady motion, and how steady it is."""

    state: State
    acceleration: Float[Array, ""]  # largest |dy/dt| that is left
    residual: Float[Array, ""]  # largest of that, of |d2y/dt2| along the motion, and of what is left of the rows
    converged: Bool[Array, ""]  # whether `residual` is below the root of round-off

    def __getitem__(self, name: str):
        """A coordinate, speed, quaternion or angular velocity by name."""
        return self.state[name]

    def _text(self) -> str:
        if self.residual.ndim:
            return f"{int(self.converged.sum())} of {self.converged.size} steady motions found\n{self.state}"
        found = "steady motion" if self.converged else "no steady motion found near the guess"
        return f"{found}: residual {self.residual:.1e} (accelerations {self.acceleration:.1e})\n{self.state}"


@shown_from_users_lines
def steady(
    scene: Scene | BuiltFor,
    guess: "State | dict",
    *,
    held: str | tuple[str, ...] = (),
    moving: str | tuple[str, ...] | None = None,
    t0: Number = 0.0,
    inputs: Numbers | dict | None = None,
    privileged: str | tuple[str, ...] | None = None,
    max_steps: int = 60,
) -> SteadyMotion:
    """The steady motion near a guess: `g = 0, phi = 0, dy/dt = 0`, and only coordinates move that do not matter.

        steady(disc, {"lean": 0.3, "yaw_rate": 2.0, "spin_rate": -3.0}, held=("lean", "yaw_rate"))["spin_rate"]

    **Arguments**
    - `guess`: a `State`, or named values (the rest zero) at time `t0` (s). It need not meet the constraints.
    - `held`: names of coordinates and speeds that keep the guess's value; all others are solved for. Where many steady motions meet this,
      the result is one near the guess.
    - `moving`: names of the coordinates that may keep moving; default: those that the scene's accelerations do not depend on (`ignorable`).
    - `inputs`: values of the scene's inputs (default: zero); `privileged`: names of the speeds that are to be constant (default: the scene's
      own). Choose speeds in which the motion is steady: rates of yaw, lean and spin, say, not velocities along fixed axes.
    - `max_steps`: of the search, at most.

    **Returns** a `SteadyMotion`; look at `converged` and `residual`, nothing is raised where none is found. Differentiable in any mode in the
    scene's parameters and in the held values, where the steady motion is a smooth function of them.

    **Raises** ValueError: an unknown name.
    """
    if not isinstance(max_steps, int | np.integer) or max_steps < 1:
        raise ValueError(f"`max_steps` is {max_steps!r}, expected a whole number of at least 1")
    scene = as_scene(scene)
    t, q, u = guessed(scene, guess, t0)
    f = as_input_vector(scene, inputs, q.dtype).astype(q.dtype)
    held = as_names(held)
    names = scene.coordinate_names.entries + scene.speed_names.entries
    _check_names(scene, held, names)
    ignorable = ignorable_coordinates(scene) if moving is None else ()
    moving = ignorable if moving is None else as_names(moving)
    groups = {group: scene.coordinate_names.entries[first : first + length] for group, first, length in scene.coordinate_names.groups}
    _check_names(scene, moving, (*scene.coordinate_names.entries, *groups))
    carried = {entry for name in moving for entry in groups.get(name, (name,))}
    resting = tuple(i for i, name in enumerate(scene.coordinate_names.entries) if name not in carried)
    on_rows = set(np.array(scene.coordinate_names.entries)[coordinates_on_rows(scene)])
    # nothing that vanishes changes with them: they keep the guess's value, and no step runs away along them
    idle = {entry for name in ignorable for entry in groups.get(name, (name,))} - on_rows
    free = jnp.array([name not in held and name not in idle for name in names], bool)
    return _solve(_Problem(scene, t, f, privileged_speeds(scene, privileged), resting), q, u, free, max_steps)


def guessed(scene: Scene, guess, t0) -> tuple[Array, Array, Array]:
    """t, q, u of a guess."""
    if isinstance(guess, State):
        return guess.t, guess.q, guess.u
    if not isinstance(guess, Mapping):
        raise ValueError(f"`guess` is {described(guess)}, expected a State or a dictionary of named values; those not named start from zero")
    q, u, _ = scene.named(**guess)
    return jnp.asarray(t0, jnp.result_type(float)), q, u


def _check_names(scene: Scene, given: tuple[str, ...], valid: tuple[str, ...]) -> None:
    for name in given:
        if name not in valid:
            raise ValueError(f"`{type(scene).__name__}` has no `{name}` to hold or to move; {nearest(name, valid)}")


class _Problem(eqx.Module):
    """What vanishes at a steady motion, as a function of z = (q, u)."""

    scene: Scene
    t: Float[Array, ""]
    f: Float[Array, "inputs"]
    privileged: tuple[int, ...] = eqx.field(static=True)
    resting: tuple[int, ...] = eqx.field(static=True)  # coordinates that must not move

    def __call__(self, z: Float[Array, "unknowns"]) -> Float[Array, "residuals"]:
        n = len(self.scene.coordinate_names)
        now, _ = flow_of(self.scene, self.privileged)(self.t, z[:n], z[n:], self.f)
        constant, still = now.udot[np.array(self.privileged, int)], now.qdot[np.array(self.resting, int)]
        return jnp.concatenate([closure_residual(self.scene, self.t, z[:n]), now.phi, constant, still])

    def unsteadiness(self, q, u) -> tuple[Float[Array, "freedoms"], Float[Array, "freedoms"]]:
        """dy/dt and d2y/dt2."""
        flow, y = flow_of(self.scene, self.privileged), np.array(self.privileged, int)
        now, slope = jax.linearize(lambda t, q, u: flow(t, q, u, self.f)[0], self.t, q, u)
        return now.udot[y], slope(jnp.ones_like(self.t), now.qdot, now.udot).udot[y]


@partial(compiled, options=RUN_SELDOM)  # of a bicycle in 6.5 s of processor time, not in 24; run in 0.11 s, not in 0.09
def _solve(problem: _Problem, q, u, free: Bool[Array, "unknowns"], max_steps: int) -> SteadyMotion:
    z = jnp.concatenate([q, u])
    z = _root(problem, z, free, max_steps)
    n = q.shape[0]
    first, second = (jnp.max(jnp.abs(x), initial=0.0) for x in problem.unsteadiness(z[:n], z[n:]))
    rows = jnp.max(jnp.abs(problem(z)[: -len(problem.privileged) - len(problem.resting)]), initial=0.0)
    moved_q, moved_u = (jnp.max(jnp.abs(a - b), initial=0.0) for a, b in ((z[:n], q), (z[n:], u)))
    residual = jnp.maximum(rows, jnp.maximum(first, second))
    state = State(problem.t, z[:n], z[n:], moved_q, moved_u, rows, (problem.scene.coordinate_names, problem.scene.speed_names))
    return SteadyMotion(state, first, residual, residual < _round_off_root(z.dtype))


def _root(problem: _Problem, z: Float[Array, "unknowns"], free: Bool[Array, "unknowns"], max_steps: int) -> Float[Array, "unknowns"]:
    """The root near z: a search without derivative, then steps `z <- z - J+ R(z)` with the J found, which carry one order of derivative each."""
    still, guess, movable = jax.lax.stop_gradient((problem, z, free))
    low, high = coordinate_bounds(problem.scene)
    sizes = np.concatenate([np.where(high > low, high - low, 1.0), np.full(z.shape[0] - low.size, _SPEEDS)])
    size = jnp.where(movable, jnp.asarray(sizes, z.dtype), 0.0)
    found = damped_search(lambda z: (still(z), jax.jacfwd(still)(z)), guess, size, float(np.finfo(z.dtype).eps), most_steps=max_steps)
    found = jax.lax.stop_gradient(found)
    inverse = size[:, None] * pseudo_inverse(found.J, _round_off_root(z.dtype))
    return jax.lax.scan(lambda z, _: (z - inverse @ problem(z), None), jnp.where(free, found.best, z), length=_FINAL_STEPS)[0]


def _round_off_root(dtype) -> float:
    return float(np.sqrt(np.finfo(dtype).eps))
