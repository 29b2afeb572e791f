"""Which values of a long program are in registers: what is needed is at hand, and no bit depends on it."""

import evaluated_natively
import machine_code
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from jourdain_jax.native import host, scalar_program
from jourdain_jax.native.registers import turns
from jourdain_jax.program.graph import Graph


def _uses(random: np.random.Generator, count: int, inputs: int) -> list[tuple[int, list[int]]]:
    """Values made of others that are there: inputs with numbers below zero, and values before."""
    return [(n, random.integers(-inputs, n, size=random.integers(1, 4)).tolist()) for n in range(count)]


@pytest.mark.parametrize("registers", [4, 9, 28])
def test_what_a_value_is_made_of_is_at_hand(registers):
    uses = _uses(np.random.default_rng(registers), 600, 30)
    found, places = turns(uses, range(-30, 0), registers)
    touched: dict[int, int] = {}  # when a value was made or used last
    in_memory: dict[int, int] = {}  # place -> value
    taken = np.zeros(len(uses), int)  # registers after each turn
    for i, ((value, made_of), turn) in enumerate(zip(uses, found, strict=True)):
        for x in turn.loaded:
            assert x < 0 or x in in_memory.values()
        for x in set(made_of) - set(turn.loaded):
            taken[touched[x] : i] += 1
        touched |= dict.fromkeys([*made_of, value], i)
        for x, place in turn.stored:
            assert 0 <= place < places
            in_memory[place] = x
    assert registers - 1 <= taken.max() <= registers


def test_values_go_to_memory_only_where_registers_are_few():
    uses = _uses(np.random.default_rng(0), 20, 4)
    found, places = turns(uses, range(-4, 0), 24)
    assert places == 0
    assert not any(turn.stored for turn in found)
    assert turns(uses, range(-4, 0), 4)[1] > 0


@machine_code.needed
def test_no_bit_depends_on_which_values_wait_in_memory(monkeypatch):
    random, graph = np.random.default_rng(5), Graph()
    inputs = [graph.input(f"x{i}", True) for i in range(5)]
    numbers = [*inputs, graph.const(0.75)]
    for _ in range(700):
        a, b, c = (int(numbers[k]) for k in random.integers(len(numbers), size=3))
        kind = random.integers(6)
        if kind == 0:
            numbers.append(graph.call(str(random.choice(["sin", "cos"])), a))
        elif kind == 1:
            numbers.append(graph.call("select", graph.call("lt", a, b), b, c))
        else:
            numbers.append(graph.add(graph.mul(graph.const(0.5), a), graph.mul(b, graph.call("sin", c))) if kind < 4 else graph.sub(a, b))
    outputs = [inputs[0], graph.const(3.0), *numbers[50::7], numbers[-1], numbers[-1]]
    points = random.normal(size=(19, 5))
    found = []
    for long, registers, reach in ((10**9, 28, 128), (0, 28, 128), (0, 5, 20)):
        monkeypatch.setattr(scalar_program, "LONG", long)
        monkeypatch.setattr(scalar_program, "REACH", reach)
        monkeypatch.setattr(host, "registers", lambda registers=registers: registers)
        found.append(np.asarray(evaluated_natively.function(graph, outputs, inputs)(points)))
    steps = [(n, graph.args[n]) for n in graph.needed(outputs, inputs)]
    assert turns(steps, inputs, 5)[1] > 2 * 20  # more than one pointer reaches
    assert_array_equal(found[1], found[0])
    assert_array_equal(found[2], found[0])
    assert len(np.unique(found[0])) > 100
