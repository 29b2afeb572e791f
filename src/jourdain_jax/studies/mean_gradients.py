"""Gradients of the means of a study's outputs, by the pathwise derivative.

Sample k consists of probabilities u_k. The distributions, with numbers theta, map these to the varying
quantities x_k(theta), while u_k does not depend on theta. With the output f as a function of x,

    d mean / d theta = (1 / n) sum_k  df/dx (x_k)  dx_k / d theta

where df/dx is the exact derivative of the sample's motion, in forward mode. This is the derivative of the
mean if f is continuous. f may jump where the kind of end of a motion changes, for example from an event to
the end of the span. The derivative then lacks the contribution of the jumps, and a warning reports it.
Outputs that depend only on the event that happened have no pathwise derivative.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.compilation import nan_is_a_mark
from jourdain_jax.integrate import result_codes
from jourdain_jax.motion.rollout import rollout
from jourdain_jax.motion.sensitivity import SensitivityWarning
from jourdain_jax.scene.arguments import warn
from jourdain_jax.scene.coordinates import Labels, check_name, nearest, parameters_of
from jourdain_jax.scene.printing import Printed
from jourdain_jax.studies.design import Distribution
from jourdain_jax.studies.outputs import OfEvent, Task

SHIFT = "shift"  # a common shift of all values of a table column, or of all levels of a grid


@dataclass(frozen=True, repr=False)
class MeanGradients(Printed):
    """Means of outputs and their derivatives.

    - `outputs`, `names`: rows and columns of `gradient`. A column is a shared parameter of the scene, or a
      number of a distribution, such as "radius.sigma"; "radius.shift" shifts all values of a table or grid by
      the same amount.
    - `mean`: shape (outputs,); `gradient`, `standard_error`: shape (outputs, names), in the unit of the
      output over the unit of the number. Standard errors assume independent samples; those of a Sobol
      sequence or a Latin hypercube are smaller. Entries are NaN where the derivative does not exist.
    - `lanes`: the number of samples with a value of each output; `failed`: the number of failed motions,
      which are omitted; `warnings`: reasons to doubt the numbers.
    """

    outputs: Labels
    names: Labels
    mean: np.ndarray
    gradient: np.ndarray
    standard_error: np.ndarray
    lanes: np.ndarray
    failed: int
    warnings: Labels

    def of(self, output: str, name: str) -> float:
        """Return the derivative of the mean of `output` with respect to `name`. Raises ValueError for unknown
        names.
        """
        for given, known in ((output, self.outputs), (name, self.names)):
            check_name(given, known, f"there is no `{given}`")
        return float(self.gradient[self.outputs.index(output), self.names.index(name)])

    def _text(self) -> str:
        lines = [
            f"Gradients of means over {int(self.lanes.max(initial=0))} samples"
            + (f"; {self.failed} failed and are omitted" if self.failed else "")
        ]
        for i, output in enumerate(self.outputs):
            lines.append(f"  {output}: mean {self.mean[i]:.6g}")
            lines += [
                f"    by {name}: {self.gradient[i, j]:.6g} +- {self.standard_error[i, j]:.2g}"
                for j, name in enumerate(self.names)
            ]
        return "\n".join([*lines, *(f"  warning: {text}" for text in self.warnings)])


def mean_gradients(task: Task, shared: Sequence[str]) -> MeanGradients:
    """Return the gradients of the means of all outputs of a task. `shared`: names of parameters that are
    equal in all samples, for further derivatives.
    """
    _check_shared(task, shared)
    columns = (*task.design.names, *shared)
    # a batch has 2048 motions with their tangents
    size = max(8, min(task.block, 2048 // (1 + len(columns))))
    common = {
        name: np.asarray(value, float) for name, value, _ in parameters_of(task.scene) if name in shared
    }
    of_block = _of_block(task, columns)
    blocks = []
    for first in range(0, len(task.design), size):
        count = min(size, len(task.design) - first)
        drawn = task.design.values(first, first + count) | {
            name: np.full(count, value) for name, value in common.items()
        }
        drawn = {name: np.pad(column, (0, size - count), mode="edge") for name, column in drawn.items()}
        with nan_is_a_mark():
            found, derivative, end = (np.asarray(x) for x in of_block(drawn))
        numbers = _numbers(task, shared, first, first + count)
        weighted = [
            derivative[columns.index(column), :count] * factor[:, None] for column, _, factor in numbers
        ]
        blocks.append((found[:count], np.stack(weighted, axis=-1), end[:count]))
    names = [name for _, name, _ in numbers]
    return _gathered(task, names, *map(np.concatenate, zip(*blocks, strict=True)))


def _check_shared(task: Task, shared: Sequence[str]) -> None:
    known = {name: np.ndim(value) for name, value, _ in parameters_of(task.scene)}
    for name in shared:
        if name not in known or name in task.design.names:
            said = "varies over the samples; omit it" if name in known else "is not a parameter of the scene"
            raise ValueError(
                f"`{name}` {said}; {nearest(name, [one for one in known if one not in task.design.names])}"
            )
        if known[name]:
            raise ValueError(f"parameter `{name}` is an array; give parameters that are one number")


def _of_block(task: Task, columns: Sequence[str]):
    """Return a function of a block of columns by name. It returns the outputs (samples, outputs), their
    derivatives with respect to each column (columns, samples, outputs), and the result of each sample.
    """

    def outputs(drawn: Mapping):
        starts, parameters = task.starts_and_parameters(drawn)
        rolled = rollout(
            task.scene, starts, parameters=parameters or None, **task.span, options=task.options
        ).lanes
        found = eqx.filter_vmap(task.outputs_of_lane)(rolled)
        return found, jnp.where(
            rolled.result == result_codes.EVENT, rolled.event, jnp.where(rolled.succeeded, -1, -2)
        )

    def of_block(drawn):
        along = {
            name: jnp.stack([jnp.full_like(drawn[name], float(name == column)) for column in columns])
            for name in columns
        }
        return jax.vmap(
            lambda tangent: jax.jvp(outputs, (drawn,), (tangent,), has_aux=True), out_axes=(None, 0, None)
        )(along)

    return eqx.filter_jit(of_block)


def _numbers(task: Task, shared: Sequence[str], first: int, last: int) -> list[tuple[str, str, np.ndarray]]:
    """Return the numbers theta with respect to which means are differentiated, each as the name of its
    column, its own name, and dx/dtheta (samples,) of the column.
    """
    u, even = task.design.probabilities(first, last), np.ones(last - first)
    found = []
    for i, (name, how) in enumerate(task.design.variables.items()):
        factors = how.derivatives(u[:, i]) if isinstance(how, Distribution) else {SHIFT: even}
        found += [(name, f"{name}.{number}", factor) for number, factor in factors.items()]
    return found + [(name, name, even) for name in shared]


def _gathered(
    task: Task, names, values: np.ndarray, derivatives: np.ndarray, ends: np.ndarray
) -> MeanGradients:
    """Return means over the samples with a finite output; `values` (samples, outputs), `derivatives`
    (samples, outputs, names).
    """
    there = np.isfinite(values)[:, :, None]
    count = there.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.sum(values[:, :, None], axis=0, where=there) / count
        gradient = np.sum(derivatives, axis=0, where=there) / count
        error = np.sqrt(np.sum((derivatives - gradient) ** 2, axis=0, where=there) / (count * (count - 1.0)))
    warned = []
    failed = int(np.sum(ends == -2))
    if failed:
        warned.append(
            f"{failed} of {len(values)} motions failed and are omitted (`run` repeats them by another method)"
        )
    if np.unique(ends[ends != -2]).size > 1:
        of_event = np.array([isinstance(output, OfEvent) for output in task.outputs.values()])
        gradient[of_event] = error[of_event] = np.nan
        if of_event.any():
            none = ", ".join(name for name, is_one in zip(task.outputs, of_event, strict=True) if is_one)
            warned.append(
                f"the event at which a sample ends depends on the varying quantities: the means of {none} "
                "have no pathwise derivative; use differences"
            )
        if not of_event.all():
            warned.append(
                f"{int(np.sum(ends >= 0))} of {len(values)} samples end at an event, others at another event "
                "or at none: if an output differs between these groups, the gradient lacks the effect of "
                "samples that change groups; compare with differences of the mean"
            )
    for text in warned:
        warn(text, SensitivityWarning)
    return MeanGradients(
        tuple(task.outputs), tuple(names), mean[:, 0], gradient, error, count[:, 0], failed, tuple(warned)
    )
