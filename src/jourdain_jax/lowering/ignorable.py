"""Find ignorable coordinates, which do not affect the accelerations of the independent speeds. Programs fix
them at their reference values.
"""

from dataclasses import replace

import numpy as np

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.lowering.appell import AppellOnGraph, Equations
from jourdain_jax.lowering.comparison import enough, values_at
from jourdain_jax.lowering.elimination import pivots_ok, usual
from jourdain_jax.program.derivative import cotangents, on_its_own
from jourdain_jax.program.identity_test import SURE, alike, equal, taken_for_what_they_are
from jourdain_jax.scene.scene import Scene

FEW = 6  # numerics: number of probes that suffices to test most coordinates


def _with_slopes(
    builder: AppellOnGraph, ydot: list[int], coordinates: list[int], regular: np.ndarray
) -> set[int]:
    """Return the coordinates (nodes) for which `sum w ydot`, with random weights w, has a nonzero derivative
    at some generic probe. This also finds coordinates whose effect on values is less than round-off, such as
    the heading of the last of many trailers.

    The set is empty if the derivatives contain operations that the identity test replaces.
    """
    graph, generic = builder.graph, builder.identity_probes
    inputs = [n for n in graph.reachable(ydot) if graph.op[n] == "input"]
    # the other coordinates are constant at the probes
    coordinates = [n for n in coordinates if n in set(inputs) and generic.varies(str(graph.value[n]))]
    if not coordinates or graph.calls(ydot):
        return set()
    own, outputs, variables = on_its_own(graph, ydot, inputs)
    weights = [own.const(x) for x in np.random.default_rng(5).uniform(0.5, 1.5, len(outputs))]
    slopes = cotangents(own, outputs, weights, [variables[inputs.index(n)] for n in coordinates])
    if not taken_for_what_they_are(own, slopes):
        return set()
    found = generic.on_graph(
        own, {str(own.value[n]): str(graph.value[old]) for n, old in zip(variables, inputs, strict=True)}
    )(slopes)
    surely = np.any((np.abs(np.asarray(found)) > SURE * found.error) & np.isfinite(found) & regular, axis=1)
    return {n for n, counts in zip(coordinates, surely, strict=True) if counts}


def ignorable(
    scene: Scene, builder: AppellOnGraph, equations: Equations, expected: np.ndarray
) -> tuple[int, ...]:
    """Return the coordinates (quaternions as a whole) that never affect the accelerations of the independent
    speeds.
    """
    probes, generic, q = builder.probes, builder.identity_probes, builder.traced.q
    attitudes = [tuple(range(first, first + 4)) for first, _ in scene.coordinates.quaternions]
    single = [(i,) for i in range(len(q)) if not any(i in attitude for attitude in attitudes)]
    at_probes, reference = expected[len(equations.qdot) :], scene.coordinates.reference()
    accelerations = replace(equations, qdot=[])
    used, here = set(builder.graph.reachable(equations.ydot)), generic(equations.ydot)
    regular = pivots_ok(equations.pivots, generic)

    def unchanged(group) -> bool:
        elsewhere = generic.exchanged([[f"q_{i}" for i in group]], np.arange(generic.count))
        valid = regular & pivots_ok(equations.pivots, elsewhere)
        return bool(np.all(equal(elsewhere(equations.ydot), here, valid)))

    def surely_changed(groups) -> np.ndarray:
        """Return which groups of coordinates affect the accelerations at a few probes. All groups are tested
        in one evaluation. For a long chain, this finds nearly all groups that have an effect.
        """
        at = np.flatnonzero(regular)[:FEW]
        if len(groups) < FEW or not at.size or builder.graph.calls(equations.ydot):
            return np.zeros(len(groups), bool)
        elsewhere = generic.exchanged([[f"q_{i}" for i in group] for group in groups], at)
        then, lanes = elsewhere(equations.ydot), np.tile(at, len(groups))
        before = here[:, lanes]
        before.error = here.error[:, lanes]
        sizes = np.abs(elsewhere(equations.pivots))
        # require pivots 100 times above the limit, because their typical size is known only roughly
        typical = usual(np.abs(generic(equations.pivots)))[:, None]
        far_from_singular = np.all(sizes > 100.0 * SMALLEST_PIVOT * typical, axis=0)
        return np.any(~alike(then, before, far_from_singular), axis=0).reshape(len(groups), -1).any(axis=1)

    def regular_at_reference(group) -> bool:
        fixed = {f"q_{i}": np.full(probes.count, reference[i]) for i in group}
        values = values_at(accelerations, probes.with_inputs(fixed))
        return enough(np.all(np.isfinite(values) & np.isfinite(at_probes), axis=0))

    groups = [*single, *attitudes]
    held = [i for group in groups if used.isdisjoint(q[list(group)].tolist()) for i in group]
    groups = [group for group in groups if group[0] not in held]
    left = [group for group, counts in zip(groups, surely_changed(groups), strict=True) if not counts]
    alone = [q[i] for group in left if len(group) == 1 for i in group]
    count_little = _with_slopes(builder, equations.ydot, alone, regular)
    left = [group for group in left if q[group[0]] not in count_little]
    together = [i for group in left for i in group]
    # if all groups together have no effect, no group has an effect
    if len(left) > FEW and unchanged(together) and regular_at_reference(together):
        return tuple(sorted([*held, *together]))
    for group in left:
        if unchanged(group) and regular_at_reference(group):
            held += group
    return tuple(sorted(held))
