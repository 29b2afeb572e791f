"""Proof of identities by generic probes: expressions that agree there are equal everywhere.

Sums, products, quotients, roots, sines and cosines of random generic numbers agree only if they agree
everywhere (Schwartz, 1980; Zippel, 1979). The numbers of a scene are not generic: a parameter may be tiny, or
time may end before a switch. Functions that branch or saturate may also behave differently between probes.
Inputs are therefore replaced by random numbers, of order one and larger, and any other function by a generic
one that is neither flat nor kinked. An identity that then holds is valid for all such functions.

No comparison uses a fixed tolerance. Every value carries a round-off bound (`calculus/round_off.py`), and two
values count as equal if their difference is within their bounds. Constants in the code of a scene may be far
from one (1e-24, 1e16) and would dominate or vanish. They are written as c = m R^j with R = 2^40 and |m|
between 2^-20 and 2^20, and R is replaced by a random number at every probe: an identity that holds for any R
holds for 2^40.

`onto_rows` projects probes: it moves inputs by Gauss-Newton steps until the constraints vanish.
"""

import math
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self

import numpy as np

from jourdain_jax.calculus.roots import nearest_root, pseudo_inverses
from jourdain_jax.calculus.round_off import EPS, halves, with_bound
from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.evaluate import Probes, depend_on
from jourdain_jax.program.graph import Graph


class Projected(NamedTuple):
    """Probes projected onto constraints, or as close as the iteration came."""

    probes: Any  # of the given type: `Probes` or `IdentityProbes`
    moved: list[str]  # names of the inputs on which the constraints depend
    pattern: Pattern  # sparsity pattern of the constraint Jacobian with respect to these
    slopes: list[int]  # nodes of its entries


def onto_rows(probes, rows: Sequence[int], inputs: Mapping[str, int], **limits) -> Projected:
    """Return the probes with `inputs` (names -> nodes) moved to the nearest point where all rows are zero.
    `limits`: limits of the steps, as in `nearest_root`.
    """
    graph = probes.graph
    needed = set(graph.reachable(rows))
    moved = {name: n for name, n in inputs.items() if n in needed}
    pattern, slopes = _slopes_by_entries(graph, rows, list(moved.values()))
    given = (
        np.stack([np.broadcast_to(probes.inputs[name], probes.count) for name in moved], axis=1)
        if moved
        else np.zeros((probes.count, 0))
    )

    def at(x, which):
        every = given.copy()
        every[which] = x
        return probes.with_inputs(dict(zip(moved, every.T, strict=True)))

    def look(x, which):
        here = at(x, which)
        return np.asarray(here(rows)).T[which], np.asarray(here(slopes)).T[which]

    x = nearest_root(look, pattern.shortest, given, **limits)[0] if moved else given
    return Projected(at(x, slice(None)), list(moved), pattern, slopes)


def _slopes_by_entries(
    graph: Graph, rows: Sequence[int], variables: Sequence[int]
) -> tuple[Pattern, list[int]]:
    """Return the structurally nonzero derivatives of rows with respect to variables: their pattern and their
    nodes.
    """
    place = {n: k for k, n in enumerate(variables)}
    entries = [
        (i, place[n], slope)
        for i, row in enumerate(jacobian(graph, rows, variables))
        for n, slope in row.items()
        if slope != graph.zero
    ]
    pattern = Pattern.of([(i, k) for i, k, _ in entries], (len(rows), len(place)))
    return pattern, [slope for *_, slope in entries]


DIGITS = 40  # numerics: bits spanned by the constants in the code of a scene before they are rescaled
SURE = 16.0  # numerics: equal values may differ by this many bounds, because bounds are first-order
FEWEST = 6  # numerics: minimum number of probes with finite values


_KEPT: Mapping[str, float] = MappingProxyType({})


class Bounded(np.ndarray):
    """Values with round-off bounds; where a value is meaningless, its bound is infinite."""

    error: np.ndarray


class IdentityProbes:
    """Values of the nodes of a graph at generic inputs, with round-off bounds."""

    def __init__(
        self,
        graph: Graph,
        inputs: Mapping[str, np.ndarray],
        errors: Mapping[str, np.ndarray | float],
        radix: np.ndarray | None = None,
    ):
        self.graph, self.inputs, self._errors = graph, dict(inputs), dict(errors)
        self.count = max((np.size(x) for x in self.inputs.values()), default=1)
        both = {
            name: np.concatenate(
                [np.broadcast_to(x, self.count), np.broadcast_to(self._errors.get(name, 0.0), self.count)]
            )
            for name, x in inputs.items()
        }
        # random radix in place of 2^DIGITS
        self._radix = radix = (
            np.random.default_rng(4).uniform(1.5, 3.0, self.count) if radix is None else radix
        )
        # bounds follow the values in one array, like further probes
        self._both = Probes(graph, both, _SCALARS, _ARRAYS, lambda value: _moderate(value, radix))

    def __call__(self, nodes: Sequence[int]) -> Bounded:
        """Return values with bounds, shape (nodes, probes)."""
        values, errors = np.split(self._both(nodes), 2, axis=1)
        found = values.view(Bounded)
        found.error = np.where(np.isfinite(values), np.where(np.isnan(errors), np.inf, errors), 0.0)
        return found

    def with_inputs(
        self, changes: Mapping[str, np.ndarray], errors: Mapping[str, np.ndarray | float] = _KEPT
    ) -> Self:
        """Return probes with some inputs and their round-off bounds replaced."""
        return type(self)(self.graph, self.inputs | dict(changes), self._errors | dict(errors))

    def on_graph(self, graph: Graph, names: Mapping[str, str]) -> Self:
        """Return these probes for another graph. `names`: name of each input in that graph -> its name
        in this one.
        """
        errors = {name: self._errors.get(old, 0.0) for name, old in names.items()}
        return type(self)(graph, {name: self.inputs[old] for name, old in names.items()}, errors, self._radix)

    def varies(self, name: str) -> bool:
        """Return whether an input differs between probes by more than round-off."""
        x, error = (np.broadcast_to(x, self.count) for x in (self.inputs[name], self._errors.get(name, 0.0)))
        return bool(np.any(np.abs(x - np.roll(x, 1)) > SURE * (error + np.roll(error, 1))))

    def exchanged(self, groups: Sequence[Collection[str]], at: np.ndarray) -> Self:
        """Return the probes with indices `at`, copied once per group of input names. In each copy, the inputs
        of its group have the values of another probe.
        """

        def in_turn(name, x):
            x = np.broadcast_to(x, self.count)
            return np.concatenate([(np.roll(x, 1) if name in group else x)[at] for group in groups])

        inputs = {name: in_turn(name, x) for name, x in self.inputs.items()}
        return type(self)(
            self.graph,
            inputs,
            {name: in_turn(name, x) for name, x in self._errors.items()},
            np.tile(self._radix[at], len(groups)),
        )


def taken_for_what_they_are(graph: Graph, nodes: Sequence[int]) -> bool:
    """Return whether identity probes evaluate exactly all operations that the nodes need."""
    return all(graph.op[n] in _KNOWN for n in graph.reachable(nodes))


def equal(a: Bounded, b: Bounded, regular: np.ndarray | bool = True) -> np.ndarray:
    """Return which rows of `a` and `b` are equal up to round-off at the `regular` probes. A row contains the
    values of one number at all generic probes.
    """
    finite = np.isfinite(SURE * (a.error + b.error)) & regular & np.isfinite(np.asarray(b))
    return np.all(alike(a, b, regular), axis=1) & (np.count_nonzero(finite, axis=1) >= FEWEST)


def alike(a: Bounded, b: Bounded, regular: np.ndarray | bool = True) -> np.ndarray:
    """Return which values of `a` and `b` may be equal: they agree up to round-off, or are not finite."""
    bound = SURE * (a.error + b.error)
    said = np.isfinite(bound) & regular
    a, b = np.asarray(a), np.asarray(b)
    with np.errstate(invalid="ignore"):
        return (a == b) | (np.abs(a - b) <= bound) | ~said | ~(np.isfinite(b) | np.isfinite(a))


def unaffected(probes: IdentityProbes, nodes: list[int], replacement: Mapping[int, int]) -> dict[int, int]:
    """Return the entries of `replacement` (node -> substitute) that change no value of `nodes` at generic
    `probes`. Each entry is tried alone.
    """
    graph, here = probes.graph, probes(nodes)

    def unchanged(old, new):
        those = [k for k, needs in enumerate(depend_on(graph, nodes, [old])) if needs]
        then = probes(graph.substituted([nodes[k] for k in those], {old: new}))
        before = here[those]
        before.error = here.error[those]
        return np.all(equal(then, before))

    return {old: new for old, new in replacement.items() if unchanged(old, new)}


def is_combination(a: np.ndarray, error: np.ndarray, rows: np.ndarray, errors: np.ndarray) -> bool:
    """Return whether the vectors `a`, shape (probes, entries), are linear combinations of the `rows`, shape
    (probes, rows, entries), at all probes with finite values.
    """
    said = (
        np.isfinite(a).all(axis=1)
        & np.isfinite(error).all(axis=1)
        & np.isfinite(rows).all(axis=(1, 2))
        & np.isfinite(errors).all(axis=(1, 2))
    )
    for v, e, B, E in zip(a[said], error[said], rows[said], errors[said], strict=True):
        x = np.linalg.lstsq(B.T, v, rcond=None)[0]
        size = np.linalg.norm(v) + np.abs(x) @ np.linalg.norm(B, axis=1)
        if np.linalg.norm(v - x @ B) > SURE * (
            np.linalg.norm(e) + np.abs(x) @ np.linalg.norm(E, axis=1) + B.size * EPS * size
        ):
            return False
    return int(np.count_nonzero(said)) >= FEWEST


def identity_probes(probes: Probes, unchanged: Collection[str]) -> IdentityProbes:
    """Return generic probes for the graph of `probes`. Inputs in `unchanged`, such as quaternion components,
    keep their values.

    Parameters (names p...) are positive.
    """
    generator, count = np.random.default_rng(2), probes.count
    # half of the probes are ten times larger
    scale = np.where(np.arange(count) % 2, 10.0, 1.0)

    def drawn(name: str, value: np.ndarray) -> np.ndarray:
        # a mode is an integer and keeps its values
        if name in unchanged or (name.startswith("i") and np.ptp(value) > 0 and not np.any(value % 1.0)):
            return value
        return (
            generator.uniform(0.5, 1.5, count)
            if name.startswith("p")
            else scale * generator.normal(size=count)
        )

    return IdentityProbes(
        probes.graph,
        {name: drawn(name, value) for name, value in probes.inputs.items()},
        dict.fromkeys(unchanged, 4 * EPS),
    )


def on_rows(
    probes: IdentityProbes, near: Probes, rows: Sequence[int], coordinates: Mapping[str, int]
) -> IdentityProbes:
    """Return `probes` with `coordinates` (names of inputs -> nodes) projected onto rows = 0 by Gauss-Newton
    from `near`. Probes without convergence get infinite bounds.

    The probes stay unchanged if the rows contain a function that identity probes replace.
    """
    if not taken_for_what_they_are(probes.graph, rows):
        return probes
    begun = probes.with_inputs(
        {name: near.inputs[name] for name in coordinates}, dict.fromkeys(coordinates, 0.0)
    )
    found = onto_rows(begun, rows, coordinates, most=30, longest=1.0)
    if not found.moved:
        return probes
    values, J = found.probes(rows), np.asarray(found.probes(found.slopes)).T
    q = np.stack([found.probes.inputs[name] for name in found.moved])
    off = np.abs(np.asarray(values))
    errors = np.einsum(
        "pqr,rp->qp", np.abs(pseudo_inverses(found.pattern.dense(J))), off + values.error
    ) + EPS * np.abs(q)
    # rows may deviate by 1,000 round-off bounds
    errors[:, ~np.all(off <= 1e3 * values.error, axis=0)] = np.inf
    return probes.with_inputs(
        dict(zip(found.moved, q, strict=True)), dict(zip(found.moved, errors, strict=True))
    )


def _moderate(value: float, radix: np.ndarray) -> np.ndarray:
    """Return a constant with a random R in place of 2^40, and its round-off bound."""
    j = round(math.frexp(value)[1] / DIGITS) if math.isfinite(value) else 0
    moderate = math.ldexp(value, -DIGITS * j) * radix**j
    return np.concatenate([moderate, (2 * abs(j)) * EPS * np.abs(moderate)])


# Generic replacements of other functions, for values and bounds.


def _generic(name: str) -> Callable:
    """Return a generic function of any number of arguments, different for every name."""

    def function(*operands):
        weights = np.random.default_rng(zlib.crc32(name.encode())).uniform(0.3, 1.7, (2, len(operands)))
        half = len(operands[0]) // 2
        (phase, e), (rest, _) = (
            halves(sum(w * x for w, x in zip(row, operands, strict=True))) for row in weights
        )
        # weights differ at most sixfold, so this bounds the round-off of both sums
        size = sum(np.abs(x[:half]) for x in operands)
        return with_bound(np.sin(phase + 0.4) + 0.3 * rest, 3.0 * e + 2.0 * len(operands) * EPS * size)

    return function


def _opaque(call, *operands) -> np.ndarray:
    """Return one number per probe that depends on all entries of the operands."""
    return _generic(call.name)(*(column for x in operands for column in (x.T if x.ndim == 2 else [x])))


# operations evaluated exactly
_KNOWN = {"const", "input", *(name for name, operation in TABLE.items() if operation.bounded)}
_SCALARS = {name: operation.bounded or _generic(name) for name, operation in TABLE.items()}
_ARRAYS: dict[str, Callable] = {
    "array": lambda shape_and_type, *entries: np.stack(entries, axis=-1) if entries else np.empty((0, 0)),
    "opaque": _opaque,
    "output": lambda which, number: _generic(f"output {which[0]}")(number),
    "entry": lambda index, x: _generic(f"entry {index[0]}")(x) if x.ndim == 1 else x[:, index[0]],
}
