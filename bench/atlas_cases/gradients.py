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
    value: Callable
    known: float
    scale: float | None = None
    rtol: float = 1e-10
    atol: float = 1e-10
    steps: int = 400
    skip: dict = field(default_factory=dict)
    naive_value: Callable | None = None  # (q_end, u_end) -> value; None: naive methods are not asked

    def cell(self, method: Method, tolerance) -> Outcome:
        """Outcome of one method."""
        why = self.skip.get(method.name, self.skip.get(method.group))
        of_motions = method.group in ("constraints", "elsewhere") or method.name == "Radau IIA"
        if why is not None or of_motions or method.even_steps:
            return not_applicable(why or "asked of motions")
        x = jnp.asarray(self.x, float)
        if method.naive is not None:
            return self._by_naive(method, x, tolerance)
        scene = self.begin(x)[0]
        options = method.options(scene) | {"ts": self.ts, "retry": True}
        options |= {"rtol": by_type(self.rtol, 1e-5), "atol": by_type(self.atol, 1e-6)}
        # each by itself: reverse mode through the choice of one out of several has met NaN of the others
        if method.reduction:
            full = jj.Formulation("full", jj.reductions(scene)[method.reduction])
            options |= {"max_steps": FEWER_STEPS, "formulation": full}
        if method.name == "Kvaerno5":
            options |= {"max_steps": IMPLICIT_STEPS}

        def value(x):
            scene, start = self.begin(x)
            if method.batch:
                lanes = {name: jnp.stack([jnp.asarray(v, x.dtype)] * 2) for name, v in start.items()}
                motion = jj.rollout(scene, lanes, **options).lane(1)
            else:
                motion = jj.simulate(scene, start, **options)
            return self.value(motion), motion.result

        try:
            with warnings.catch_warnings(record=True) as given:
                warnings.simplefilter("always")
                if method.name == "forward mode":
                    _, slope, code = jax.jvp(value, (x,), (jnp.ones_like(x),), has_aux=True)
                else:
                    slope, code = jax.grad(value, has_aux=True)(x)
        except (ValueError, jj.DifferentiationModeError) as refusal:
            return judged(np.nan, tolerance, f"{type(refusal).__name__}: {str(refusal)[:90]}")
        code = int(code)
        if code not in (result_codes.SUCCESS, result_codes.EVENT):
            said = result_codes.MESSAGES[code]
            return judged(np.nan, tolerance, said, stalled=code == result_codes.MAX_STEPS)
        error = worst(slope, self.known, self.scale)
        said = [f"warning: {w.message}" for w in given if issubclass(w.category, jj.SensitivityWarning)]
        return judged(error, tolerance, "" if error <= tolerance else "".join(said[:1]))

    def _by_naive(self, method: Method, x, tolerance) -> Outcome:
        if self.naive_value is None:
            return not_applicable("fixed steps find no event")
        if method.naive in naive.REDUCED_STATE:
            return not_applicable("asked of motions")
        scene, start = self.begin(x)
        state = jj.start(scene, **start)
        static = naive.fixed_point(scene, state.q, state.u)

        def value(x):
            scene, start = self.begin(x)
            state = jj.start(scene, **start)
            asked = (method.naive, scene, static, state.q, state.u, self.ts, self.steps)
            qs, us = naive.motion(*asked, alone=True)
            return self.naive_value(qs[-1], us[-1])

        try:
            slope = jax.jvp(value, (x,), (jnp.ones_like(x),))[1]
        except NotImplementedError as refusal:
            return judged(np.nan, tolerance, f"NotImplementedError: {str(refusal).splitlines()[0][:90]}")
        return judged(worst(slope, self.known, self.scale), tolerance)
