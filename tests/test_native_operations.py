"""Single operations by machine code against XLA, the functions of C and mpmath, also of numbers that are no
usual ones.
"""

import functools
from itertools import product

import evaluated_natively
import jax.numpy as jnp
import machine_code
import mpmath
import numpy as np
import pytest
from in_mpmath import TRUTHS, in_mpmath
from numpy.testing import assert_allclose, assert_array_equal

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.kernels import host
from jourdain_jax.kernels.math_functions import BY_POLYNOMIALS
from jourdain_jax.program import emit
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed

OF_NUMBERS = [name for name in TABLE if name not in (*TRUTHS, "select")]
TWO = [name for name in OF_NUMBERS if getattr(TABLE[name].value, "nin", 1) == 2]
ONE = [name for name in OF_NUMBERS if name not in TWO]
SPECIAL = [
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    2.5,
    -2.5,
    np.inf,
    -np.inf,
    np.nan,
    1e308,
    -1e308,
    1e-300,
    710.0,
    -745.2,
    3.5e5,
    1e6,
    1e22,
]


def _all_operations():
    graph = Graph()
    a, b = graph.input("a", True), graph.input("b", True)
    return graph, [graph.call(op, a) for op in ONE] + [graph.call(op, a, b) for op in TWO], [a, b]


def test_every_operation_of_the_table_is_there():
    assert {*TABLE} == {*emit.FUNCTIONS, "sin", "cos"}


def of_both(points):
    """Each operation with its values by machine code and by XLA."""
    graph, outputs, inputs = _all_operations()
    found = np.asarray(evaluated_natively.function(graph, outputs, inputs)(points))
    return zip(
        ONE + TWO,
        found.T,
        emit.run(graph, outputs, dict(zip(inputs, jnp.asarray(points.T), strict=True))),
        strict=True,
    )


def test_special_values_are_those_of_c_also_the_signs_of_zeros():
    graph, _, inputs = _all_operations()
    ops = [
        "pow",
        "atan2",
        *(op for op in (*BY_POLYNOMIALS, "sin") if op in ONE and op not in ("log", "acos", "exp2")),
    ]
    outputs = [graph.call(op, *inputs[: 1 if op in ONE else 2]) for op in ops]
    roots = [graph.call("pow", inputs[0], graph.const(y)) for y in (0.5, 1.5)]
    values = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        2.0,
        -3.0,
        0.5,
        1.5,
        -2.5,
        4e15 + 1,
        -4e15 - 1,
        1e300,
        1e-300,
        -1e-300,
        np.inf,
        -np.inf,
        np.nan,
    ]
    points = np.array([*product(values, values)])
    found = np.asarray(evaluated_natively.function(graph, [*outputs, *roots], inputs)(points))
    with np.errstate(all="ignore"):
        expected = [TABLE[op].value(*points[:, : 1 if op in ONE else 2].T) for op in ops]
        expected += [np.power(points[:, 0], np.full(len(points), y)) for y in (0.5, 1.5)]
        for op, ours, true in zip([*ops, "x^0.5", "x^1.5"], found.T, expected, strict=True):
            right = np.isclose(ours, true, rtol=1e-15, atol=2.0**-1022, equal_nan=True)
            right &= np.isnan(true) | (np.signbit(ours) == np.signbit(true))
            assert right.all(), (op, points[~right][0], ours[~right][0], true[~right][0])


def test_numbers_in_single_precision_give_what_they_give_by_xla():
    values = np.array([*SPECIAL[:10], 3.0, -3.0, 3e38, -3e38, 1e-30, 88.0, -103.0, 700.0, 3.5e5], np.float32)
    points = np.array([*product(values, values)])
    with np.errstate(over="ignore"):
        for op, ours, theirs in of_both(points):
            assert_allclose(
                ours.astype(np.float32), np.asarray(theirs, np.float32), rtol=1e-5, atol=2e-38, err_msg=op
            )


# on machines that do not round products and sums together, one after the other alone
either = pytest.mark.parametrize("fused", [True, False][not host.fuses() :])
GROWING = ("exp", "exp2", "expm1", "sinh", "cosh", "logistic")
OWN = ["sin", "cos", *BY_POLYNOMIALS]


@functools.cache
def _functions(fused):
    """Of points (x, y); for machines that round products and sums together, or for others."""
    graph = Graph()
    inputs = [graph.input("x", True), graph.input("y", True)]
    nodes = [graph.call(op, *inputs[: 1 if op in ONE else 2]) for op in OWN]
    return evaluated_natively.function(
        graph, [*nodes, graph.call("pow", inputs[0], graph.const(1.5))], inputs
    )


def _our_own(lanes, fused, x, y):
    """Values of our own functions by machine code of other machines."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "lanes", lambda: lanes)
        patch.setattr(host, "fuses", lambda: fused)
        found = np.asarray(_functions(fused)(np.stack([x, y], axis=1)))
    return dict(zip([*OWN, "x^1.5"], found.T, strict=True))


def _arguments(op):
    """Over the range in use, and near what a function does differently on either side."""
    random = np.random.default_rng(1)
    uniform = lambda low, high: random.uniform(low, high, 500)
    edges = np.array(
        [0.5, 1.0, 2**0.5, 0.5**0.5, 2**0.5 - 1, 2**0.5 + 1, np.log(2) / 2, 1.5 * np.log(2), -0.5]
    )
    spread, near_one = (
        random.normal(size=500) * 10.0 ** random.integers(-6, 6, size=500),
        1 - 10 ** uniform(-16, -1),
    )
    angles = np.concatenate(
        [
            random.normal(size=500) * 10.0 ** random.integers(-6, 20, size=500),
            uniform(-5e5, 5e5),
            np.arange(1, 200) * (np.pi / 2),
        ]
    )
    more = dict.fromkeys(("sin", "cos", "tan"), angles) | dict.fromkeys(GROWING, uniform(-700, 709))
    more |= {"asin": near_one, "acos": [*near_one, *-near_one], "log1p": -near_one}
    x = np.concatenate(
        [
            spread,
            uniform(-3, 3),
            10 ** uniform(-200, 200),
            *(edges * (1 + k * 2.0**-52) for k in range(-5, 6)),
            more.get(op, []),
        ]
    )
    y = np.resize(np.concatenate([uniform(-10, 10), spread, x[::-1]]), len(x))
    if op in ("pow", "x^1.5"):
        x = np.abs(x)
        y = np.where(np.abs(y * np.log(x)) < 700, y, 0.5)
    domain = {
        "log": x > 0,
        "log1p": x > -1,
        "asin": np.abs(x) <= 1,
        "acos": np.abs(x) <= 1,
        "x^1.5": (x < 1e200) & (x > 1e-180),
    }
    domain |= {"atan2": np.abs(x) > 1e-290 * np.abs(y)} | dict.fromkeys(GROWING, np.abs(x) < 709)
    domain |= {"acosh": x >= 1, "atanh": np.abs(x) < 1, "rem": (y != 0) & (np.abs(x) < 1e40 * np.abs(y))}
    inside = domain.get(op, np.isfinite(x))
    return x[inside], y[inside]


@either
@pytest.mark.parametrize("op", [*OWN, "x^1.5"])
def test_functions_of_our_own_are_right_to_the_last_digit(op, fused):
    x, y = _arguments(op)
    found = _our_own(host.lanes(), fused, x, y)[op]
    function = (lambda x: mpmath.sqrt(x) * x) if op == "x^1.5" else in_mpmath(op)
    with mpmath.workdps(60):
        arguments = (map(mpmath.mpf, z.tolist()) for z in ((x, y) if op in TWO else (x,)))
        errors = [
            float(abs(mpmath.mpf(y) - e)) / np.spacing(abs(float(e)))
            for e, y in zip(map(function, *arguments), found.tolist(), strict=True)
        ]
    assert len(x) > 500
    assert max(errors) < 0.9  # ulp


@either
def test_functions_of_our_own_are_the_same_beside_any_others(fused):
    random = np.random.default_rng(2)
    spread = random.normal(size=400) * 10.0 ** random.integers(-5, 7, size=400)
    x = np.concatenate([SPECIAL, [1e-310, -1e-310], spread])
    y = np.random.default_rng(4).permutation(x)
    expected = _our_own(2, fused, x, y)
    for lanes in (4, 8):
        order = np.random.default_rng(lanes).permutation(len(x))
        found = _our_own(lanes, fused, x[order], y[order])
        for op, values in expected.items():
            assert_array_equal(found[op].view(np.int64), values[order].view(np.int64), err_msg=op)
