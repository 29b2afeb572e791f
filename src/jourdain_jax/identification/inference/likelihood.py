"""The likelihood of measurements, given a scene.

r = (reading - value) / sigma,   log L = - sum r^2 / 2 - sum log(sigma sqrt(2 pi))      (white noise)
"""

from collections.abc import Callable
from functools import partial
from typing import Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import Scalar
from jourdain_jax.identification.data.experiment import Data
from jourdain_jax.identification.data.run_preparation import as_fit_options, as_runs, check_known
from jourdain_jax.identification.inference.correlated_noise import log_densities
from jourdain_jax.identification.solve.run_groups import equal_runs
from jourdain_jax.identification.solve.shooting import Run
from jourdain_jax.motion.options import AllOptions, OptionFields, Options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.scene import Scene


def log_likelihood(
    scene: Scene | BuiltFor, data: Data, *, options: Options | None = None, **by_name: Unpack[OptionFields]
) -> Scalar:
    """Return the logarithm of the probability density of the measurements `data` (one run or several): `- sum
    r^2 / 2 - sum log(sigma sqrt(2 pi))`.

    The result is differentiable with respect to the scene, start values, measured values, sigmas, numbers of
    sensors and actuators (reverse mode, unless `adjoint` requests another) and known correlation times of the
    noise. It is -inf if the motion fails. Missing samples (NaN, or an infinite sigma) are omitted. `options`,
    `by_name`: as in `simulate`.

        jax.grad(lambda a: jj.identification.log_likelihood(sleigh.replace(offset=a), data))(0.25)

    **Raises** ValueError for measurements that do not fit the scene.
    """
    settled = as_fit_options(scene, options, by_name, "log_likelihood")
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    if unknown := sorted({name for run in runs for name in run.unknown_correlation}):
        raise ValueError(
            f"the correlation time of channel `{unknown[0]}` is None, but a likelihood needs it; give a "
            "number in s, or 0 for white noise"
        )
    check_known(runs, "a likelihood")
    of = partial(of_run, scene, options=settled)
    return jnp.sum(jnp.stack([jnp.sum(mapped(of, run)) for _, run in equal_runs(runs)]))


def of_run(scene: Scene, run: Run, *, options: AllOptions) -> Scalar:
    """Return the logarithm of the density of the measurements of one run; -inf if its motion fails."""
    found = sum(map(jnp.sum, of_samples(scene, run, options=options).values()), jnp.zeros(()))
    return jnp.where(jnp.isfinite(found), found, -jnp.inf)


def of_samples(scene: Scene, run: Run, *, options: AllOptions) -> dict[str, Array]:
    """Return the logarithm of the density of each sample by channel: zero for a missing one, and given the
    samples before it if noise is correlated.
    """
    found = {}
    for name, r in run.residuals(scene, simulate, options).items():
        weight = run.weights[name]
        counted = weight > 0
        # log sigma = - log weight
        logs = jnp.log(jnp.where(counted, weight, 1.0) / jnp.sqrt(2 * jnp.pi))
        tau = run.correlation_time.get(name)
        of_r = -0.5 * r**2 if tau is None else log_densities(r, weight, run.ts, tau)
        found[name] = jnp.where(counted, logs, 0.0) + of_r
    return found


def mapped(f: Callable, runs: Run, *more: Array):
    """Return `f(run, *more)` for each of the stacked runs. A single run is not batched, since batches use
    wider, slower registers.
    """
    if runs.ts.shape[0] > 1:
        return eqx.filter_vmap(f)(runs, *more)
    found = f(*jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, (runs, *more)))
    return jax.tree.map(lambda x: x[None], found)
