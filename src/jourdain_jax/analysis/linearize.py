"""Linearise the equations of motion about a steady motion, on the constraint manifold.

    x = (independent coordinates, independent speeds):             dx/dt = A x + B f
    named coordinates p, virtual velocities W that make pdot = 1:  M pddot + C pdot + K p = F f
                                                                   M = W' (mass matrix) W

Dependent coordinates and speeds follow from the linearised constraints (`linear_matrices.py`). The
second-order form is Appell's equations for the named coordinates: the first-order form, written with the
speeds (pdot, other independent speeds) and multiplied by M. Source: Wang and Pao (2003), eqs. (25)-(31),
(41); D. L. Peterson, G. Gede and M. Hubbard, Multibody System Dynamics 33 (2015) 143.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jourdain_jax.analysis.families.eigenvalue_derivatives import Sensitivities, sensitivities
from jourdain_jax.analysis.families.equations import mode_names
from jourdain_jax.analysis.linear_matrices import (
    dependent_coordinates,
    matrices_of,
    own_rate,
    perturbed_names,
    privileged_at,
    privileged_speeds,
)
from jourdain_jax.analysis.motion_derivatives import ByMatrices, instant_of, places_of
from jourdain_jax.analysis.state_space import Outputs, StateSpace, minimal, outputs_of
from jourdain_jax.analysis.steady import in_phase
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Count, Indices, Scalar, all_finite, holds, is_traced, static
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.state import State, state_of
from jourdain_jax.lowering.sides import bent_load
from jourdain_jax.motion.sensitivity import SensitivityWarning
from jourdain_jax.motion.simulate import as_state
from jourdain_jax.scene.arguments import (
    BuiltFor,
    InputLike,
    as_input_vector,
    as_scene,
    shown_from_users_lines,
    warn,
)
from jourdain_jax.scene.coordinates import Labels, as_names, check_name
from jourdain_jax.scene.printing import Printed, complex_numbers, matrix
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import WELL_CONDITIONED


class Modes(eqx.Module):
    """Free small motions `p(t) = shape exp(s t)`, one column per mode; the largest entry of a shape is 1."""

    eigenvalues: Complex[Array, "modes"]  # s, in 1/s
    shapes: Complex[Array, "parts modes"]  # (M s^2 + C s + K) shape = 0
    left: Complex[Array, "parts modes"]  # conj(left)' (M s^2 + C s + K) = 0
    # |y' x| of unit left and right vectors of the first-order form: zero at a double root
    condition: Float[Array, "modes"]
    scene: Scene
    named: Labels | None = static()

    @property
    def names(self) -> Labels:
        """Return names of the modes, in the order of the eigenvalues."""
        return mode_names(self.scene, self.named, np.asarray(self.eigenvalues))


class Linearization(Printed, eqx.Module):
    """Linear equations of small motions about a state.

    x = (independent coordinates, independent speeds): `dx/dt = A x + B f`. For the named coordinates p:
    `M pddot + C pdot + K p = F f`.
    """

    A: Float[Array, "states states"]
    B: Float[Array, "states inputs"]
    M: Float[Array, "parts parts"]  # of the named coordinates
    C: Float[Array, "parts parts"]
    K: Float[Array, "parts parts"]
    F: Float[Array, "parts inputs"]
    acceleration: Scalar  # largest |dy/dt| of the independent speeds y at the state; zero if it is steady
    residual: Scalar  # larger of `acceleration` and |d2y/dt2| along the motion; zero if it is steady
    # largest coefficient of other coordinates in the second-order form, relative to those in M, C, K
    coupling: Scalar
    # smallest singular value of the scaled constraint rows of the dependent variables; near zero: choose
    # other dependent speeds or coordinates
    pivot: Scalar
    # of coordinates, speeds and inputs, along the independent ones: states, then inputs
    followed: Float[Array, "all independent"]
    states: Labels = static()  # names of the entries of x
    inputs: Labels = static()
    coordinates: Labels = static()  # names of p
    about: tuple[Scene, State, Float[Array, "inputs"]]  # the linearised scene, state and inputs

    def _text(self) -> str:
        if self.A.ndim != 2:
            return (
                f"Linearizations of shape {self.A.shape[:-2]}; named coordinates:"
                f" {', '.join(self.coordinates) or 'none'}"
            )
        lines = [
            f"Small motions: residual {float(self.residual):.1e} (zero if the motion is steady), "
            f"pivot {float(self.pivot):.2g}"
        ]
        names, states = self.coordinates, self.states
        shown = dict.fromkeys("MCK", names) | {"F": self.inputs}
        if not names:
            shown = {"A": states, "B": self.inputs}
        for what, columns in shown.items():
            lines += matrix(what, getattr(self, what), names or states, columns) if columns else []
        if names:
            lines.append(f"  coupling to other coordinates {float(self.coupling):.1e}")
        values = complex_numbers(self.eigenvalues() if names else self.state_eigenvalues())
        return "\n".join([*lines, "  eigenvalues in 1/s: " + ", ".join(values)])

    @property
    def code(self) -> Count:
        """Return 0, or `SINGULAR_PARTITION` if the independent speeds and coordinates do not determine the
        others. In that case all results are NaN.
        """
        return jnp.where(self.pivot >= SMALLEST_PIVOT, result_codes.SUCCESS, result_codes.SINGULAR_PARTITION)

    def eigenvalues(self) -> Complex[Array, "modes"]:
        """Return the roots of `det(M s^2 + C s + K) = 0`, 1/s, by ascending real part. Distinct roots are
        differentiable.
        """
        return sorted_eigenvalues(self._companion())

    def modes(self, names: Labels | None = None) -> Modes:
        """Return the modes of the second-order form: `eigenvalues`, and mode shapes in the named coordinates.
        They have no derivatives.

        `names`: names of the modes, in the order of the eigenvalues; default: the `mode_names` of the scene,
        or "mode 1", ...
        """
        values, shapes, left, condition = _decomposed(self)
        return Modes(values, shapes, left, condition, self.about[0], names)

    def sensitivities(self, mode: str, held: str | Labels = (), names: Labels | None = None) -> Sensitivities:
        """Return derivatives of a mode's eigenvalue with respect to all parameters, as in
        `small.sensitivities("weave")["c"]`. Of a conjugate pair, the eigenvalue above the real axis is taken.

        The derivatives include the change of the steady motion. `held`: names of the coordinates and speeds
        that keep their values and so select a steady motion among its neighbours; default: speeds in the
        scene's order, for a bicycle `x_rate`. `names`: as in `modes`. At a double root all derivatives are
        NaN, and `code` is not 0. Raises ValueError for an unknown mode and a motion that is not steady,
        `NotLowered` if the scene has no scalar program.
        """
        found = self.modes(names)
        check_name(mode, dict.fromkeys(found.names), f"no mode `{mode}`")
        eigenvalues = [
            complex(s) for s, name in zip(found.eigenvalues, found.names, strict=True) if name == mode
        ]
        return sensitivities(self.about, mode, max(eigenvalues, key=lambda s: s.imag), held)

    def state_eigenvalues(self) -> Complex[Array, "states"]:
        """Return eigenvalues of A, 1/s, by ascending real part.

        Ignorable coordinates, and speeds that may have any value in a steady motion, give zero eigenvalues.
        These often form Jordan blocks and are then sensitive to round-off: an error of 1e-16 may change a
        zero eigenvalue to 1e-8. `eigenvalues` omits them.
        """
        return sorted_eigenvalues(self.A)

    def state_space(self, outputs: Outputs = None) -> StateSpace:
        """Return the model `dx/dt = A x + B f`, `y = C x + D f` with the named outputs y.

            small.state_space("lean yaw_rate")
            small.state_space({"nose": lambda motion: motion["sleigh"].place((0.3, 0.0, 0.0))[1]})

        `outputs`: names of coordinates and speeds, including dependent ones, or a dictionary of functions by
        name, each from a `Motion` (one instant) to one number; default: the states. Raises ValueError for an
        unknown name.
        """
        scene, state, f = self.about
        count, n, m = len(self.states), len(perturbed_names(scene)), len(state.u)

        def slope(of, x):
            dq = scene.coordinates.default_rates(state.q, x[:n])
            at = lambda q, u, f: of(motion_at(scene, state.t, q, u, f))
            return jax.jvp(at, (state.q, state.u, f), (dq, x[n : n + m], x[n + m :]))[1]

        names, rows = outputs_of(
            outputs, (*perturbed_names(scene), *scene.speed_names.entries), self.followed, slope, self.states
        )
        C, D = rows[:, :count], rows[:, count:]
        return StateSpace(self.A, self.B, C, D, self.states, self.inputs, names, type(scene).__name__)

    def to_control(self, outputs: Outputs = None) -> Any:
        """Return `state_space(outputs)` as `control.ss` of python-control, with all names. Raises ImportError
        without python-control.
        """
        return self.state_space(outputs).to_control()

    def minimal(self, outputs: Outputs = None) -> StateSpace:
        """Return `state_space(outputs)` without ignorable states and uncontrollable modes, for example for a
        regulator. `states` of the result, and by default also `outputs`, are the names of the states kept.

        States on which no speed and no given output depends, directly or through others, are omitted, such as
        x, y and yaw of a bicycle. Also omitted are states that other states determine as long as only inputs
        excite the motion, such as the forward speed of a bicycle, or one of two equal pendulums on a cart.
        Modes that only initial values can excite are lost, even if they grow: compare `state_eigenvalues`.

        Raises ValueError for an unknown name, and if no input moves the scene.
        """
        first = sum(name not in self.about[0].speed_names.entries for name in self.states)
        return minimal(self.state_space(outputs), first, outputs is not None)

    def _companion(self) -> Float[Array, "modes modes"]:
        if not self.coordinates:
            raise ValueError(
                "no coordinates are named, so there is no second-order form; give `coordinates` to "
                "`linearize`, or use `state_eigenvalues`"
            )
        return companion(-jnp.linalg.solve(self.M, jnp.concatenate([self.K, self.C], axis=1)))


@shown_from_users_lines
def linearize(
    scene: Scene | BuiltFor,
    state: "State | Mapping[str, Any] | None",
    coordinates: str | Labels | None = None,
    *,
    inputs: InputLike = None,
    dependent: str | Labels | None = None,
    privileged: str | Labels | None = None,
) -> Linearization:
    """Return the equations of motion linearised about a steady `state`, and a residual that shows how steady
    it is.

        bicycle = WhippleBicycle()
        small = linearize(bicycle, start(bicycle, **bicycle.upright(5.0)), ("lean", "steer"))
        small.M, small.C, small.K, small.eigenvalues()

    **Arguments**

    - `state`: a state on the constraints. In a steady motion, only ignorable coordinates change, such as the
      yaw and the spin of a disc, and the matrices are constant. If the state is not steady, the matrices hold
      only at this instant, and `residual` measures the deviation. Contacts with friction keep the modes of
      the state, which must be known: open contacts are absent, and friction acts against slip.
    - `coordinates`: names of the coordinates of the second-order form; default: all whose rate is
      independent. A quaternion `attitude` has `attitude_turn_x`, `..._y`, `..._z`: small rotations in body
      axes.
    - `inputs`: values of the scene's inputs (default: zero), held constant.
    - `dependent`: names of the coordinates that the geometric constraints determine; `privileged`: names of
      the independent speeds. Defaults are well conditioned at the state (for a traced state or traced
      parameters, over the scene's domain).

    No option of `jj.Options` applies, because nothing is integrated. `jj.build` chooses the backend.

    **Returns** a `Linearization`. The function is pure and runs under jit, vmap and differentiation with
    respect to parameters and state. If the independent speeds do not determine the others, all results are
    NaN and `code` is not 0: name others.

    **Raises** ValueError for an unknown coordinate or speed; for a named coordinate that is dependent or
    whose rate is not independent; and, at a known state, if the independent speeds or coordinates do not
    determine the others. **Warns** (`SensitivityWarning`) if a load has a kink or jumps at the state, as dry
    friction does at rest.
    """
    built, scene = scene, as_scene(scene)
    f = as_input_vector(scene, inputs)
    state = as_state(scene, state, what="state", inputs=f)
    phase, q, f = in_phase(scene, state.t, state.q, state.u, f.astype(state.q.dtype))
    if phase is not scene:
        built, scene, state = phase, phase, state_of(phase, state.t, q, state.u)
    _warn_of_loads(scene, state, f)
    coordinates = None if coordinates is None else as_names(coordinates)
    dependent = None if dependent is None else as_names(dependent)
    y = privileged_speeds(scene, privileged)
    found = _about(instant_of(built, y, masses=True), scene, state, f, y, dependent, coordinates)
    if holds(lambda pivot: ~(pivot < WELL_CONDITIONED), found.pivot):
        return found
    if privileged is None and scene.privileged is None and (chosen := privileged_at(scene, state, f, y)) != y:
        found = _about(ByMatrices(chosen), scene, state, f, chosen, dependent, coordinates)
    if found.pivot < SMALLEST_PIVOT:
        raise ValueError(
            f"the dependent speeds or coordinates of `{type(scene).__name__}` are not determined by its "
            f"constraints at this state (pivot {float(found.pivot):.1e}): choose others with `privileged` or "
            "`dependent`, or linearize at a nearby state"
        )
    return found


def _warn_of_loads(scene: Scene, state: State, f) -> None:
    """Warn if a load has no derivative at the state. Traced values are not checked."""
    if not is_traced((scene, state, f)) and (rough := bent_load(scene, state.t, state.q, state.u, f)):
        text = (
            f"the linearization of `{type(scene).__name__}` is not valid: {rough} has no derivative at this "
            "state, because it has a kink or jumps there, as dry friction does at rest. Linearize at another "
            "state, or smooth the load, as with `jnp.tanh`"
        )
        warn(text, SensitivityWarning)


def _about(
    instant, scene: Scene, state: State, f, y: Indices, dependent: Labels | None, coordinates: Labels | None
) -> Linearization:
    v, D, mass = instant(scene, state.t, state.q, state.u, f)
    at, names = places_of(scene), perturbed_names(scene)
    q, known = state.q, not is_traced((D, state))
    if known:
        q, v, D, mass = map(np.asarray, (q, v, D, mass))
    G = D[np.ix_(at.geometric, at.q)] if known and all_finite(D) else None
    following = [names[i] for i in dependent_coordinates(scene, state, coordinates or (), dependent, G)]
    independent = tuple(name for name in names if name not in following)
    speeds = tuple(scene.speed_names.entries[i] for i in y)
    if coordinates is None:
        coordinates = tuple(name for name in independent if own_rate(scene, name) in y)
    matrices = matrices_of(scene, q, v, D, mass, independent, y, coordinates)
    states, inputs = (*independent, *speeds), scene.inputs.entries
    return Linearization(
        **matrices, states=states, inputs=inputs, coordinates=coordinates, about=(scene, state, f)
    )


def companion(lower: Float[Array, "k modes"]) -> Float[Array, "modes modes"]:
    """Return the matrix of the first-order form `d(p, pdot)/dt` of `pddot = lower (p, pdot)`."""
    k = len(lower)
    return jnp.concatenate([jnp.eye(k, 2 * k, k, dtype=lower.dtype), lower])


@compiled_quickly
def _decomposed(found: Linearization) -> tuple[Array, Array, Array, Array]:
    """Return eigenvalues, mode shapes, left shapes and condition of the second-order form, as in `Modes`."""
    values, left, right = jax.lax.linalg.eig(jax.lax.stop_gradient(found._companion()))
    order, k = jnp.lexsort((values.imag, values.real)), len(found.coordinates)
    values, left, right = values[order], left[:, order], right[:, order]
    condition = jnp.abs(jnp.sum(left.conj() * right, axis=0))
    return values, _largest_one(right[:k]), _largest_one(jnp.linalg.solve(found.M, left[k:])), condition


def _largest_one(shapes: Complex[Array, "parts modes"]) -> Complex[Array, "parts modes"]:
    return shapes / jnp.take_along_axis(shapes, jnp.argmax(jnp.abs(shapes), axis=0)[None], axis=0)


@compiled_quickly
def sorted_eigenvalues(matrix: Float[Array, "states states"]) -> Complex[Array, "modes"]:
    """Return eigenvalues by ascending real part, then imaginary part."""
    values = jnp.linalg.eigvals(matrix)
    return values[jnp.lexsort((values.imag, values.real))]
