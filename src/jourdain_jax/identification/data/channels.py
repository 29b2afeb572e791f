"""Channels defined by functions of a `Motion`. Each function is traced once.

Two channels are equal if they perform the same operations; captured values become arguments. A new lambda
with the same operations is therefore the same channel and is not compiled again. A function whose globals
have changed is a new channel.

Instruments for accelerations and forces: accelerometers on bodies, load cells under contacts.

    f = R' (a_P - g),     a_P = d/dt (v + omega x (P - r)) along (1, qdot, udot)

f: reading of an accelerometer at the point P; R, r, v, omega: orientation, mass centre, velocity and angular
velocity of the body; g: gravity. Source: D. H. Titterton and J. L. Weston, Strapdown Inertial Navigation
Technology, 2nd ed. (2004), section 3.

The residual of a measured time (`value`) of the stop event that ended a run:

    r = (t_event - value) / sigma        t_event: time at which the simulated motion stops at the event

A motion stops at its first event, so a run has at most one. The measured time is a channel with one value, at
the last sample of the run, which is the first sample at or after the event.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Scalar,
    Shape,
    Vector,
    Vector3,
    array_module,
    check_kind,
    checked_known,
    checked_real,
    is_traced,
    real_type,
    static,
)
from jourdain_jax.dynamics.accelerations import accelerations
from jourdain_jax.dynamics.reactions import contact_forces
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.equations.rows import names_of_events
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.program.calls import Call
from jourdain_jax.scene.coordinates import check_name, nearest
from jourdain_jax.scene.identity import once_per_class, once_per_values
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.outside_names import now_read_by
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.sampling import sample_states

OverTimes = Float[Array, "times 3"]


class Channel(eqx.Module):
    """A traced function of a motion."""

    operations: Call = static()  # functions of captured values and of the numbers of a motion
    held: tuple[Array, ...]  # captured values
    shape: Shape = static()

    def __call__(self, motion: Motion) -> Array:
        """Return the value of the channel at one instant."""
        return self.operations.results(*self.held, *jax.tree.leaves(motion))[0]


def channel(function: Callable, scene: Scene) -> Channel:
    """Return a channel for a function of a motion of this scene. The function is traced again only if it or
    the values that it reads have changed.
    """
    now = now_read_by(function)
    if now is None:
        return _traced(function, scene)
    kept, key = _kept(function), (now, _kind(scene))
    if kept.get("key") == key:
        return kept["channel"]
    found = _traced(function, scene)
    if not is_traced(found.held):
        kept["key"], kept["channel"] = key, found
    return found


@lru_cache(maxsize=256)
def _kept(function: Callable) -> dict:
    return {}


def _traced(function: Callable, scene: Scene) -> Channel:
    try:
        closed, shape = jax.make_jaxpr(lambda motion: function(motion), return_shape=True)(
            motion_shape(scene)
        )
    except TypeError as error:
        advice = (
            "write it with `jax.numpy`, without `if` on numbers of the motion, and return one array of "
            "numbers"
        )
        raise ValueError(
            f"a function of `sensors` cannot be called with a motion ({str(error).splitlines()[0]}); {advice}"
        ) from error
    if not hasattr(shape, "shape"):
        raise ValueError(
            f"a function of `sensors` returned {type(shape).__name__}, expected an array of "
            "numbers; return one array"
        )
    jaxpr = closed.jaxpr
    operations = ClosedJaxpr(jaxpr.replace(constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars]), [])
    return Channel(
        Call(operations, ("a channel",)), tuple(jnp.asarray(x) for x in closed.consts), shape.shape
    )


def _kind(scene: Scene):
    leaves, treedef = jax.tree.flatten(scene)
    return treedef, tuple((x.shape, x.dtype) for x in leaves)


@once_per_class
def motion_shape(scene: Scene) -> Motion:
    """Return the shapes of a motion of this scene."""
    scene = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), scene)
    q, u = (
        jax.ShapeDtypeStruct((len(names),), real_type())
        for names in (scene.coordinate_names, scene.speed_names)
    )
    return jax.eval_shape(lambda scene, q, u: motion_at(scene, 0.0, q, u), scene, q, u)


class Instrument(eqx.Module):
    """An instrument with three components that depend on accelerations of a scene."""

    @abstractmethod
    def check(self, scene: Scene, channel: str, where: str) -> None:
        """Raise ValueError, naming channel and run, if the scene lacks the measured quantity."""

    @abstractmethod
    def over_times(self, motion: Trajectory) -> OverTimes:
        """Return the readings at all times of one motion."""


class Accelerometer(Instrument):
    """Three accelerometers at a point of a body, along its axes: the specific force `R' (a - g)` in m/s^2. At
    rest it points up and has the magnitude of g.

        frame = jj.identification.Accelerometer("frame", (0.3, 0.0, 0.1))
        imu = jj.identification.Sensor(frame, bias=jj.Estimate((0.0, 0.0, 0.0)))
        # a: (times, 3), m/s^2
        jj.Experiment(ts, {"imu": a}, 0.1, start=start, sensors={"imu": imu})

    - `body`: name of the body. `point`: position from its mass centre, in the body's frame, m.
    - `gravity`: g in m/s^2, in the inertial frame.

    Its channel has shape (times, 3). Accelerations are computed from the equations of motion, not by
    differences.

    **Raises** ValueError unless `body` is a name, and `point` and `gravity` have three components.
    """

    body: str = static()
    point: Vector3  # m
    gravity: Vector3  # m/s^2

    def __init__(self, body: str, point: Vector = (0.0, 0.0, 0.0), gravity: Vector = (0.0, 0.0, -9.81)):
        check_kind(body, str, "`body` of `Accelerometer`", "the name of a body")
        self.body = body
        advice = "give three components in the body's frame, m"
        self.point = checked_real(point, "`point` of `Accelerometer`", (3,), advice=advice)
        advice = "give three components in the inertial frame, m/s^2"
        self.gravity = checked_real(gravity, "`gravity` of `Accelerometer`", (3,), advice=advice)

    def check(self, scene: Scene, channel: str, where: str) -> None:
        """Raise ValueError, naming the `channel` and the run (`where`), if the scene has no such body."""
        bodies = motion_shape(scene).bodies
        what = f"the accelerometer `{channel}` of {where} is on body `{self.body}`, which does not exist"
        check_name(self.body, bodies, what)

    def over_times(self, motion: Trajectory) -> OverTimes:
        """Return the readings at all times of one motion."""
        return jax.vmap(lambda *state: self._felt(motion.scene, *state))(
            motion.ts, motion.q, motion.u, motion.accelerations().udot
        )

    def _felt(self, scene: Scene, t, q, u, udot) -> Vector3:
        def velocity(t, q, u):
            body = motion_at(scene, t, q, u)[self.body]
            return body.velocity_at(body.place(self.point)), body.orientation

        along = jnp.ones_like(t), coordinate_rates(scene, t, q, u), udot
        (_, orientation), (acceleration, _) = jax.jvp(velocity, (t, q, u), along)
        return orientation.T @ (acceleration - self.gravity.astype(q.dtype))


class LoadCell(Instrument):
    """A load cell under a rolling contact: the force of the ground on the body, in N.

        plate = jj.identification.LoadCell("front")
        # force: (times, 3), N
        jj.Experiment(ts, {"plate": force}, 2.0, start=start, sensors={"plate": plate})

    - `contact`: name of the contact.

    Its channel has shape (times, 3): two components along the tangents of the ground, then one along its
    normal, as in `Trajectory.contact_forces`.

    **Raises** ValueError unless `contact` is a name. `fit` raises it for a scene without this contact, or if
    the constraints do not determine its force.
    """

    contact: str = static()

    def __init__(self, contact: str):
        check_kind(contact, str, "`contact` of `LoadCell`", "the name of a contact")
        self.contact = contact

    def check(self, scene: Scene, channel: str, where: str) -> None:
        """Raise ValueError if the scene has no such contact or its force is not determined. The message names
        the `channel` and the run (`where`).
        """
        determined = _determined(scene)
        what = f"the load cell `{channel}` of {where} is under contact `{self.contact}`"
        check_name(self.contact, determined, f"{what}, which does not exist")
        if not determined[self.contact]:
            raise ValueError(
                f"{what}, whose force is not determined, because other contacts share it; omit the channel"
            )

    def over_times(self, motion: Trajectory) -> OverTimes:
        """Return the readings at all times of one motion."""
        force = motion.contact_forces()[self.contact]
        return jnp.concatenate([force.tangential, force.normal[..., None]], axis=-1)


@once_per_values
def _determined(scene: Scene) -> dict[str, bool]:
    """Map each contact to whether its force is determined at a state of the scene."""
    t, q, u = (x[0] for x in sample_states(scene, 1))
    return {
        name: bool(force.determined)
        for name, force in contact_forces(scene, t, q, u, accelerations(scene, t, q, u)).items()
    }


LATEST = 4.0  # numerics: in observed times, the latest permitted time of the simulated event


class StopEvent(eqx.Module):
    """A stop event of a scene, by name, whose time was measured."""

    name: str = static()

    @staticmethod
    def of(scene: Scene, name: str, where: str) -> "StopEvent":
        """Return the event called `name`. Raises ValueError if the scene has no such event."""
        if name not in (names := names_of_events(scene)):
            has = nearest(name, names) if names else "it has no stop events."
            raise ValueError(f"`events` of {where} names `{name}`, which is not an event of the scene; {has}")
        return StopEvent(name)

    def time(self, motion: Callable, t0, span) -> Scalar:
        """Return the time at which the motion stops at the event, or NaN if it does not. `motion(ts)`
        simulates the run with events; `span`: time from the start to the observed event.
        """
        found = motion((t0 + LATEST * span)[None])
        return jnp.where(found.event == found.event_names.index(self.name), found.t_end, jnp.nan)


def cut(events: Mapping, t0, ts, values: dict, sigma: dict) -> tuple:
    """Return times, values and sigmas of a run up to its event, whose time becomes another channel (a vector
    for repeats). Raises ValueError for impossible times.
    """
    if len(events) > 1:
        raise ValueError(
            f"`events` names {', '.join(f'`{name}`' for name in events)}, but a motion stops at its first "
            "event; give only that one"
        )
    ((name, given),) = events.items()
    if name in values:
        raise ValueError(
            f"`{name}` is both a channel and an event; give the channel another name, with a sensor"
        )
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise ValueError(
            f"event `{name}` was given {given!r}, expected (time, sigma), both in s, such as (1.83, 0.005)"
        )
    at, spread = (
        checked_known(x, f"{what} of event `{name}`", advice="give a number in s")
        for x, what in zip(given, ("the time", "sigma"), strict=True)
    )
    if is_traced((ts, t0)) or at.ndim > 1 or not np.all(at > t0):
        raise ValueError(
            f"the time of event `{name}` is {at} s, expected a time after the start at t0 = "
            f"{t0} s (for `fit_batch` a vector with one time per repeat)"
        )
    last = min(int(np.searchsorted(ts, at.max())), len(ts) - 1)
    kept, axis = slice(last + 1), at.ndim
    after = ts[kept] > at[..., None]

    def until(x):
        # wrong shapes are reported later, by a check with the scene
        if x.ndim <= axis or x.shape[axis] != len(ts):
            return x
        part = x[:, kept] if axis else x[kept]
        return array_module(x).where(after.reshape(after.shape + (1,) * (x.ndim - after.ndim)), np.nan, part)

    of_event = np.full((*at.shape, last + 1), np.nan)
    of_event[..., -1] = at
    return (
        ts[kept],
        {channel: until(x) for channel, x in values.items()} | {name: of_event},
        {channel: x[kept] if x.ndim and x.shape[0] == len(ts) else x for channel, x in sigma.items()}
        | {name: spread},
    )
