"""The search for motions that are wrong in silence: its references and its judge, and a short set of its cases."""

from types import SimpleNamespace

import numpy as np
import pytest
import result_codes as results
from hunting import judging, linkages, oscillators
from hunting.families import FAMILIES, family
from hunting.family import Ask, Family, Truth, together
from hunting.record import BY_CODE, BY_WARNING, LOST, REFUSED, RIGHT, UNDECIDED, WRONG, refusal
from hunting.reference import integrate
from hunting.table import as_markdown, figures, losses
from numpy.testing import assert_allclose

import jourdain_jax as jj

# Family and seeds, each wrong or flagged at some time; seeds that differ by the number of a family's ways ask alike, and share a program.
SHORT = (
    ("antiparallelogram", (0, 7, 14)),
    ("rod-pendulum", (3, 10, 17, 24)),
    ("room", (5, 12, 19)),
    ("grazing", (0, 7, 14)),
    ("stop-arcsine", (0, 7)),
    ("stiff-drop", (0,)),
    ("hammer", (1, 7)),
    ("far-times", (13, 19)),
    ("times", (5,)),
    ("kite", (1, 26)),
    ("changed", (0, 3, 17)),
    ("strip", (0, 2)),
    ("window", (0, 2)),
    ("turned-speed", (5,)),
    ("outside", (0, 1)),
    ("robot-files", tuple(range(17))),
)


SLOW = ("antiparallelogram", "kite", "rod-pendulum")  # closed linkages pass through flat positions also in `test_between_saved_times.py`


@pytest.mark.parametrize(("name", "seeds"), [pytest.param(*each, marks=[pytest.mark.slow] * (each[0] in SLOW), id=each[0]) for each in SHORT])
def test_no_generated_motion_is_wrong_in_silence(name, seeds):
    records = [record.as_dict() for record in family(name).run(list(seeds))]
    assert len(records) == len(seeds)
    assert not list(losses(records)), "\n".join(losses(records))


def test_every_family_has_a_name_of_its_own_and_cases_come_from_their_seeds_alone():
    assert len({f.name for f in FAMILIES}) == len(FAMILIES)
    assert sum(f.cases for f in FAMILIES) >= 2500
    for f in FAMILIES:
        if isinstance(f, Family):
            assert f.numbers(11) == f.numbers(11)


def test_the_reference_of_an_oscillator_is_its_closed_form():
    w, ts = np.array([1.0, 7.0, 50.0]), np.linspace(0.5, 3.0, 4) * np.ones((3, 1))
    rates = lambda _, y: np.stack([y[:, 1], -(w**2) * y[:, 0]], axis=1)  # noqa: E731
    y = integrate(rates, np.stack([np.ones(3), np.zeros(3)], axis=1), ts)
    assert_allclose(y[..., 0], np.cos(w[:, None] * ts), atol=1e-9)


def test_a_motion_that_ends_in_finite_time_has_no_reference_and_does_not_spoil_its_neighbours():
    rates = lambda _, y: np.stack([y[:, 0] ** 2, -y[:, 1]], axis=1)  # noqa: E731
    y = integrate(rates, np.array([[0.1, 1.0], [2.0, 1.0]]), np.array([[0.4, 1.0]] * 2))
    assert np.all(np.isnan(y[1, -1]))
    assert_allclose(y[0], [[0.1 / 0.96, np.exp(-0.4)], [0.1 / 0.9, np.exp(-1.0)]], rtol=1e-10)


BRANCHES = {"parallel": (linkages.parallelogram, linkages.antiparallelogram), "kite": (linkages.kite, linkages.folded_kite)}


@pytest.mark.parametrize(("kind", "branch"), [(kind, branch) for kind, both in BRANCHES.items() for branch in both])
def test_branches_close_their_loop_and_conserve_energy(kind, branch):
    draw = linkages._drawn(kind)
    n = together([draw(np.random.default_rng(seed)) for seed in range(6)])
    truth = linkages.on_branch(branch)(n, np.linspace(0.2, 2.0, 5) * np.ones((6, 1)))
    (a, b, c), speeds = np.moveaxis(truth.values[..., :3], -1, 0), np.moveaxis(truth.values[..., 3:], -1, 0)
    n = {name: value[:, None] for name, value in n.items()}
    closed = n["r1"] * np.exp(1j * a) + n["r2"] * np.exp(1j * b) - n["d"] - n["r3"] * np.exp(1j * c)
    assert_allclose(np.abs(closed), 0.0, atol=1e-13)
    energy = linkages._twice_kinetic(n, (a, b, c), speeds) / 2 + linkages._potential(n, (a, b, c))
    assert_allclose(energy - energy[:, :1], 0.0, atol=1e-9 * np.max(np.abs(energy)))


def _motion(x, code=results.SUCCESS, warned=()):
    end = np.array([x])
    return SimpleNamespace(result=code, q=end[None], q_end=end, u=end[None], u_end=end, t_end=1.0, accepted=20, event=-1, event_names=(), warnings=warned)


OSCILLATOR = Family(name="plain", what="", scene=oscillators.Oscillator, draw=dict, start=dict, truth=lambda n, ts: None, names=("x",))


@pytest.mark.parametrize(
    ("motion", "outcome"),
    [
        (_motion(1.0), RIGHT),
        (_motion(1.0 + 1e-8), RIGHT),
        (_motion(1.1), WRONG),
        (_motion(np.nan), WRONG),
        (_motion(1.1, results.MAX_STEPS), BY_CODE),
        (_motion(1.0, results.EVENT), WRONG),
    ],
)
def test_a_motion_is_right_or_flagged_or_wrong(motion, outcome):
    truth, growth = Truth(np.ones((1, 1, 1))), np.zeros((1, 2, 2))
    found = judging._judged(OSCILLATOR, Ask("simulate"), motion, 0, [{"span": 1.0}], truth, growth, single=False)
    assert found[0] == outcome


def test_without_a_reference_nothing_is_called_right():
    truth, growth = Truth(np.full((1, 1, 1), np.nan)), np.zeros((1, 2, 2))
    assert judging._judged(OSCILLATOR, Ask("simulate"), _motion(1.0), 0, [{"span": 1.0}], truth, growth, single=False)[0] == UNDECIDED


def test_an_error_of_the_engine_refuses_and_a_raw_one_crashes():
    def of(call):
        try:
            call()
        except Exception as error:
            return refusal(error)[0]

    assert of(lambda: jj.simulate(oscillators.Oscillator(), {"y": 1.0})) == REFUSED
    assert of(lambda: np.zeros(2) + np.zeros(3)) in LOST


def test_the_table_and_the_figures_count_what_was_found():
    made = [
        {"family": "room", "seed": k, "dtype": "float64", "asked": "", "outcome": o, "error": None, "said": "", "seconds": 1.0}
        for k, o in enumerate((RIGHT, WRONG, BY_WARNING))
    ]
    table = list(as_markdown(made))
    assert any(line.startswith("| room | several events") and "| 3 | 1 |" in line for line in table)
    lost = next(f for f in figures(made, 3.0) if f["model"] == "room")
    assert (lost["value"], lost["required"], lost["met"]) == (1, 0, False)
    assert "--only room --seed 1" in next(iter(losses(made)))
