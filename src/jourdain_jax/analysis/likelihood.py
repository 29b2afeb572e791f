"""What a scene predicts for measurements, and how likely it makes them.

r = (channel(motion) - value) / sigma,   log L = - sum r^2 / 2 - sum log(sigma sqrt(2 pi))
"""

from collections.abc import Callable, Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.analysis.measurements import Measurements, checked
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import as_scene
from jourdain_jax.scene.numbers import described
from jourdain_jax.scene.scene import Scene


def as_runs(scene: Scene, data: Measurements | Sequence[Measurements], *, repeats: bool = False) -> tuple[Measurements, ...]:
    """One run or several, checked against the scene; ValueError as in `checked`, and where there is no run."""
    as_scene(scene)
    if not isinstance(data, Measurements | Iterable):
        raise ValueError(f"`data` is {described(data)}, expected a `Measurements` or a sequence of at least one")
    runs = (data,) if isinstance(data, Measurements) else tuple(data)
    if not runs or not all(isinstance(run, Measurements) for run in runs):
        raise ValueError("`data` must be a `Measurements` or a sequence of at least one")
    return tuple(checked(scene, run, index, repeats) for index, run in enumerate(runs))


def log_likelihood(scene: Scene, data: Measurements | Sequence[Measurements], **simulation) -> Float[Array, ""]:
    """Logarithm of the probability density of the measurements `data` (one run or several): `- sum r^2 / 2 - sum log(sigma sqrt(2 pi))`.

    Differentiable in scene, start values, measured values and sigmas (reverse mode, unless `adjoint` says otherwise); -inf where
    the motion fails. `simulation`: options of `simulate`. Samples with an infinite sigma do not count.

        jax.grad(lambda a: jj.log_likelihood(sleigh.replace(offset=a), data))(0.25)

    **Raises** ValueError for measurements that do not fit the scene.
    """
    runs = as_runs(scene, data)
    total = jnp.zeros(())
    for run, weighted in zip(runs, residuals(scene, runs, simulate, simulation), strict=True):
        for name, r in weighted.items():
            sigma = run.sigma_of(name)
            counted = jnp.isfinite(sigma)
            total = total - jnp.sum(jnp.where(counted, 0.5 * r**2 + jnp.log(jnp.where(counted, sigma, 1.0) * jnp.sqrt(2 * jnp.pi)), 0.0))
    return jnp.where(jnp.isfinite(total), total, -jnp.inf)


def residuals(scene: Scene, runs: Sequence[Measurements], simulate: Callable, simulation: dict) -> list[dict[str, Float[Array, "..."]]]:
    """`(prediction - value) / sigma`, shape (times, *channel), by run and channel; runs of equal shapes are one batch."""
    found: dict[int, dict] = {}
    for group in _alike(runs):
        if len(group) == 1:
            found[group[0]] = _residuals(scene, runs[group[0]], simulate, simulation)
            continue
        parts = [eqx.partition(runs[i], eqx.is_array) for i in group]
        stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *(arrays for arrays, _ in parts))
        together = jax.vmap(lambda arrays, rest=parts[0][1]: _residuals(scene, eqx.combine(arrays, rest), simulate, simulation))(stacked)
        found |= {i: {name: r[k] for name, r in together.items()} for k, i in enumerate(group)}
    return [found[i] for i in range(len(runs))]


def _alike(runs: Sequence[Measurements]) -> list[list[int]]:
    """Indices of the runs, grouped by equal structure, shapes and functions."""
    groups: list[tuple[tuple, list[int]]] = []
    for index, run in enumerate(runs):
        arrays, rest = eqx.partition(run, eqx.is_array)
        kind = (jax.tree.structure(run), [x.shape for x in jax.tree.leaves(arrays)], jax.tree.leaves(rest))
        for known, members in groups:
            if known == kind:
                members.append(index)
                break
        else:
            groups.append((kind, [index]))
    return [members for _, members in groups]


def _residuals(scene: Scene, run: Measurements, simulate: Callable, simulation: dict) -> dict[str, Float[Array, "..."]]:
    motion = simulate(scene, run.start, t0=run.t0, ts=run.ts, inputs=run.inputs, events=False, work=False, **simulation)
    states = motion.motions() if run.functions else None
    predicted = {name: jax.vmap(run.functions[name])(states) if name in run.functions else motion[name] for name in run.values}
    return {name: (predicted[name] - value) / run.sigma_of(name) for name, value in run.values.items()}
