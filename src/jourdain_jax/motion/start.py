"""Consistent starts: a guess of q and u put onto the constraints, with a report of how far it moved.

g(t, q) = 0,  phi(t, q, u) = 0
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, Numbers
from jourdain_jax.equations.probing import Seldom, on_numbers
from jourdain_jax.equations.projection import closure_residual, project_positions, project_speeds
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows, velocity_residual
from jourdain_jax.equations.structure import structure_of
from jourdain_jax.motion.inputs import as_inputs
from jourdain_jax.scene.arguments import as_coordinates, as_input_vector, as_scene, as_speeds, as_time
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene


class State(Printed, eqx.Module):
    """A state on the constraints, and how far the guess was from it; `state["yaw"]`, `print(state)`.

    q and u in the units of the scene's coordinates and speeds (SI, rad).
    """

    t: Float[Array, ""]  # s
    q: Float[Array, "coordinates"]
    u: Float[Array, "speeds"]
    moved_q: Float[Array, ""]  # largest change of a coordinate by the projection
    moved_u: Float[Array, ""]  # largest change of a speed by the projection
    residual: Float[Array, ""]  # what is left of rows and quaternion norms
    names: tuple[Names, Names] = eqx.field(static=True)

    def __getitem__(self, name: str):
        """A coordinate, speed, quaternion or angular velocity by name."""
        coordinates, speeds = (names.view(x) for names, x in zip(self.names, (self.q, self.u), strict=True))
        return coordinates[name] if name in coordinates else speeds[name]

    def __contains__(self, name: str) -> bool:
        return any(name in names for names in self.names)

    def _text(self) -> str:
        if self.q.ndim > 1:
            return f"States of shape {self.q.shape[:-1]}: {', '.join((*self.names[0].entries, *self.names[1].entries))}"
        pairs = [f"{n} = {v:.6g}" for names, x in zip(self.names, (self.q, self.u), strict=True) for n, v in zip(names.entries, np.asarray(x), strict=True)]
        moved = f"moved by {self.moved_q:.2e} (q), {self.moved_u:.2e} (u) onto the constraints; residual {self.residual:.1e}"
        return f"State at t = {self.t:.6g} s: " + ", ".join(pairs) + f"\n{moved}"


def consistent(scene: Scene, t, q: Numbers, u: Numbers, inputs=None, *, held: tuple[str, ...] = ()) -> State:
    """The state on the constraints nearest to (q, u): positions by Gauss-Newton, speeds M-orthogonally; g(t, q) = 0, phi(t, q, u) = 0.

    `inputs`: values of the scene's inputs (default: zero). `held`: names of coordinates and speeds that do not move.

    Differentiable in any mode. What cannot be met stays in `residual`, which is infinite where numbers are not finite (no error: this also runs
    inside jit and vmap); the quaternion (0, 0, 0, 0) has no direction and stays as it is, with a residual of 1/2. ValueError for wrong shapes.
    """
    t, q, u = as_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    inputs = as_input_vector(scene, inputs, q.dtype)
    known = (*scene.coordinate_names.entries, *scene.speed_names.entries)
    for name in held:
        if name not in known:
            raise ValueError(f"`held` names `{name}`, which is no coordinate or speed; {nearest(name, known)}")
    free_q, free_u = (np.array([name not in held for name in names.entries], bool) for names in (scene.coordinate_names, scene.speed_names))
    project = _uncompiled_projection if _seldom(jax.tree.structure(scene), (scene, t, q, u, inputs)) else _compiled_projection
    near_q, near_u, moved_q, moved_u, residual = (jnp.asarray(x) for x in project(scene, t, q, u, inputs, free_q, free_u))
    return State(t, near_q, near_u, moved_q, moved_u, residual, (scene.coordinate_names, scene.speed_names))


_seldom = Seldom(often=8)


def _put_onto_constraints(scene: Scene, t, q, u, inputs, free_q, free_u):
    """q and u on the constraints; the largest changes of both and the largest residual, infinite where a number is not finite."""
    near_q = project_positions(scene, t, q, free=jnp.asarray(free_q))
    near_u = project_speeds(scene, t, near_q, u, inputs, free=jnp.asarray(free_u))
    left = jnp.concatenate([closure_residual(scene, t, near_q), velocity_residual(scene, t, near_q, near_u, inputs)])
    finite = jnp.all(jnp.isfinite(jnp.concatenate([near_q, near_u, left])))
    moved_q, moved_u, residual = (jnp.max(jnp.abs(x), initial=0.0) for x in (near_q - q, near_u - u, left))
    return near_q, near_u, moved_q, moved_u, jnp.where(finite, residual, jnp.inf)


_compiled_projection = eqx.filter_jit(_put_onto_constraints)  # one program for every choice of what is held
_uncompiled_projection = on_numbers(_put_onto_constraints)


def start(scene: Scene, *, t0: Number = 0.0, inputs=None, **values) -> State:
    """A consistent start from named coordinates and speeds: `start(disc, lean=0.3, spin_rate=-3.0)`.

    `values` that are given are kept, at time `t0` (s). Privileged speeds that are not given stay zero and the dependent speeds follow from the rows;
    where dependent speeds are given, all others are solved for: the smallest change that meets the constraints, in the metric of the mass matrix.
    `inputs`: as in `simulate`, name -> number, function of time, or `Sampled`; what they are at `t0` counts where velocity rows depend on them.
    ValueError, where values are known: an unknown name, a value that is not finite, given values that contradict the constraints.
    """
    return named_start(scene, values, t0, as_inputs(as_scene(scene), inputs).at(as_time(t0)))


def named_start(scene: Scene, values: Mapping, t0, inputs: Float[Array, "inputs"]) -> State:
    """The same from a dictionary of `values`, and the `inputs` at time `t0` as a vector."""
    q, u, given = as_scene(scene).named(**values)
    _check_finite({**values, "t0": t0})
    state = consistent(scene, t0, q, u, inputs, held=(*given, *_resting(scene, given)))
    _check_residual(scene, state, inputs, given)
    return state


def _resting(scene: Scene, given: tuple[str, ...]) -> tuple[str, ...]:
    """Privileged speeds that stay at zero: those not given, where no dependent speed was."""
    names = scene.speed_names.entries
    privileged = [names[i] for i in structure_of(scene).independent]
    if any(name in names and name not in privileged for name in given):
        return ()
    return tuple(name for name in privileged if name not in given)


def _check_finite(values: Mapping) -> None:
    for name, value in values.items():
        if not isinstance(value, jax.core.Tracer) and not np.all(np.isfinite(np.asarray(value, float))):
            raise ValueError(f"start value `{name}` is {value}, expected a finite number; check where it was computed")


def _check_residual(scene: Scene, state: State, inputs, given: tuple[str, ...]) -> None:
    if isinstance(state.residual, jax.core.Tracer) or float(state.residual) < 1e3 * np.sqrt(np.finfo(state.q.dtype).eps):
        return
    g = np.abs(np.asarray(closure_residual(scene, state.t, state.q)))
    phi = np.abs(np.asarray(velocity_residual(scene, state.t, state.q, state.u, inputs)))
    names = list(names_of_position_rows(scene))
    names += [f"norm of quaternion {k + 1}" for k in range(len(g) - len(names))] + list(names_of_rows(scene))
    worst = int(np.argmax(np.concatenate([g, phi])))
    held = ", ".join(f"`{name}`" for name in given) or "none"
    raise ValueError(
        f"the start of `{type(scene).__name__}` contradicts row `{names[worst]}`: residual {np.concatenate([g, phi])[worst]:.3g} is left with the given values "
        f"held ({held}); give fewer values and let the constraints decide the rest, or use `consistent(scene, t, q, u)` to move all of them"
    )
