"""Reading what others wrote (`calculus/reading.py`): numbers, files and nesting, each refused with its source where it is not what it should be."""

import json
import math
import os

import pytest

from jourdain_jax.calculus.reading import DEEPEST, check_depth, number, parsed, read_bytes, read_text, whole_number

DIGITS = "0123456789"


@pytest.mark.parametrize("text", ["1", "+1.", "-.5e3", "12.25E-2", " 3\n", "007", "1e-400", "5e-324"])
def test_numbers_are_those_of_python(text):
    assert number(text, "x") == float(text)


NO_NUMBERS = ["", " ", "1_0", "1_0.5", "0x10", "1,5", "1 2", "1e", "e5", ".", "+-1", "1.2.3", "True", "1j", "1\u00a0", "1\x00", "½"]


@pytest.mark.parametrize("text", [*NO_NUMBERS, "1" * 90 + "x"])
def test_what_is_no_number_is_refused_with_its_source(text):
    with pytest.raises(ValueError, match=r"robot.urdf, line 3: mass is `.*`, expected a number") as error:
        number(text, "robot.urdf, line 3: mass")
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("zero", [0x0660, 0x06F0, 0x0966, 0xFF10, 0x1D7CE])
def test_digits_of_other_scripts_are_no_numbers(zero):
    text = DIGITS.translate({ord(digit): chr(zero + k) for k, digit in enumerate(DIGITS)})
    assert float(text) == 123456789.0
    for written in (text, f"1{text[3]}", f"0.{text[1]}", f"1e{text[2]}"):
        with pytest.raises(ValueError, match="expected a number"):
            number(written, "x")
    with pytest.raises(ValueError, match="expected a whole number"):
        whole_number(text, "x", 0, 10**12)


@pytest.mark.parametrize("text", ["inf", "-Infinity", "nan", "1e999"])
def test_numbers_that_are_not_finite_are_taken_where_it_is_said(text):
    with pytest.raises(ValueError, match="expected a finite number"):
        number(text, "x")
    assert not math.isfinite(number(text, "x", finite=False))


def test_whole_numbers_have_a_range():
    assert whole_number(" 12 ", "x", 1, 12) == 12
    for text in ("0", "13", "1.0", "1e1", "1_0", "", "9" * 10_000):
        with pytest.raises(ValueError, match=r"x is `.*`, expected a whole number from 1 to 12"):
            whole_number(text, "x", 1, 12)


def test_files_that_cannot_be_read_are_named(tmp_path):
    (tmp_path / "robot.urdf").write_bytes(b"a" * 10)
    (tmp_path / "binary").write_bytes(b"a\0b")
    (tmp_path / "latin").write_bytes("ä".encode("latin-1"))
    assert read_bytes(tmp_path / "robot.urdf", 10) == b"a" * 10
    said = {
        tmp_path / "robot.urd": r"robot.urd: cannot be read .*; give the path of a URDF file. Did you mean `robot.urdf`",
        tmp_path: "cannot be read",
        tmp_path / ("x" * 10_000): r"cannot be read \(File name too long\)",
        f"{tmp_path}\0": "cannot be read",
        tmp_path / "robot.urdf" / "x": "cannot be read",
        tmp_path / "binary": "binary: a binary file",
        tmp_path / "latin": "latin: not UTF-8 text",
    }
    for path, words in said.items():
        with pytest.raises(ValueError, match=words) as error:
            read_text(path, 100, "a URDF file")
        assert len(str(error.value)) < 500
    with pytest.raises(ValueError, match=r"robot.urdf: larger than 9 bytes, expected a URDF file"):
        read_text(tmp_path / "robot.urdf", 9, "a URDF file")
    if os.path.exists("/dev/zero"):
        with pytest.raises(ValueError, match="larger than 5 bytes"):
            read_bytes("/dev/zero", 5)


def _inner(found):
    return found if isinstance(found, list) else ()


def test_nesting_has_one_limit():
    for depth in (1, DEEPEST):
        check_depth(parsed(json.loads, "[" * depth + "]" * depth, "a.json", "JSON"), _inner, "a.json")
    for depth in (DEEPEST + 1, 5_000, 100_000):
        with pytest.raises(ValueError, match=rf"a.json: nested more than {DEEPEST} levels deep"):
            check_depth(parsed(json.loads, "[" * depth + "]" * depth, "a.json", "JSON"), _inner, "a.json")
    with pytest.raises(ValueError, match=r"a.json: is no JSON \(Expecting value"):
        parsed(json.loads, "[1, ?]", "a.json", "JSON")
