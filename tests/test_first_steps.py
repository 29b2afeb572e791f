"""The steps that the program of a run, or of several with known starts, takes by itself are those that `minimise` takes, evaluation by evaluation."""

import numpy as np
import pytest
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.analysis import problem


def _run(damping=0.3) -> jj.Experiment:
    ts, generator = np.linspace(0.0, 6.0, 61), np.random.default_rng(3)
    x = np.asarray(jj.simulate(Oscillator(damping=damping), {"x": 0.5, "x_rate": 0.2}, ts=ts)["x"])
    x = x + 0.01 * generator.normal(size=61)
    x[7] = np.nan
    return jj.Experiment(ts, {"x": x}, 0.01, start={"x": 0.45, "x_rate": 0.1}, unknown_start=("x", "x_rate"))


def _of_three_lengths() -> list[jj.Experiment]:
    whole = _run()
    start = {"x": 0.5, "x_rate": 0.2}
    return [jj.Experiment(whole.ts[:count], {"x": whole.values["x"][:count]}, 0.01, start=start) for count in (61, 30, 45)]


def _with_an_outlier() -> jj.Experiment:
    run = _run()
    return jj.Experiment(run.ts, {"x": np.where(np.arange(61) == 20, 1.0, run.values["x"])}, 0.01, start=run.start, unknown_start=("x", "x_rate"))


CASES = {
    "near": (Oscillator(stiffness=5.5), _run(), ("damping", "stiffness")),
    "far, over growing spans": (Oscillator(stiffness=45.0, damping=2.0), _run(), ("damping", "stiffness")),
    "at a bound": (Oscillator(stiffness=5.5), _run(), {"damping": jj.bounds(0.29, 0.5), "stiffness": jj.bounds(4.0, 5.8)}),
    "past a bound": (Oscillator(damping=0.05), _run(damping=0.0), ("damping", "stiffness")),
    "a prior": (Oscillator(stiffness=5.5), _run(), {"mass": jj.Normal(2.1, 0.05), "damping": None, "stiffness": None}),
    "what does not show": (Oscillator(stiffness=5.5), _run(), ("mass", "damping", "stiffness")),
    "three runs": (Oscillator(stiffness=5.5), _of_three_lengths(), ("damping", "stiffness")),
    "three runs, over growing spans": (Oscillator(stiffness=45.0, damping=2.0), _of_three_lengths(), ("damping", "stiffness")),
    "an outlier, Huber's loss": (Oscillator(stiffness=5.5), _with_an_outlier(), ("damping", "stiffness"), {"loss": jj.huber()}),
    "an outlier, Student's noise": (Oscillator(stiffness=5.5), _with_an_outlier(), ("damping", "stiffness"), {"loss": jj.student_t()}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_program_of_a_run_takes_the_steps_of_minimise(case, monkeypatch):
    scene, run, free, options = (*CASES[case], {})[:4]
    found = jj.fit(scene, run, free, **options)
    taken = []
    first_steps = problem.Problem._first_steps
    monkeypatch.setattr(problem.Problem, "_first_steps", lambda *given: taken.append(given) or first_steps(*given))
    jj.fit(scene, run, free, **options)
    assert taken
    monkeypatch.setattr(problem.Problem, "_first_steps", lambda *_: None)
    plain = jj.fit(scene, run, free, **options)

    assert plain.converged
    assert found.converged
    assert int(found.steps) == int(plain.steps)
    assert bool(found.grown) == bool(plain.grown)
    assert [(what, len(costs)) for what, costs in found.trace] == [(what, len(costs)) for what, costs in plain.trace]
    for (_, ours), (_, theirs) in zip(found.trace, plain.trace, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    np.testing.assert_allclose(found.values, plain.values, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(found.standard_errors, plain.standard_errors, rtol=1e-5)
    for ours, theirs in zip(found.residuals, plain.residuals, strict=True):
        np.testing.assert_allclose(ours["x"], theirs["x"], atol=1e-5)
    assert found.not_identifiable == plain.not_identifiable
