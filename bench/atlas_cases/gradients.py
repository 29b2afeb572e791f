"""The probe of a derivative through a whole motion, against a known derivative."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from atlas_cases import naive
from atlas_cases.case import by_type
from atlas_cases.methods import Method
from atlas_cases.outcomes import Outcome, judged, not_applicable, worst
from jourdain_jax.integrate import result_codes

# for the reductions, of which reverse mode takes seconds per thousand steps: ten times what a right answer
# took
FEWER_STEPS = 2000
# for an implicit solver of diffrax, which comes to a singularity in ever shorter steps and goes back over all
# of them
IMPLICIT_STEPS = 5000


@dataclass
class DerivativeOfMotion:
    """`d value/d x`, `value` being a function of the trajectory that starts from `begin(x)`: a scene and a
    start.
    """

    begin: Callable
    x: float
    ts: np.ndarray
    value: Callable[[jj.Trajectory], jax.Array]
    known: float
    scale: float | None = None
    rtol: float = 1e-10
    atol: float = 1e-10
    steps: int = 400
    skip: dict = field(default_factory=dict)
    naive_value: Callable | None = None  # (q_end, u_end) -> value; None: naive methods are not asked

    def cell(self, method: Method, tolerance: float) -> Outcome:
        """Outcome of one method."""
        why = self.skip.get(method.name, self.skip.get(method.group))
        if (
            why is not None
            or method.group in ("constraints", "elsewhere")
            or method.even_steps
            or method.name == "Radau IIA"
        ):
            return not_applicable(why or "asked of motions")
        x = jnp.asarray(self.x, jnp.result_type(float))
        if method.naive is not None:
            return self._by_naive(method, x, tolerance)
        options = method.options(self.begin(x)[0])
        if (
            method.reduction
        ):  # each by itself: reverse mode through the choice of one out of several has met NaN of the others
            options |= {
                "max_steps": FEWER_STEPS,
                "formulation": jj.Formulation("full", jj.reductions(self.begin(x)[0])[method.reduction]),
            }
        if method.name == "Kvaerno5":
            options |= {"max_steps": IMPLICIT_STEPS}
        options |= {
            "rtol": by_type(self.rtol, 1e-5),
            "atol": by_type(self.atol, 1e-6),
            "ts": self.ts,
            "retry": True,
        }

        def value(x):
            scene, start = self.begin(x)
            if method.batch:
                lanes = {name: jnp.stack([jnp.asarray(v, x.dtype)] * 2) for name, v in start.items()}
                motion = jj.rollout(scene, lanes, **options).lane(1)
            else:
                motion = jj.simulate(scene, start, **options)
            return self.value(motion), motion.result

        forward = method.name == "forward mode"
        try:
            with warnings.catch_warnings(record=True) as given:
                warnings.simplefilter("always")
                if forward:
                    _, slope, code = jax.jvp(value, (x,), (jnp.ones_like(x),), has_aux=True)
                else:
                    slope, code = jax.grad(value, has_aux=True)(x)
        except (ValueError, jj.DifferentiationModeError) as refusal:
            return judged(np.nan, tolerance, f"{type(refusal).__name__}: {str(refusal)[:90]}")
        if int(code) not in (result_codes.SUCCESS, result_codes.EVENT):
            return judged(
                np.nan,
                tolerance,
                result_codes.MESSAGES[int(code)],
                stalled=int(code) == result_codes.MAX_STEPS,
            )
        found = judged(worst(float(slope), self.known, self.scale), tolerance)
        said = [
            str(warning.message) for warning in given if issubclass(warning.category, jj.SensitivityWarning)
        ]
        return (
            found
            if found.outcome == "right" or not said
            else judged(worst(float(slope), self.known, self.scale), tolerance, f"warning: {said[0]}")
        )

    def _by_naive(self, method: Method, x, tolerance: float) -> Outcome:
        if self.naive_value is None or method.naive in naive.REDUCED_STATE:
            return not_applicable(
                "fixed steps find no event" if self.naive_value is None else "asked of motions"
            )
        scene, start = self.begin(x)
        state = jj.start(scene, **start)
        static = naive.fixed_point(scene, state.q, state.u)

        def value(x):
            scene, start = self.begin(x)
            state = jj.start(scene, **start)
            qs, us = naive.motion(
                method.naive, scene, static, state.q, state.u, self.ts, self.steps, alone=True
            )
            return self.naive_value(qs[-1], us[-1])

        try:
            slope = jax.jvp(value, (x,), (jnp.ones_like(x),))[1]
        except NotImplementedError as refusal:
            return judged(np.nan, tolerance, f"NotImplementedError: {str(refusal).splitlines()[0][:90]}")
        return judged(worst(float(slope), self.known, self.scale), tolerance)
