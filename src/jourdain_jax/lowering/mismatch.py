"""Which body, load or row makes a scalar program differ from the dense path: one whose derivatives are not those of what it computes.

w(t, q, u)  and  dw/ds along a direction in (t, q, u)      by JAX, and on the graph; w: velocities, loads, rows
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.build.trace import TracedScene, velocity_quantities
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.listed import names_of_bodies, names_of_position_rows, names_of_rows
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.scene import Scene


def diagnose_mismatch(scene: Scene, traced: TracedScene, probes: Probes, limit: float, states: tuple) -> str:
    """What differs between graph and JAX, by name, and how; where no body, load or row does, that it is the solution of the equations.

    `limit`: of the difference, relative to the size of the quantity at the probes; `states`: parameters, t, q, u and inputs at the probes, with a leading axis.
    """
    try:
        found = list(_differing(scene, traced, probes, limit, states))
    except Unsupported as reason:
        return f"{reason} has no derivative in scalars"
    values = list(dict.fromkeys(owner for owner, in_value in found if in_value))
    rates = list(dict.fromkeys(owner for owner, in_value in found if not in_value))
    if values:
        return f"{' and '.join(values)} come to another value there"
    if rates:
        return f"{' and '.join(rates)} has more than one derivative there, at a kink"
    return _NOBODY


_NOBODY = "bodies, loads and rows agree, but not the solutions of the equations; rows, or the inertia along what they leave free, may be nearly singular there"


def _differing(scene: Scene, traced: TracedScene, probes: Probes, limit: float, states: tuple) -> Iterator[tuple[str, bool]]:
    """Owners of what differs, and whether it differs itself (otherwise in its rate)."""
    _, _, q, u, _ = states
    g, directional_derivative = traced.graph, (1.0, np.cos(1.0 + np.arange(q.shape[1])), np.sin(1.0 + np.arange(u.shape[1])))
    direction = {n: g.const(x) for n, x in zip([traced.t, *traced.q.tolist(), *traced.u.tolist()], np.hstack(directional_derivative).tolist(), strict=True)}
    values, rates = _by_jax(*states, directional_derivative)
    names = names_of_bodies(scene)
    bodies = [f"body `{name}`" for name in names]
    loads, speeds = [f"a load on body `{name}`" for name in names], [f"a load on speed `{name}`" for name in scene.speed_names.entries]
    rows, closures = [f"row `{name}`" for name in names_of_rows(scene)], [f"row `{name}`" for name in names_of_position_rows(scene)]
    said = {"v": bodies, "omega": bodies, "phi": rows, "closure": closures, "force": loads, "torque": loads, "direct": speeds}
    for field, owners in said.items():
        nodes = getattr(traced.at, field)
        flat = nodes.ravel().tolist()
        found = probes([*flat, *derivatives(g, flat, direction)]).reshape(2, *nodes.shape, probes.count)
        expected = np.moveaxis(np.stack([getattr(values, field), getattr(rates, field)]), 1, -1)
        size = np.nanmax(np.abs(expected), initial=np.finfo(float).tiny)
        for i, owner in enumerate(owners):
            in_value, in_rate = (np.any(np.abs(found - expected)[k, i] > limit * size) for k in range(2))
            if in_value or in_rate:
                yield owner, bool(in_value)


@eval_numpy
def _by_jax(parameters, t, q, u, inputs, directional_derivative):
    def one(scene, t, q, u, inputs):
        real = tuple(jnp.asarray(x, q.dtype) for x in directional_derivative)
        return jax.jvp(lambda t, q, u: velocity_quantities(scene, motion_at(scene, t, q, u, inputs), with_events=False), (t, q, u), real)

    return jax.vmap(one)(parameters, t, q, u, inputs)
