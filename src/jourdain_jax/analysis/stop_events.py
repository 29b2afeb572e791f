"""The stop event that ended a run, at a time that was observed: one measured value more.

r = (t_event - value) / sigma        t_event: when the motion stops there; its derivatives are those of `simulate`

The events of a scene stop its motion, so that a run has one. It is kept as a channel whose only value is at the last sample of the run: the first one that is
not before the event.
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import checked_known, is_traced
from jourdain_jax.equations.listed import names_of_events
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene

LATEST = 4.0  # times the observed time: where a motion meets the event later than that, or another one before, it fails


class StopEvent(eqx.Module):
    """An event of a scene by name, for whose time there is a measured value."""

    name: str = eqx.field(static=True)

    @staticmethod
    def of(scene: Scene, name: str, where: str) -> "StopEvent":
        """ValueError where the scene has no such event."""
        if name not in (names := names_of_events(scene)):
            has = nearest(name, names) if names else "it has no stop events."
            raise ValueError(f"`events` of {where} names `{name}`, which is no event of the scene; {has}")
        return StopEvent(name)

    def time(self, motion: Callable, t0, span) -> Float[Array, ""]:
        """When the motion stops at it, NaN where it does not. `motion`: of times, with its events; `span`: from the start to the observed time."""
        found = motion((t0 + LATEST * span)[None])
        return jnp.where(found.event == found.event_names.index(self.name), found.t_end, jnp.nan)


def cut(events: Mapping, t0, ts, values: dict, sigma: dict) -> tuple:
    """Times, values and sigmas of a run up to its event, whose time is one channel more; a vector of times: of repeats. ValueError for what is no such time."""
    if len(events) > 1:
        raise ValueError(f"`events` names {', '.join(f'`{name}`' for name in events)}, but a motion stops at the first of its events; give that one")
    ((name, given),) = events.items()
    if name in values:
        raise ValueError(f"`{name}` is both a channel and an event; give the channel another name, with a sensor")
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise ValueError(f"event `{name}` was given {given!r}, expected (time, sigma), both in s, such as (1.83, 0.005)")
    at, spread = (checked_known(x, f"{what} of event `{name}`", advice="give a number in s") for x, what in zip(given, ("the time", "sigma"), strict=True))
    if is_traced((ts, t0)) or at.ndim > 1 or not np.all(at > t0):
        raise ValueError(f"the time of event `{name}` is {at} s, expected one after the start at t0 = {t0} s (of `fit_batch` a vector, one of each repeat)")
    last = min(int(np.searchsorted(ts, at.max())), len(ts) - 1)
    kept, axis = slice(last + 1), at.ndim
    after = ts[kept] > at[..., None]

    def until(x):
        if x.ndim <= axis or x.shape[axis] != len(ts):  # of another shape: that is said once the scene is known
            return x
        part = x[:, kept] if axis else x[kept]
        return (jnp if is_traced(x) else np).where(after.reshape(after.shape + (1,) * (x.ndim - after.ndim)), np.nan, part)

    of_event = np.full((*at.shape, last + 1), np.nan)
    of_event[..., -1] = at
    return (
        ts[kept],
        {channel: until(x) for channel, x in values.items()} | {name: of_event},
        {channel: x[kept] if x.ndim and x.shape[0] == len(ts) else x for channel, x in sigma.items()} | {name: spread},
    )
