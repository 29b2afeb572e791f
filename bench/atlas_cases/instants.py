"""The probes of one state: accelerations, and their derivatives."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from atlas_cases import naive
from atlas_cases.methods import Method, reduction
from atlas_cases.outcomes import RIGHT, Outcome, judged, not_applicable, worst
from jourdain_jax.program.eager import eval_numpy

ONLY_MOTION = "no motion is asked"
ONLY_OF_MOTIONS = ("constraints", "integrators", "adjoints", "elsewhere")


@dataclass
class Instant:
    """Accelerations at one state against known ones."""

    scene: jj.Scene
    q: np.ndarray
    u: np.ndarray
    udot: np.ndarray  # known
    scale: float | None = None
    force: np.ndarray | None = None  # known constraint force on the speeds

    def cell(self, method: Method, tolerance) -> Outcome:
        """Outcome of one method."""
        if method.group in ONLY_OF_MOTIONS or method.batch or method.naive in naive.SPEEDS_IN_BASIS:
            return not_applicable(ONLY_MOTION)
        q, u = jnp.asarray(self.q, float), jnp.asarray(self.u, float)
        if method.naive is not None:
            static = naive.fixed_point(self.scene, q, u)
            udot = naive.accelerations(method.naive, self.scene, static, 0.0, q, u)
            return judged(worst(udot, self.udot, self.scale), tolerance)
        found = jj.accelerations(self.scene, 0.0, q, u, reduction=reduction(self.scene, method.reduction))
        error = worst(found.udot, self.udot, self.scale)
        if self.force is not None:
            error = float(np.maximum(error, worst(found.constraint_force, self.force)))
        plain = judged(error, tolerance)
        right = plain.outcome == RIGHT and bool(found.applicable)
        return plain if right else judged(error, tolerance, flags_of(found))


def flags_of(found: jj.Accelerations):
    """What accelerations say against themselves: not applicable, fewer independent rows than rows, a small
    singular value, a residual.
    """
    rows, eps = found.multipliers.shape[0], float(jnp.finfo(found.udot.dtype).eps)
    if not bool(found.applicable):
        return "`applicable` is False"
    if int(found.rank) < rows:
        return f"rank {int(found.rank)} of {rows} rows"
    if float(found.smallest_singular_value) < np.sqrt(eps):
        return f"smallest singular value {float(found.smallest_singular_value):.1e}"
    return f"residual {float(found.residual):.1e}" if float(found.residual) > np.sqrt(eps) else ""


@dataclass
class DerivativeOfAccelerations:
    """`d w.udot/d x` at one state, in reverse mode, against a known derivative; `state(x)` gives entries of q
    and u.
    """

    scene: jj.Scene
    state: Callable
    x: float
    weights: tuple
    known: float
    traced: dict = field(default_factory=dict)  # one program serves all reductions

    def cell(self, method: Method, tolerance) -> Outcome:
        """Outcome of one method."""
        if method.group in ONLY_OF_MOTIONS or method.batch or method.naive in naive.SPEEDS_IN_BASIS:
            return not_applicable(ONLY_MOTION)
        scene, weights = self.scene, jnp.asarray(self.weights, float)
        at = lambda x: map(jnp.stack, self.state(x))
        static = naive.fixed_point(scene, *at(jnp.asarray(self.x))) if method.naive else None

        def value(x, way):
            if method.naive is not None:
                return weights @ naive.accelerations(method.naive, scene, static, 0.0, *at(x))
            return weights @ jj.accelerations(scene, 0.0, *at(x), reduction=way).udot

        key = method.naive or ("default" if method.reduction is None else "reductions")
        if key not in self.traced:
            self.traced[key] = eval_numpy(jax.grad(value))  # looked at once: compiling would take longer
        try:
            slope = float(self.traced[key](jnp.asarray(self.x), reduction(scene, method.reduction)))
        except NotImplementedError as refusal:
            return judged(np.nan, tolerance, f"NotImplementedError: {str(refusal).splitlines()[0][:90]}")
        return judged(worst(slope, self.known), tolerance)
