"""The probe of a motion: integrate to some end, compare with a closed form, a reference or integrals of the
motion.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from atlas_cases import elsewhere, naive
from atlas_cases.case import by_type, single
from atlas_cases.methods import EVEN_STEPS, Method
from atlas_cases.outcomes import NAN, RIGHT, Outcome, judged, not_applicable, worst
from jourdain_jax.equations import constraint_rows
from jourdain_jax.integrate import result_codes

# Methods that take long and show something in some cases only.
SELDOM = {
    "rollout": "a batch is one more program; asked in a dozen cases",
    "Kvaerno5": "implicit; asked where a motion is stiff or long",
    "Radau IIA": "implicit; asked where a motion is stiff or long",
    "Baumgarte 1e4/s": "its steps are bound to 1e-4 s; asked in E9 and E10",
}


@dataclass
class Motion:
    """A start, times, and the error of states at these times (the first is the start)."""

    scene: jj.Scene
    start: object  # dict or State
    ts: np.ndarray
    error: Callable  # q (times, n), u (times, m) -> error
    rtol: float = 1e-12
    atol: float = 1e-12
    rtol32: float = 1e-5
    steps: int = 400  # of the naive methods, between two times
    # of reductions on the full state (float32: 5,000, constraints too), a hundred times as slow per step as
    # the default
    most_steps: int = 20_000
    independent: tuple[str, ...] | None = (
        None  # speeds that the fixed partition keeps; None: the best at the start
    )
    options: dict = field(default_factory=dict)  # of `simulate`, part of the set-up
    skip: dict = field(default_factory=dict)  # method or group -> why it is not asked
    asked: tuple[str, ...] = ()  # costly methods, `SELDOM`, that are asked here
    step: float | None = None  # s, of integrators that take steps of one length; None: they are not asked
    naive_start: tuple | None = None  # (q, u) for methods that do not project a start
    by_mujoco: Callable | None = None  # the case as a model of another engine

    def cell(self, method: Method, tolerance) -> Outcome:
        """Outcome of one method."""
        if method.elsewhere:
            return self._elsewhere(tolerance)
        why = self.skip.get(method.name, self.skip.get(method.group))
        if method.name in SELDOM and method.name not in self.asked:
            why = SELDOM[method.name]
        if method.even_steps and self.step is None:
            why = "steps of one length and second order; asked where a motion is long, stiff or turns"
        if why is not None or method.group == "adjoints":
            return not_applicable(why or "no derivative is asked")
        if method.naive is not None:
            return self._by_naive(method, tolerance)
        try:
            motion = self._rollout() if method.batch else self._simulate(method)
        except ValueError as refusal:
            if "does not apply to" in str(refusal):
                return not_applicable(str(refusal).splitlines()[0])
            raise
        return self.of_trajectory(motion, tolerance)

    @property
    def tolerances(self):
        """rtol and atol of this process's floats."""
        return {"rtol": by_type(self.rtol, self.rtol32), "atol": by_type(self.atol, 1e-6)}

    @property
    def state(self) -> jj.State:
        """The start."""
        return self.start if isinstance(self.start, jj.State) else jj.start(self.scene, **self.start)

    def _simulate(self, method: Method):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            steps = {"solver": EVEN_STEPS[method.name](step=self.step)} if method.even_steps else {}
            if method.reduction or (single() and method.group == "constraints" and method.name not in SELDOM):
                steps["max_steps"] = by_type(self.most_steps, 5_000)
            options = self.tolerances | self.options | method.options(self.scene) | steps
            return jj.simulate(self.scene, self.start, ts=self.ts, retry=True, **options)

    def _rollout(self):
        """Two equal lanes of a batch; the second one."""
        lanes = jax.tree.map(lambda x: jnp.stack([x, x]), self.state)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return jj.rollout(
                self.scene, lanes, ts=self.ts, retry=True, **self.tolerances, **self.options
            ).lane(1)

    def of_trajectory(self, motion: jj.Trajectory, tolerance) -> Outcome:
        """Outcome of a trajectory: its result code, its numbers, and what its summary warns of."""
        code = int(motion.result)
        if code != result_codes.SUCCESS:
            said = f"{motion.message} (t = {float(motion.t_end):.3g} s)"
            return judged(np.nan, tolerance, said, stalled=code == result_codes.MAX_STEPS)
        error = self.error(np.asarray(motion.q, float), np.asarray(motion.u, float))
        found = judged(error, tolerance)
        return found if found.outcome == RIGHT else judged(error, tolerance, "; ".join(motion.warnings))

    def _elsewhere(self, tolerance) -> Outcome:
        if self.by_mujoco is None:
            return not_applicable("its model of the case would be another one")
        if elsewhere.mujoco is None:
            return not_applicable(elsewhere.MISSING)
        if single():
            return not_applicable("it computes in double precision")
        with np.errstate(all="ignore"):
            states = self.by_mujoco().run(self.ts, float(self.options.get("t0", 0.0)))
            return self._by_error(*states, tolerance)

    def _by_naive(self, method: Method, tolerance) -> Outcome:
        state = self.state
        q, u = (state.q, state.u) if self.naive_start is None else map(jnp.asarray, self.naive_start)
        rows = constraint_rows(self.scene, 0.0, q, u)
        if method.naive in naive.REDUCED_STATE and (
            not jj.structure_of(self.scene).affine or rows.A.shape[0] == 0
        ):
            return not_applicable("no rows that are linear in the speeds")
        static = naive.fixed_point(self.scene, q, u, independent=self.independent)
        qs, us = naive.motion(method.naive, self.scene, static, q, u, self.ts, self.steps)
        return self._by_error(qs, us, tolerance)

    def _by_error(self, qs, us, tolerance) -> Outcome:
        qs, us = np.asarray(qs, float), np.asarray(us, float)
        if not (np.all(np.isfinite(qs)) and np.all(np.isfinite(us))):
            return Outcome(NAN)
        return judged(self.error(qs, us), tolerance)


def against(scene: jj.Scene, expected, scales=None):
    """Error against named coordinates and speeds at all times, each relative to its own size (or its entry in
    `scales`).
    """
    names = (*scene.coordinate_names.entries, *scene.speed_names.entries)

    def error(q, u):
        found = dict(zip(names, (*q.T, *u.T), strict=True))
        return max_error(worst(found[name], x, (scales or {}).get(name)) for name, x in expected.items())

    return error


def followed(scene: jj.Scene, start, ts, known, names, scales=None, **more) -> Motion:
    """A motion whose coordinates an oracle knows; `names`: of ours, "ours=theirs" where the oracle calls it
    otherwise.
    """
    pairs = [name.split("=") for name in names.split()]
    return Motion(
        scene, start, ts, against(scene, {pair[0]: known[pair[-1]] for pair in pairs}, scales), **more
    )


def drift(*integrals, size=None):
    """Error as the largest change of integrals of the motion, relative to their start or to `size`."""

    def error(q, u):
        values = [integral(q, u) for integral in integrals]
        return max_error(worst(value - value[0], 0.0, size or max(abs(value[0]), 1e-300)) for value in values)

    return error


def max_error(errors):
    """The largest; NaN where one is."""
    errors = list(errors)
    return float("nan") if any(np.isnan(e) for e in errors) else max(errors)
