"""Which body, load or row makes a scalar program differ from the dense path: one whose derivatives are not those of what it computes.

    w(t, q, u)  and  dw/ds along a direction in (t, q, u)      by JAX, and on the graph; w: velocities, loads, rows

The graph differentiates what is computed; JAX believes a rule that someone wrote beside it (`jax.custom_jvp`).
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.probing import on_numbers
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows
from jourdain_jax.equations.trace import TracedScene, velocity_quantities
from jourdain_jax.program.derivative import derivatives
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.scene import Scene


def blamed(scene: Scene, traced: TracedScene, probes: Probes, limit: float, parameters: Scene, t, q, u, inputs) -> str:
    """What has derivatives of its own, by name; in general terms where nothing is found.

    `limit`: of the difference, relative to the size of the quantity at the probes; `parameters`, `t`, `q`, `u`, `inputs`: the probes, with a leading axis.
    """
    try:
        here = list(dict.fromkeys(_differing(scene, traced, probes, limit, parameters, t, q, u, inputs)))
    except Unsupported:
        here = []
    return " and ".join(here) if here else "a body, load or row"


def _differing(scene: Scene, traced: TracedScene, probes: Probes, limit: float, parameters, t, q, u, inputs) -> Iterator[str]:
    g, along = traced.graph, (1.0, np.cos(1.0 + np.arange(q.shape[1])), np.sin(1.0 + np.arange(u.shape[1])))
    direction = {n: g.const(x) for n, x in zip([traced.t, *traced.q.tolist(), *traced.u.tolist()], np.hstack(along).tolist(), strict=True)}
    values, rates = _by_jax(parameters, t, q, u, inputs, along)
    names = jax.eval_shape(lambda s: motion_at(s, 0.0, jnp.zeros(q.shape[1]), jnp.zeros(u.shape[1])).bodies, scene)
    bodies = [f"body `{name}`" for name in names]
    loads, speeds = [f"a load on body `{name}`" for name in names], [f"a load on speed `{name}`" for name in scene.speed_names.entries]
    rows, closures = [f"row `{name}`" for name in names_of_rows(scene)], [f"row `{name}`" for name in names_of_position_rows(scene)]
    said = {"v": bodies, "omega": bodies, "phi": rows, "closure": closures, "force": loads, "torque": loads, "direct": speeds}
    for field, owners in said.items():
        nodes = getattr(traced.at, field)
        flat = nodes.ravel().tolist()
        found = probes([*flat, *derivatives(g, flat, direction)]).reshape(2, *nodes.shape, probes.count)
        expected = np.moveaxis(np.stack([getattr(values, field), getattr(rates, field)]), 1, -1)
        size = 1 + np.nanmax(np.abs(expected), initial=0.0)
        for i, owner in enumerate(owners):
            if np.any(np.abs(found - expected)[:, i] > limit * size):
                yield owner


@on_numbers
def _by_jax(parameters, t, q, u, inputs, along):
    def one(scene, t, q, u, inputs):
        real = tuple(jnp.asarray(x, q.dtype) for x in along)
        return jax.jvp(lambda t, q, u: velocity_quantities(scene, motion_at(scene, t, q, u, inputs), with_events=False), (t, q, u), real)

    return jax.vmap(one)(parameters, t, q, u, inputs)
