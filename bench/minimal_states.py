"""Motions of this engine from and to minimal states, (lanes, states): coordinates, and the speeds that its
program integrates.
"""

import jax
import jax.numpy as jnp
from baselines.heyoka_lowered import names

import jourdain_jax as jj


def starts_at(scene: jj.Scene, y) -> jj.State:
    """Return the consistent starts for minimal states."""
    known = names(scene)
    return jax.jit(jax.vmap(lambda y: jj.start(scene, dict(zip(known, y, strict=True)))))(jnp.asarray(y))


def final_states(scene: jj.Scene, end, alone=False, **options):
    """Return a compiled function of a tolerance and starts; `alone`: one motion after another inside one
    compiled program, not a batch.
    """
    integrated = jnp.array(jj.lower(scene).independent)

    @jax.jit
    def run(tolerance, starts):
        more = {"ts": jnp.array([end]), "rtol": tolerance, "atol": tolerance, **options}
        if alone:
            found = jax.lax.map(lambda start: jj.simulate(scene, start, **more), starts)
        else:
            found = jj.rollout(scene, starts, **more).lanes
        return jnp.concatenate([found.q_end, found.u_end[:, integrated]], axis=1)

    return lambda tolerance, starts: jax.block_until_ready(run(tolerance, starts))
