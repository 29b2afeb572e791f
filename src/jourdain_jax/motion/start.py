"""Consistent starts: a guess of q and u put onto the constraints, with a report of how far it moved.

g(t, q) = 0,  phi(t, q, u) = 0
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, Numbers, as_real
from jourdain_jax.equations.projection import closure_residual, project_positions, project_speeds
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows, velocity_residual
from jourdain_jax.equations.structure import structure_of
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.scene import Scene


class State(eqx.Module):
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

    def __str__(self) -> str:
        pairs = [f"{n} = {v:.6g}" for names, x in zip(self.names, (self.q, self.u), strict=True) for n, v in zip(names.entries, np.asarray(x), strict=True)]
        moved = f"moved by {self.moved_q:.2e} (q), {self.moved_u:.2e} (u) onto the constraints; residual {self.residual:.1e}"
        return f"State at t = {self.t:.6g} s: " + ", ".join(pairs) + f"\n{moved}"


def consistent(scene: Scene, t, q: Numbers, u: Numbers, inputs=None, *, held: tuple[str, ...] = ()) -> State:
    """The state on the constraints nearest to (q, u): positions by Gauss-Newton, speeds M-orthogonally; g(t, q) = 0, phi(t, q, u) = 0.

    `inputs`: values of the scene's inputs (default: zero). `held`: names of coordinates and speeds that do not move.

    Differentiable in any mode. What cannot be met stays in `residual` (no error: this also runs inside jit and vmap). ValueError for wrong shapes.
    """
    t, q, u = jnp.asarray(t, jnp.result_type(float)), as_real(q), as_real(u)
    _check_shapes(scene, q, u)
    inputs = jnp.zeros(len(scene.inputs), q.dtype) if inputs is None else as_real(inputs)
    free_q, free_u = (np.array([name not in held for name in names.entries], bool) for names in (scene.coordinate_names, scene.speed_names))
    near_q, near_u, moved_q, moved_u, residual = _put_onto_constraints(scene, t, q, u, inputs, free_q, free_u)
    return State(t, near_q, near_u, moved_q, moved_u, residual, (scene.coordinate_names, scene.speed_names))


@eqx.filter_jit  # one program for every choice of what is held
def _put_onto_constraints(scene: Scene, t, q, u, inputs, free_q, free_u):
    """q and u on the constraints; the largest changes of both and the largest residual."""
    near_q = project_positions(scene, t, q, free=jnp.asarray(free_q))
    near_u = project_speeds(scene, t, near_q, u, inputs, free=jnp.asarray(free_u))
    left = jnp.concatenate([closure_residual(scene, t, near_q), velocity_residual(scene, t, near_q, near_u, inputs)])
    return near_q, near_u, *(jnp.max(jnp.abs(x), initial=0.0) for x in (near_q - q, near_u - u, left))


def start(scene: Scene, *, t0: Number = 0.0, **values) -> State:
    """A consistent start from named coordinates and speeds: `start(disc, lean=0.3, spin_rate=-3.0)`.

    `values` that are given are kept, at time `t0` (s). Privileged speeds that are not given stay zero and the dependent speeds follow from the rows;
    where dependent speeds are given, all others are solved for: the smallest change that meets the constraints, in the metric of the mass matrix.
    ValueError, where values are known: an unknown name, a value that is not finite, given values that contradict the constraints.
    """
    q, u, given = scene.named(**values)
    _check_finite(values)
    state = consistent(scene, t0, q, u, held=(*given, *_resting(scene, given)))
    _check_residual(scene, state, given)
    return state


def _resting(scene: Scene, given: tuple[str, ...]) -> tuple[str, ...]:
    """Privileged speeds that stay at zero: those not given, where no dependent speed was."""
    names = scene.speed_names.entries
    privileged = [names[i] for i in structure_of(scene).independent]
    if any(name in names and name not in privileged for name in given):
        return ()
    return tuple(name for name in privileged if name not in given)


def _check_shapes(scene: Scene, q, u) -> None:
    for what, x, names in (("q", q, scene.coordinate_names), ("u", u, scene.speed_names)):
        if x.shape != (len(names),):
            raise ValueError(
                f"{what} of `{type(scene).__name__}` has shape {x.shape}, expected ({len(names)},) for {', '.join(names.entries)}; "
                "use `jax.vmap` or `rollout` for many states"
            )


def _check_finite(values: dict) -> None:
    for name, value in values.items():
        if not isinstance(value, jax.core.Tracer) and not np.all(np.isfinite(np.asarray(value, float))):
            raise ValueError(f"start value `{name}` is {value}, expected a finite number; check where it was computed")


def _check_residual(scene: Scene, state: State, given: tuple[str, ...]) -> None:
    if isinstance(state.residual, jax.core.Tracer) or float(state.residual) < 1e3 * np.sqrt(np.finfo(state.q.dtype).eps):
        return
    g = np.abs(np.asarray(closure_residual(scene, state.t, state.q)))
    phi = np.abs(np.asarray(velocity_residual(scene, state.t, state.q, state.u)))
    names = list(names_of_position_rows(scene))
    names += [f"norm of quaternion {k + 1}" for k in range(len(g) - len(names))] + list(names_of_rows(scene))
    worst = int(np.argmax(np.concatenate([g, phi])))
    held = ", ".join(f"`{name}`" for name in given) or "none"
    raise ValueError(
        f"the start of `{type(scene).__name__}` contradicts row `{names[worst]}`: residual {np.concatenate([g, phi])[worst]:.3g} is left with the given values "
        f"held ({held}); give fewer values and let the constraints decide the rest, or use `consistent(scene, t, q, u)` to move all of them"
    )
