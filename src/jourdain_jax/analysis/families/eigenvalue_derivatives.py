"""Compute derivatives of one eigenvalue of small motions with respect to all parameters.

    ds = y' dF x,    F x = s x,  y' F = s y',  y' x = 1

F: matrix of the small motions dz' = F dz about a steady motion. dF includes the change of the steady motion,
J dz = -R_p dp (R, J, z: as in `equations.py`; p: parameters).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex

from jourdain_jax.analysis.families.critical import FOUND, MEANINGS, SINGULAR, program_of
from jourdain_jax.analysis.families.equations import Look, SteadyEquations, null_space, numbered
from jourdain_jax.analysis.families.special_points import SURE
from jourdain_jax.calculus.reals import largest, static
from jourdain_jax.integrate.state import State
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import Labels, as_names, parameters_of
from jourdain_jax.scene.printing import Printed, complex_numbers, table
from jourdain_jax.scene.scene import Scene


class Sensitivities(Printed, eqx.Module):
    """Derivatives of one eigenvalue with respect to all parameters, by name: `found["c"]`. They include the
    effect of the change of the steady motion.
    """

    mode: str = static()
    eigenvalue: complex  # 1/s
    condition: float  # |y' x| of unit left and right vectors: zero at a double root, which has no derivative
    by_parameter: dict[str, Complex[np.ndarray, "*entries"]]
    code: int
    held: Labels = static()  # quantities that keep their values and so identify the steady motion

    def __getitem__(self, name: str) -> Complex[np.ndarray, "*entries"]:
        """Return the derivative with respect to a parameter."""
        return self.by_parameter[name]

    def _text(self) -> str:
        head = (
            f"{self.mode}: {complex_numbers([self.eigenvalue])[0]} 1/s, condition {self.condition:.2g},"
            f" {MEANINGS[self.code]}"
        )
        rows = [
            (name, ", ".join(complex_numbers(np.ravel(value)))) for name, value in self.by_parameter.items()
        ]
        return "\n".join(
            [head, f" derivatives at constant {', '.join(self.held) or 'nothing'}:", *table(rows)]
        )


@of_known_numbers
def sensitivities(
    small: tuple[Scene, State, Array], mode: str, s: complex, held: str | Labels
) -> Sensitivities:
    """Return the derivatives of the eigenvalue s of small motions about a steady state with respect to all
    parameters. Two reverse passes compute them.
    """
    scene, state, f = small
    equations = SteadyEquations(
        scene, (float(state.t), np.asarray(state.q), np.asarray(state.u)), np.asarray(f)
    )
    z = equations.start
    look = equations(z)
    if not largest(look.R) < 1e-6:
        raise ValueError(
            f"this motion of `{type(scene).__name__}` is not steady, so its eigenvalues have no "
            "derivatives; find a steady motion with `jj.steady`"
        )
    fixed = _held(equations, look, as_names(held))
    (values, right), (same, left) = np.linalg.eig(F := look.small[0]), np.linalg.eig(F.T)
    apart = np.abs(values - s)
    x, y = right[:, np.argmin(apart)], left[:, np.argmin(np.abs(same - s))]
    condition = float(np.abs(y @ x))
    single = condition > 1e-6 and np.partition(np.append(apart, np.inf), 1)[1] > SURE * (1 + abs(s))
    y = y / (y @ x)

    program, numbers, zero = program_of(equations), equations.at(z), np.zeros(len(look.R), complex)
    no_C = np.zeros(len(equations.of_states))

    def pulled(x, of_rows, of_rates):
        """Return derivatives of `of_rows . R + of_rates . F x` with respect to all numbers."""
        at, weights = np.concatenate([numbers, x]), np.concatenate([of_rows, of_rates, no_C])
        real, imag = (np.asarray(program.pulled(at, part)) for part in (weights.real, weights.imag))
        return (real + 1j * imag)[: len(numbers)]

    by_all = pulled(x.real, zero, y) + 1j * pulled(x.imag, zero, y)
    inverse = np.linalg.pinv(np.vstack([look.J, np.eye(len(z))[fixed]]), rcond=1e-9)
    by_motion = -(by_all[equations.places] * equations.size) @ inverse[:, : len(look.R)]
    by_all = by_all + pulled(x.real, by_motion, 0 * y)
    if not single:
        by_all = by_all * np.nan
    at = numbered(scene)
    by_parameter = {
        name: np.reshape(by_all[getattr(at, name) :][: np.size(value)], np.shape(value))
        for name, value, _ in parameters_of(scene)
    }
    return Sensitivities(
        mode,
        s,
        condition,
        by_parameter,
        FOUND if single else SINGULAR,
        tuple(equations.unknowns[k] for k in fixed),
    )


def _held(equations: SteadyEquations, look: Look, named: Labels) -> list[int]:
    """Return the indices of unknowns that distinguish a steady motion from its neighbours: the named ones, or
    else the first suitable speeds, then coordinates, in their order.
    """
    beside = null_space(look.J)
    count, speeds = beside.shape[1], equations.scene.speed_names.entries
    chosen: list[int] = []
    for k in map(equations.index, named or sorted(equations.unknowns, key=lambda name: name not in speeds)):
        if len(chosen) < count and np.linalg.matrix_rank(beside[[*chosen, k]], tol=1e-6) > len(chosen):
            chosen.append(k)
    if not len(chosen) == count >= len(named):
        raise ValueError(
            f"the steady motions near this one have {count} degrees of freedom; name {count} "
            f"quantities in `held` that distinguish them ({', '.join(named)} do not)"
        )
    return chosen
