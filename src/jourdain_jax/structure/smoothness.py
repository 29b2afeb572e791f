"""Smoothness of the motion of bodies. If the velocity of a pose jumps, the second derivative does not show
it, and the impulse of the jump is missing from the motion.

    r(t, q), R(t, q), g(t, q)      must be continuously differentiable in time and coordinates
    qdot(t, q, u)                  must be continuous
    phi(t, q, 0)                   must be continuous in time: if it jumps and A does not, speeds would jump

A piecewise linear interpolation, for example, has a second derivative of zero at every evaluated point.
Quantities that depend on branches or on calls of JAX are therefore evaluated along lines in t and q. The
search finds jumps of r, R and g, and of v, omega and dg/dt at some speeds.
"""

from collections import Counter
from collections.abc import Iterator

import jax
import numpy as np

from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.equations.rows import names_of_rows
from jourdain_jax.program.evaluate import CALLS, NONANALYTIC, Probes, passes
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.probes import looked_at, projected
from jourdain_jax.structure.trace import named_values, owned

SPEEDS_WOULD_JUMP = (
    "speeds would have to jump there, by an impulse that accelerations do not contain. Let it change "
    "gradually, for example by a `jj.Sampled` input, or end the motion there and start another with the "
    "new speeds"
)


def kinks(scene: Scene, q: np.ndarray, u: np.ndarray) -> tuple[str, ...]:
    """Return one message for each body, constraint or coordinate that jumps or has a velocity that jumps.
    `q`, `u`: some states.
    """
    nodes = looked_at(scene)
    at, geometric = nodes.traced.at, len(nodes.traced.at.closure)
    fields = "position", "orientation", "v", "omega", "closure", "phi", "qdot"
    smooth = owned(scene, **{name: getattr(at, name) for name in fields})
    # values of velocity constraints, which must be continuous in time
    at_rest = nodes.vanishing["rows at rest"][geometric:]
    rows = dict(zip(at_rest, names_of_rows(scene)[geometric:], strict=True))
    if not any(passes(nodes.graph, smooth | rows, NONANALYTIC | CALLS)):
        return ()

    def values(wanted: list[int], points: np.ndarray) -> np.ndarray:
        """Return values at points (t, q)."""
        others = np.tile(u[0], (len(points), 1)), np.zeros((len(points), len(scene.inputs)))
        return Probes(nodes.graph, named_values(scene, points[:, 0], points[:, 1:], *others))(wanted).T

    def met(wanted: list[int], a: np.ndarray, b: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield, for every interval between points `a` and `b` with a jump, the node that jumps and the
        points before and after the jump.
        """
        for k, *sides in jumps(lambda points: values(wanted, points), a, b):
            yield wanted[k], np.stack(sides)

    found: dict[str, str] = {}
    for node, sides in met([*smooth, *rows], *_in_time(scene, q)):
        if node in smooth:
            found.setdefault(smooth[node], _said(scene, smooth[node], f"at t = {sides[1, 0]:.6g} s"))
            continue
        # if A changes too, a state may satisfy the constraint on both sides
        A = values([n for row in nodes.rows for n in row.values()], sides)
        if np.allclose(*A, rtol=1e-6, atol=1e-9):
            found.setdefault(
                rows[node],
                f"constraint `{rows[node]}` of `{type(scene).__name__}` jumps at t "
                f"= {sides[1, 0]:.6g} s: {SPEEDS_WOULD_JUMP}",
            )
    # three kinks along coordinates indicate a look-up table; a motion might never reach a single one
    for name, count in Counter(smooth[node] for node, _ in met(list(smooth), *_across(scene, q))).items():
        if count >= 3:
            found.setdefault(name, _said(scene, name, "at several configurations"))
    return tuple(found.values())


def _in_time(scene: Scene, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return intervals of time, each with one of the states `q`: 192 in the scene's `example_span`, and up to
    128 between the numbers of each of the scene's arrays, which may be sample times.
    """
    span = float(scene.example_span)
    t = np.linspace(1e-6 * span, span, 193)
    low, high = [t[:-1]], [t[1:]]
    for leaf in jax.tree.leaves(scene):
        knots = np.unique(np.asarray(leaf, float)) if np.ndim(leaf) == 1 else np.zeros(0)
        knots = knots[np.isfinite(knots)]
        if knots.size >= 2:
            middle = (knots[:-1] + knots[1:]) / 2
            count = min(128, max(knots.size - 2, 1))
            chosen = np.unique(np.linspace(0, max(knots.size - 3, 0), count).astype(int))
            low.append(middle[chosen] if knots.size > 2 else knots[:1])
            high.append(middle[chosen + 1] if knots.size > 2 else middle)
    low, high = np.concatenate(low), np.concatenate(high)
    here = q[np.arange(len(low)) % len(q)]
    return np.column_stack([low, here]), np.column_stack([high, here])


def _across(scene: Scene, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return intervals on 6 lines across the bounding box of the states `q`, 48 on each, at random times.

    The lines are projected onto the geometric constraints. Off the constraints a quantity may jump at states
    that no motion reaches, for example inside a body on which others roll. Intervals with an end that does
    not converge, or with ends far apart, are omitted.
    """
    generator, lines, across = np.random.default_rng(3), 6, 48
    ends = generator.uniform(q.min(axis=0), q.max(axis=0), (2, lines, q.shape[1]))
    points = ends[0] + np.linspace(0.0, 1.0, across + 1)[:, None, None] * (ends[1] - ends[0])
    t = np.tile(generator.uniform(0.0, 1.0, lines), across + 1)
    found = projected(scene, t, points.reshape(len(t), -1))
    on = np.column_stack([t, found.q]).reshape(across + 1, lines, -1)
    far = np.linalg.norm(on[1:] - on[:-1], axis=2) > 4 * np.linalg.norm(points[1:] - points[:-1], axis=2)
    good = found.on_rows.reshape(across + 1, lines)
    near = good[1:] & good[:-1] & ~far
    return on[:-1][near], on[1:][near]


def _said(scene: Scene, what: str, where: str) -> str:
    return (
        f"{what} of `{type(scene).__name__}` is not smooth: it jumps, or its velocity does, {where}, for "
        "example by a piecewise linear interpolation, a look-up or a branch. The inertia force of a jump "
        "is lost, since the second derivative is zero on either side. Give samples as `jj.Spline(ts, "
        "values)`, and join pieces with equal slopes"
    )
