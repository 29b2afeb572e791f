"""The work-precision charts: what a record holds, how an error is judged, and what is said of peers that are
not installed.
"""

import json

import disc_body
import numpy as np
import pytest
from oracles import chaplygin_sleigh
from refusals import refused
from tolerances import CLOSED_FORM, ROUND_OFF

pytest.importorskip("work_precision_cases", reason="the scripts of `bench/` are not here")
from work_precision_cases import curve, measure, peer_exudyn, peer_heyoka, peer_mujoco, peer_sympy, record
from work_precision_cases.problems import PROBLEMS

SLEIGH, DISC = PROBLEMS["chaplygin-sleigh"], PROBLEMS["tilting-disc"]


def _exact_sleigh():
    run = {name: value for name, value in chaplygin_sleigh.RUN.items() if name != "t_end"}
    found = chaplygin_sleigh.motion([0.0, SLEIGH.end], **run)
    x, y, th, v, w = (found[name][-1] for name in ("x", "y", "th", "v", "w"))
    c, s, a = np.cos(th), np.sin(th), run["a"]
    return np.array([x, y, th]), np.array([v * c - a * w * s, v * s + a * w * c, w])


def _constant(y):
    return lambda problem: curve.Prepared(lambda setting: y, lambda raw: curve.Solved(y=raw, steps=1.0))


def test_the_error_of_the_sleigh_is_its_distance_from_the_closed_form():
    q, u = _exact_sleigh()
    assert SLEIGH.error(q, u) <= CLOSED_FORM
    assert abs(SLEIGH.error(q + np.array([0.0, 0.0, 3e-4]), u) - 3e-4) <= CLOSED_FORM
    assert np.isnan(SLEIGH.error(q * np.nan, u))


def test_the_reference_says_how_far_a_second_computation_is():
    reference = SLEIGH.truth
    assert 0 < reference.uncertainty <= 1e-12
    assert reference.how
    assert reference.against


def test_a_curve_gives_records_of_one_format():
    q, u = _exact_sleigh()
    exact = curve.Curve("exact", (1e-3,), _constant(np.concatenate([q, u[:2]])))
    (entry,), ready = measure.points(SLEIGH, exact, lambda text: None)
    assert tuple(entry) == record.KEYS
    assert entry == json.loads(json.dumps(entry))
    assert entry["error"] <= CLOSED_FORM
    assert entry["seconds"] > 0
    assert entry["versions"]["python"]
    assert ready is not None


def test_a_run_that_is_not_finite_or_says_that_it_failed_has_no_error():
    y = np.full(5, np.nan)
    (entry,), _ = measure.points(SLEIGH, curve.Curve("lost", (1.0,), _constant(y)), lambda text: None)
    assert entry["error"] is None
    failed = lambda problem: curve.Prepared(
        lambda setting: None, lambda raw: curve.Solved(failed="out of steps")
    )
    (entry,), _ = measure.points(SLEIGH, curve.Curve("failed", (1.0,), failed), lambda text: None)
    assert entry["error"] is None
    assert entry["note"] == "out of steps"


def test_a_record_of_an_unknown_kind_is_refused():
    refused("`kind` is 'theirs'", record.record, **dict.fromkeys(record.KEYS) | {"kind": "theirs"})


@pytest.mark.parametrize(
    ("module", "missing", "word"),
    [
        (peer_mujoco, "mujoco", "pip install mujoco"),
        (peer_exudyn, "exudyn", "pip install exudyn"),
        (peer_sympy, "scipy", "pip install sympy scipy"),
        (peer_heyoka, "heyoka", "pip install heyoka"),
    ],
)
def test_peers_that_are_not_installed_are_skipped_with_a_message(monkeypatch, module, missing, word):
    monkeypatch.setattr(module, missing, None)
    said = []
    for asked in module.curves(DISC) if module is peer_heyoka else module.curves(DISC, True):
        found, ready = measure.points(DISC, asked, said.append)
        assert found == []
        assert ready is None
    assert said
    assert all("not measured" in text and word in text for text in said)


def test_a_free_body_is_read_as_the_disc_that_it_is():
    # as contact engines hold it: centre, rotation, velocities in space; back to the contact point, yaw, lean
    # and spin
    radius = float(DISC.scene.radius)
    q, u = disc_body.state(radius, disc_body.start(radius, DISC.minimal_start), {"yaw": 0.0, "spin": 0.0})
    assert np.max(np.abs(q - DISC.state.q)) <= ROUND_OFF
    assert np.max(np.abs(u - DISC.state.u)) <= ROUND_OFF


def test_sympys_equations_of_the_sleigh_compiled_from_c_are_chaplygins():
    if peer_sympy.kane.sp is None:
        pytest.skip(peer_sympy.MISSING)
    equations = peer_sympy.kane.SCENES["chaplygin-sleigh"](SLEIGH.scene)
    minimal = SLEIGH.minimal_start
    assert np.max(np.abs(equations.to_minimal(equations.from_minimal(minimal)) - minimal)) <= ROUND_OFF
    try:
        library = peer_sympy.compiled(peer_sympy.c_source(equations))
    except curve.NotApplicable as reason:
        pytest.skip(str(reason))
    rates = peer_sympy.callback(library, 5)
    y = equations.from_minimal(minimal)
    scene, (_, _, heading, v, w), a = SLEIGH.scene, y, float(SLEIGH.scene.offset)
    # v' = a w^2, w' = -(a/k^2) v w
    k_squared = float(scene.inertia / scene.mass) + a**2
    expected = [
        v * np.cos(heading) - a * w * np.sin(heading),
        v * np.sin(heading) + a * w * np.cos(heading),
        w,
        a * w**2,
        -a / k_squared * v * w,
    ]
    assert np.max(np.abs(rates(0.0, y) - expected)) <= ROUND_OFF


def test_times_are_those_of_warm_runs():
    calls = []
    seconds = measure.fastest(lambda: calls.append(0), seconds=0.01)
    assert 2 <= len(calls) <= measure.MOST_REPEATS
    assert 0 < seconds < 0.01
