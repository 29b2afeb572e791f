"""Probes that prove identities: what two expressions have in common at them, they have in common everywhere.

Sums, products, quotients, roots, sines and cosines of generic numbers agree at random only if they agree everywhere. Numbers near those of a scene are
not generic, though (a parameter may be tiny, time may stop before a switch), and a function that has branches, or saturates, may do elsewhere what it
does at no probe. So inputs are drawn anew, of the order of one and larger; and any other function is replaced by one of its operands that is neither
flat nor kinked anywhere. An identity that holds then holds whatever these functions are.
"""

import zlib
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from jourdain_jax.program.derivative import columns
from jourdain_jax.program.entrywise import FUNCTIONS
from jourdain_jax.program.evaluate import Probes

KNOWN = ("add", "sub", "mul", "div", "neg", "sqrt", "sin", "cos", "tan")  # taken for what they are
STEPS, CLOSED = 30, 1e-11  # of Newton's method
FAR = 10.0  # half of the probes lie so much further out
AGREEMENT, ROUND_OFF = 1e-9, 1e-13  # relative to the values of one expression; to those of all at one probe, and to what they are made of
FEWEST = 6  # probes at which an expression is a number


def equal(a: np.ndarray, b: np.ndarray, regular: np.ndarray | bool = True) -> np.ndarray:
    """Of each pair of rows, values of expressions at formal probes, whether they are equal but for round-off, at those that are `regular`."""
    a, b = (np.where(regular, x, np.nan) for x in (a, b))
    finite = np.isfinite(b)
    size = np.where(finite, np.abs(b), 0.0)
    limit = AGREEMENT * np.max(size, axis=1, keepdims=True, initial=0.0) + ROUND_OFF * (_scale(a.shape[1]) ** 2 + np.max(size, axis=0, initial=0.0))
    with np.errstate(invalid="ignore"):
        alike = (a == b) | (np.abs(a - b) <= limit) | ~(finite | np.isfinite(a))
    return np.all(alike, axis=1) & (np.count_nonzero(finite, axis=1) >= FEWEST)


def unaffected(probes: Probes, nodes: list[int], replacement: Mapping[int, int]) -> dict[int, int]:
    """The replacements, each of one node by another, that by themselves change none of the `nodes`; `probes`: formal ones."""
    graph, here = probes.graph, probes(nodes)

    def unchanged(old, new):
        return np.all(equal(probes(graph.substituted(nodes, {old: new})), here))

    return {old: new for old, new in replacement.items() if unchanged(old, new)}


def formal(probes: Probes, unchanged: Collection[str]) -> Probes:
    """Such probes for the graph of `probes`; inputs named in `unchanged` (the parts of quaternions, which have a norm) keep their values.

    Parameters, named p..., are positive.
    """
    generator, count = np.random.default_rng(2), probes.count
    scale = _scale(count)

    def drawn(name: str, value: np.ndarray) -> np.ndarray:
        if name in unchanged:
            return value
        return generator.uniform(0.5, 1.5, count) if name.startswith("p") else scale * generator.normal(size=count)

    return Probes(probes.graph, {name: drawn(name, value) for name, value in probes.inputs.items()}, _SCALARS, _ARRAYS)


def on_rows(probes: Probes, near: Probes, rows: Sequence[int], coordinates: Mapping[str, int]) -> Probes:
    """Formal `probes` with `coordinates` (names of inputs, their nodes) on rows = 0, by Newton's method from `near`; not numbers where it does not arrive.

    The probes unchanged where the rows hold another function than the known ones, of which nothing can be solved.
    """
    graph = probes.graph
    needed = set(graph.reachable(rows))
    moved = {name: n for name, n in coordinates.items() if n in needed}
    if not moved or any(graph.op[n] not in (*KNOWN, "const", "input") for n in needed):
        return probes
    slopes = [n for column in columns(graph, rows, moved.values()) for n in column]
    q = np.stack([np.broadcast_to(near.inputs[name], probes.count) for name in moved])
    for _ in range(STEPS):
        here = probes.with_inputs(dict(zip(moved, q, strict=True)))
        values, J = np.nan_to_num(here(rows)), np.nan_to_num(here(slopes)).reshape(len(moved), len(rows), -1)
        step = np.einsum("pqr,rp->qp", np.linalg.pinv(J.transpose(2, 1, 0), rcond=1e-9), values)
        q = q - step / np.maximum(1.0, np.max(np.abs(step), axis=0))
    left = np.max(np.abs(probes.with_inputs(dict(zip(moved, q, strict=True)))(rows)), axis=0)
    q[:, ~(left <= CLOSED)] = np.nan
    return probes.with_inputs(dict(zip(moved, q, strict=True)))


def _scale(count: int) -> np.ndarray:
    return np.where(np.arange(count) % 2, FAR, 1.0)


def _generic(name: str) -> Callable:
    """A function of any number of numbers, another one for every name."""

    def function(*operands):
        weights = np.random.default_rng(zlib.crc32(name.encode())).uniform(0.3, 1.7, (2, len(operands)))
        phase, rest = (sum(w * x for w, x in zip(row, operands, strict=True)) for row in weights)
        return np.sin(phase + 0.4) + 0.3 * rest

    return function


def _kept(call, *operands) -> np.ndarray:
    """One number per probe, made from all entries of the operands."""
    return _generic(call.name)(*(column for x in operands for column in (x.T if x.ndim == 2 else [x])))


_SCALARS = {op: FUNCTIONS[op] if op in KNOWN else _generic(op) for op in FUNCTIONS}
_ARRAYS: dict[str, Callable] = {
    "array": lambda shape_and_type, *entries: np.stack(entries, axis=-1) if entries else np.empty((0, 0)),
    "kept": _kept,
    "output": lambda which, number: _generic(f"output {which[0]}")(number),
    "entry": lambda index, x: _generic(f"entry {index[0]}")(x) if x.ndim == 1 else x[:, index[0]],
}
