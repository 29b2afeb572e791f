"""Random programs of all operations of the table by machine code and by XLA, against mpmath: no value is
further from the truth than its round-off allows.
"""

import functools
from collections import Counter

import evaluated_natively
import jax.numpy as jnp
import machine_code
import mpmath
import numpy as np
import pytest
from in_mpmath import COMPARED, EPS, TRUTHS, Known, found

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program import emit
from jourdain_jax.program.graph import Graph

pytestmark = machine_code.needed

EXACT = {"neg", "abs", "sign", "floor", "ceil", "round", "max", "min", "rem"}  # no round-off of their own
ROUNDED = {"add", "sub", "mul", "div", "sqrt"}  # to the nearest double
TWO = {"add", "sub", "mul", "div", "atan2", "pow", "rem", "max", "min", *COMPARED}
POINTS, INPUTS, EACH = 8, 4, 6
Step = tuple[str, tuple[int, ...]]


def drawn(seed):
    """Operations in any order, each so many times, of numbers and truth values that are there: of inputs as
    often as of what was made of them.
    """
    random = np.random.default_rng(seed)
    numbers, truths, steps = list(range(INPUTS)), [], []
    order = ["lt", *random.permutation([op for op in TABLE for _ in range(EACH)])]
    for node, op in enumerate(map(str, order), INPUTS):
        number = lambda: int(random.choice(numbers if random.integers(2) else numbers[:INPUTS]))
        truth = lambda: int(random.choice(truths))
        if op == "select":
            args = (truth(), number(), number())
        elif op in TRUTHS:
            args = (truth(), *([truth()] if op != "not" else []))
        else:
            args = (number(), *([number()] if op in TWO else []))
        steps.append((op, args))
        (truths if op in (*TRUTHS, *COMPARED, "is_finite") else numbers).append(node)
    return steps


def own_round_off(op, of_functions):
    """Relative; `of_functions`: of those that are not rounded to the nearest double."""
    return 0.0 if op in EXACT else EPS if op in ROUNDED else of_functions


def true_values(steps, point, of_functions):
    """Of all steps."""
    known: list = [Known(mpmath.mpf(float(x)), mpmath.mpf(0)) for x in point]
    for op, args in steps:
        far = (
            op in ("sin", "cos") and known[args[0]] is not None and abs(known[args[0]].value) > 5e5
        )  # XLA's multiples of pi/2 have 20 bits
        known.append(None if far else found(op, [known[a] for a in args], own_round_off(op, of_functions)))
    return known[INPUTS:]


@functools.cache
def programs(seed):
    """Steps of a program, points, and its values at these by machine code and by XLA."""
    steps, graph = drawn(seed), Graph()
    points = np.random.default_rng(100 + seed).normal(size=(POINTS, INPUTS)) * [1.0, 2.0, 0.5, 5.0]
    inputs = nodes = [graph.input(f"x{i}", True) for i in range(INPUTS)]
    for op, args in steps:
        nodes = [*nodes, graph.call(op, *(nodes[a] for a in args))]
    by_machine_code = np.asarray(evaluated_natively.function(graph, nodes[INPUTS:], inputs)(points))
    by_xla = emit.run(graph, nodes[INPUTS:], dict(zip(inputs, jnp.asarray(points.T), strict=True)))
    by_xla = np.stack([np.broadcast_to(np.asarray(x, float), POINTS) for x in by_xla], axis=1)
    return steps, points, by_machine_code, by_xla


@pytest.mark.parametrize(("way", "of_functions"), [("machine code", 2 * EPS), ("XLA", 500 * EPS)])
@pytest.mark.parametrize("seed", range(3))
def test_values_are_those_of_mpmath_within_their_round_off(seed, way, of_functions):
    steps, points, *both = programs(seed)
    values, settled = both[way == "XLA"], Counter()
    with mpmath.workdps(40):
        for point, row in zip(points, values, strict=True):
            for (op, args), true, value in zip(
                steps, true_values(steps, point, of_functions), row, strict=True
            ):
                if true is None:
                    continue
                settled[op] += 1
                said = op, args, point, true, value
                if isinstance(true, bool):
                    assert value == true, said
                else:
                    assert np.isfinite(value), said
                    assert abs(mpmath.mpf(float(value)) - true.value) <= true.error, said
    assert set(settled) == set(TABLE)
    assert min(settled.values()) >= 4, settled
