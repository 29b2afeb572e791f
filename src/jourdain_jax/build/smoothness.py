"""Whether bodies move smoothly: a pose whose velocity jumps loses its force of inertia, which is a second derivative.

    r(t, q), R(t, q), g(t, q)      once continuously differentiable, or mass times a jump of velocity is lost in silence
    qdot(t, q, u)                  continuous, for the same reason
    phi(t, q, 0)                   of velocity rows, continuous in time: where it jumps and A does not, speeds would have to jump

A piecewise linear interpolation has a second derivative of zero wherever one looks. What a branch or a call of JAX decides on the way to these quantities is
therefore looked at along lines in t and q, where it or its rate may jump: r, R and g, and v, omega and dg/dt at some speeds.
"""

from collections.abc import Iterator

import jax
import numpy as np

from jourdain_jax.build.probed_on_graph import LookedAt, looked_at
from jourdain_jax.build.trace import named_values
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.equations.listed import names_of_bodies, names_of_position_rows, names_of_rows
from jourdain_jax.program.analyticity import CALLS, NONANALYTIC, passes
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.scene import Scene

EVENLY, KNOTS, ACROSS, LINES = 192, 128, 48, 6  # intervals of time within the usual span, around numbers that may be knots, on each line across q; such lines
SPEEDS_WOULD_JUMP = (
    "speeds would have to jump there, by an impulse that no acceleration holds. Let it change within a short time, as by a `jj.Sampled` input, or end the "
    "motion there and start another with the speeds after the jump"
)


def kinks(scene: Scene, q: np.ndarray, u: np.ndarray) -> tuple[str, ...]:
    """Bodies, rows and coordinates that jump, or whose velocity jumps, one sentence each; `q`, `u`: some states."""
    nodes = looked_at(scene)
    smooth, rows = _smooth(scene, nodes), _velocity_rows(scene, nodes)
    known = smooth | rows
    if not any(passes(nodes.graph, known, NONANALYTIC | CALLS)):
        return ()
    found: dict[str, str] = {}
    for node, before, behind in _jumps(scene, nodes, list(known), u[0], *_in_time(scene, q)):
        if node in smooth:
            found.setdefault(smooth[node], _said(scene, smooth[node], f"at t = {behind[0]:.6g} s"))
        elif not _sets_in(scene, nodes, np.stack([before, behind]), u[0]):
            found.setdefault(rows[node], f"row `{rows[node]}` of `{type(scene).__name__}` jumps at t = {behind[0]:.6g} s: {SPEEDS_WOULD_JUMP}")
    met = [smooth[node] for node, *_ in _jumps(scene, nodes, list(smooth), u[0], *_across(q))]
    for name in dict.fromkeys(met):
        # three kinks along coordinates make a look-up: a single one may lie where no motion comes
        if met.count(name) >= 3:
            found.setdefault(name, _said(scene, name, "at several places on its way"))
    return tuple(found.values())


def _smooth(scene: Scene, nodes: LookedAt) -> dict[int, str]:
    """The nodes that must not jump as time or coordinates change, and what each belongs to."""
    at, geometric = nodes.traced.at, names_of_position_rows(scene)
    bodies = [f"the pose of body `{name}`" for name in names_of_bodies(scene)]
    named = [pair for of in (at.position, at.orientation, at.v, at.omega) for pair in zip(bodies, of, strict=True)]
    named += [(f"row `{name}`", x) for of in (at.closure, at.phi) for name, x in zip(geometric, of, strict=False)]
    named += [(f"the rate of coordinate `{name}`", x) for name, x in zip(scene.coordinate_names.entries, at.qdot, strict=True)]
    return {node: name for name, x in reversed(named) for node in np.ravel(x).tolist()}


def _velocity_rows(scene: Scene, nodes: LookedAt) -> dict[int, str]:
    """Velocity rows at rest, which must not jump as time goes on."""
    names, first = names_of_rows(scene), len(names_of_position_rows(scene))
    return dict(zip(nodes.phi_at_rest[first:].tolist(), names[first:], strict=True))


def _at(scene: Scene, nodes: LookedAt, points: np.ndarray, u: np.ndarray) -> Probes:
    """Values at points (t, q), at speeds `u`."""
    count = len(points)
    values = named_values(scene, points[:, 0], points[:, 1:], np.tile(u, (count, 1)), np.zeros((count, len(scene.inputs))))
    return Probes(nodes.graph, {name: np.asarray(x, float) for name, x in values.items()})


def _jumps(scene: Scene, nodes: LookedAt, wanted: list[int], u, a: np.ndarray, b: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Return which node jumps, and the points before and behind it, for every interval with a jump between the points `a` and `b`."""
    for k, before, behind in jumps(lambda points: _at(scene, nodes, points, u)(wanted).T, a, b):
        yield wanted[k], before, behind


def _in_time(scene: Scene, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intervals of time at one of some states `q`: the usual span, and around all numbers in arrays of the scene, which may be knots."""
    span = float(scene.example_span)
    t = np.linspace(1e-6 * span, span, EVENLY + 1)
    low, high = [t[:-1]], [t[1:]]
    for leaf in jax.tree.leaves(scene):
        knots = np.unique(np.asarray(leaf, float)) if np.ndim(leaf) == 1 else np.zeros(0)
        knots = knots[np.isfinite(knots)]
        if knots.size >= 2:
            middle = (knots[:-1] + knots[1:]) / 2
            chosen = np.unique(np.linspace(0, max(knots.size - 3, 0), min(KNOTS, max(knots.size - 2, 1))).astype(int))
            low.append(middle[chosen] if knots.size > 2 else knots[:1])
            high.append(middle[chosen + 1] if knots.size > 2 else middle)
    low, high = np.concatenate(low), np.concatenate(high)
    here = q[np.arange(len(low)) % len(q)]
    return np.column_stack([low, here]), np.column_stack([high, here])


def _across(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intervals on lines across the box that holds some states `q`, at random times."""
    generator = np.random.default_rng(3)
    ends = generator.uniform(q.min(axis=0), q.max(axis=0), (2, LINES, q.shape[1]))
    points = ends[0] + np.linspace(0.0, 1.0, ACROSS + 1)[:, None, None] * (ends[1] - ends[0])
    t = np.tile(generator.uniform(0.0, 1.0, LINES), ACROSS)
    a, b = (x.reshape(len(t), -1) for x in (points[:-1], points[1:]))
    return np.column_stack([t, a]), np.column_stack([t, b])


def _sets_in(scene: Scene, nodes: LookedAt, points: np.ndarray, u: np.ndarray) -> bool:
    """Return whether rows change between these points: a state may meet both."""
    before, behind = _at(scene, nodes, points, u)([node for row in nodes.rows for node in row.values()]).T
    return not np.allclose(before, behind, rtol=1e-6, atol=1e-9)


def _said(scene: Scene, what: str, where: str) -> str:
    return (
        f"{what} of `{type(scene).__name__}` is not smooth: it jumps, or its velocity does, {where}, as by a piecewise linear interpolation, a look-up or a "
        "branch. What jumps exerts no force of inertia, for the second derivative is zero on either side. Give samples as `jj.Spline(ts, values)`, and let "
        "pieces meet with equal slopes"
    )
