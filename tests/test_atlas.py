"""The atlas of hard cases: the engine as it comes is right in those that name it, and the script writes what it documents."""

import pytest
from atlas_cases.cases import CASES
from atlas_cases.mechanisms import BY_CASE, USUAL
from atlas_cases.methods import GROUPS, METHODS
from atlas_cases.outcomes import FLAGGED, NAN, RIGHT, WRONG, judged
from atlas_cases.tables import BEGIN, END, write_tables

BY_NAME = {case.name: case for case in CASES}
DEFAULT = next(method for method in METHODS if method.name == "default")
REQUIRED = ("E1", "E2", "E5", "E7", "E9 short", "E12", "E13", "E18", "E21", "E22")  # the ten, two of them for a shorter time
LONGER = [case.name for case in CASES if case.must_be_right and case.name not in REQUIRED]
KEYS = ["case", "method", "dtype", "outcome", "error", "tolerance", "mechanism"]


@pytest.mark.parametrize("name", REQUIRED)
def test_the_engine_as_it_comes_is_right_where_other_methods_fail(name):
    case = BY_NAME[name]
    found = case.probe().cell(DEFAULT, case.tolerance)
    assert found.outcome == RIGHT, found


@pytest.mark.slow
@pytest.mark.parametrize("name", LONGER)
def test_the_engine_as_it_comes_is_right_in_the_longer_cases(name):
    case = BY_NAME[name]
    found = case.probe().cell(DEFAULT, case.tolerance)
    assert found.outcome == RIGHT, found


@pytest.mark.parametrize("name", ["E6", "E24"])
def test_what_has_no_answer_is_flagged(name):
    case = BY_NAME[name]
    found = case.probe().cell(DEFAULT, case.tolerance)
    assert found.outcome == FLAGGED, found
    assert found.flag


def test_every_row_of_the_table_of_hard_cases_is_there_once():
    rows = {int(case.name[1:].split()[0]) for case in CASES}
    assert rows == set(range(1, 37))
    assert len(BY_NAME) == len(CASES)
    assert len({method.name for method in METHODS}) == len(METHODS)


def test_every_method_has_a_reason_to_fail_in_one_line():
    for method in METHODS:
        assert USUAL[method.name], method.name
        assert "\n" not in USUAL[method.name]


def test_reasons_are_given_for_cases_and_methods_that_exist():
    numbers = {name.split()[0] for name in BY_NAME}
    for name, reasons in BY_CASE.items():
        assert name in BY_NAME or name in numbers
        assert set(reasons) <= {*USUAL, *GROUPS}


def test_tables_replace_only_what_was_written_before(tmp_path):
    def cell(method, dtype, outcome, error, mechanism=""):
        return dict(zip(KEYS, ("E1", method, dtype, outcome, error, 1e-10, mechanism), strict=True))

    cells = [cell("default", "float64", RIGHT, 3e-13), cell("default", "float32", RIGHT, 2e-11)]
    cells += [
        cell("fixed partition", "float64", WRONG, 0.5, "division by zero"),
        cell("fixed partition", "float32", FLAGGED, None, "division by zero [said so]"),
    ]
    page = tmp_path / "atlas.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n", encoding="utf-8")
    write_tables(cells, tmp_path)
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    assert "| fixed partition | 1 |  |  | 1 |  |  | 1 |  | 1 |  |  |  |" in text
    assert "| 1e-10 | right, 3e-13 | 0 / 0 / 1 / 0 / 0 | 1e-10 | right, 2e-11 | 0 / 1 / 0 / 0 / 0 |" in text
    assert "| division by zero | fixed partition | E1 |" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["E17 1000", "E17 1e+06", "E17 1e+08"])
def test_stiff_contacts_are_right_for_the_engine_as_it_comes(name):
    case = BY_NAME[name]
    found = case.probe().cell(DEFAULT, case.tolerance)
    assert found.outcome == RIGHT, found


@pytest.mark.slow
def test_a_derivative_takes_the_steps_of_its_motion():
    """Integrated again between checkpoints, the rattleback took other steps: off by 6e-4 at rtol 1e-11, in float64."""
    case = BY_NAME["E19 gradient 2 s"]
    found = case.probe().cell(DEFAULT, case.tolerance)
    assert found.outcome == RIGHT, found


def test_outcomes_are_decided_by_the_error_and_by_what_a_method_says():
    assert judged(1e-12, 1e-10).outcome == RIGHT
    assert judged(1e-9, 1e-10).outcome == WRONG
    assert judged(float("nan"), 1e-10).outcome == NAN
    assert judged(float("nan"), 1e-10, "rank 1 of 2 rows").outcome == FLAGGED
    assert judged(0.0, 1e-10, "out of steps", stalled=True).outcome == "stalled"
