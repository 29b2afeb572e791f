"""Small motions as a state space model, for the design of controllers.

    dx/dt = A x + B f,    y = C x + D f

`minimal` omits states that have no effect, and states that others determine as long as only inputs excite the
motion. With x = X x', where x' are the states kept, the matrices become (A X)', B' and C X; the prime selects
the rows of the states kept.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.integrability import extended
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import described, largest, rank_cutoff, static
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import Labels, as_names, check_names
from jourdain_jax.scene.printing import Printed, matrix
from jourdain_jax.structure.rank import pivot_columns

Outputs = str | Labels | list[str] | Mapping[str, Callable[[Any], Any]] | None


class StateSpace(Printed, eqx.Module):
    """Linear model `dx/dt = A x + B f, y = C x + D f` of deviations from a motion.

        model = jj.linearize(scene, state).minimal()
        gains, _, poles = control.lqr(model.to_control(), Q, R)

    `print` shows the matrices with the names of states, inputs and outputs.
    """

    A: Float[Array, "states states"]
    B: Float[Array, "states inputs"]
    C: Float[Array, "outputs states"]
    D: Float[Array, "outputs inputs"]
    states: Labels = static()
    inputs: Labels = static()
    outputs: Labels = static()
    title: str = static()  # name of the scene

    def _text(self) -> str:
        rows = {"A": self.states, "B": self.states, "C": self.outputs, "D": self.outputs}
        columns = {"A": self.states, "B": self.inputs, "C": self.states, "D": self.inputs}
        parts = [line for k in rows for line in matrix(k, getattr(self, k), rows[k], columns[k])]
        return "\n".join([f"State space of {self.title}", *parts])

    def to_control(self) -> Any:
        """Return this model as `control.ss` of python-control, with names of states, inputs and outputs.

        Raises ImportError without python-control, and ValueError for a scene without inputs.
        """
        control = needed("control", "a state space model of python-control", "interop")
        if not self.inputs:
            raise ValueError(f"`{self.title}` has no inputs, which python-control needs; declare `jj.inputs`")
        names = {name: list(getattr(self, name)) for name in ("states", "inputs", "outputs")}
        return control.ss(*map(np.asarray, (self.A, self.B, self.C, self.D)), name=self.title, **names)


def outputs_of(
    outputs: Outputs,
    known: Labels,
    followed: Float[Array, "all independent"],
    slope: Callable[[Callable, Array], Array],
    states: Labels,
) -> tuple[Labels, Float[Array, "outputs independent"]]:
    """Return the names of outputs and the matrix [C D]. `followed`: rows of such a matrix for the names
    `known`, then for the inputs; `slope`: returns the derivative of a function of a `Motion` along a column
    of `followed`.
    """
    if isinstance(outputs, Mapping):
        return tuple(outputs), jnp.stack([_row(*output, followed, slope) for output in outputs.items()])
    names = states if outputs is None else as_names(outputs)
    check_names(names, known, "`outputs` names `{}`, which is not a coordinate or speed of this scene")
    return names, followed[np.array([known.index(name) for name in names], int)]


def _row(name: str, of: Callable, followed: Float[Array, "all independent"], slope: Callable):
    found = jax.vmap(lambda x: slope(of, x), in_axes=1)(followed)
    if getattr(found, "shape", None) != followed.shape[1:]:
        raise ValueError(
            f"output `{name}` is {described(found[0])}, expected a function of a motion that returns one "
            "number"
        )
    return found


@of_known_numbers
def minimal(model: StateSpace, first_speed: int, named: bool) -> StateSpace:
    """Return the model without states on which neither speeds nor (if `named`) outputs depend, directly or
    through others, and without states that others determine as long as only inputs excite the motion.

    Entries below `rank_cutoff` times the largest entry count as zero. The unit of time is chosen so that
    rates of speeds and of coordinates are comparable. `first_speed`: index of the first speed among the
    states.
    """
    A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
    of_coordinates = np.arange(len(A)) < first_speed
    up, down = (largest(A[np.ix_(some, ~some)]) for some in (~of_coordinates, of_coordinates))
    rate = np.sqrt(up / down) if up and down else 1.0
    size = np.where(of_coordinates, rate, 1.0)
    cutoff = rank_cutoff(A.dtype)
    a, b, c = (
        np.where(np.abs(x) > cutoff * largest(x), x, 0.0)
        for x in (size[:, None] * A / size, size[:, None] * B, C / size)
    )
    seen = np.any(c != 0, axis=0) if named else ~of_coordinates
    for _ in A:
        seen = seen | np.any(a[seen] != 0, axis=0)
    places = np.flatnonzero(seen)
    moved = _controllable(a[np.ix_(places, places)], b[places], cutoff)
    if not moved.size:
        raise ValueError(f"no input moves `{model.title}` at this state, so its minimal model has no states")
    kept = list(pivot_columns(moved.T, moved.shape[1]))
    X = moved / size[places, None]
    X = X @ np.linalg.inv(X[kept])
    chosen = places[kept]
    states = tuple(model.states[i] for i in chosen)
    A, B, C = A[np.ix_(chosen, places)] @ X, B[chosen], C[:, places] @ X
    if not named:
        C, D = np.eye(len(kept)), np.zeros((len(kept), B.shape[1]))
    outputs = model.outputs if named else states
    A, B, C, D = map(jnp.asarray, (A, B, C, D))
    return StateSpace(A, B, C, D, states, model.inputs, outputs, model.title)


def _controllable(
    A: Float[np.ndarray, "n n"], B: Float[np.ndarray, "n inputs"], cutoff: float
) -> Float[np.ndarray, "n controllable"]:
    """Return an orthonormal basis of the span of `B, A B, A^2 B, ...`, extended by the new directions of each
    product.
    """
    basis, new, size = np.zeros((0, len(A))), B.T, largest(B)
    while len(new):
        basis, chosen = extended(basis, new, cutoff * size)
        new, size = basis[len(basis) - len(chosen) :] @ A.T, largest(A)
    return basis.T
