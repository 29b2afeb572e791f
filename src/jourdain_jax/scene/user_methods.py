"""Calls of a scene's methods with checks of their results. A wrong result raises a ValueError that names the
method and the expected result.

The checks read types and shapes only. Both are known during tracing, so the checks add nothing to
compiled programs.
"""

from collections.abc import Iterable, Mapping
from typing import get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import PerCoordinate, Scalar, Shape, check_kind, checked_real, described
from jourdain_jax.scene.bodies import Body, Visual
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.coordinates import Named, check_names, nearest
from jourdain_jax.scene.loads import Gravity, HeldRow, JointFriction, Load, held_rows
from jourdain_jax.scene.modes import FLIES, ROLLS, Event
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene, state_names

_VANISH = "return numbers that vanish if the constraint holds"


def bodies_of(scene: Scene, t, q: Named) -> dict[str, Body]:
    """Return the bodies of a scene by name."""
    bodies = _dictionary(scene, "bodies", (t, q), '{"disc": jj.RigidBody(...)}')
    if not bodies:
        raise ValueError(
            f"`bodies` of `{_name(scene)}` returned no body; return at least one by name, such "
            'as {"disc": jj.RigidBody(...)}'
        )
    for name, body in bodies.items():
        check_kind(
            body, get_args(Body), f"body `{name}` of `{_name(scene)}`", "a `jj.Particle` or a `jj.RigidBody`"
        )
    return bodies


def coordinate_rates_of(scene: Scene, t, q: Named, u: Named) -> PerCoordinate:
    """Return the rates of all coordinates."""
    # directions of slip are the last coordinates, with zero rates
    directions = 2 * len(scene.switching.contacts)
    names = scene.coordinate_names.entries[: len(scene.coordinate_names) - directions]
    rates = checked_real(
        scene.coordinate_rates(t, q, u),
        f"the result of `coordinate_rates` of `{_name(scene)}`",
        (len(names),),
        advice=f"return one rate for each of {', '.join(names)}, in this order, such as jnp.stack([...])",
    )
    return jnp.concatenate([rates, jnp.zeros(directions, rates.dtype)]) if directions else rates


def loads_of(scene: Scene, motion: Motion) -> tuple[Load, ...]:
    """Return the loads of a scene; a single load becomes a tuple of one."""
    given = scene.loads(motion)
    given = (given,) if isinstance(given, Load) else given
    if not isinstance(given, Iterable) or isinstance(given, dict | str):
        raise ValueError(
            f"`loads` of `{_name(scene)}` returned {described(given)}, expected a tuple of "
            "loads; write `return (jj.gravity(motion, 9.81),)`"
        )
    return tuple(_checked_load(scene, i, load) for i, load in enumerate(given))


def _checked_load(scene: Scene, i: int, load) -> Load:
    where = f"load {i} of `{_name(scene)}`"
    check_kind(load, Load, where, "a load, such as jj.point_force(...) or jj.Load(forces=...)")
    if isinstance(load, JointFriction):
        _declared(scene, load.rows, "loads", "joint_friction")
        return load
    checked = Load(
        forces={
            body: checked_real(value, f"force of {where} on body `{body}`", (3,))
            for body, value in load.forces.items()
        },
        torques={
            body: checked_real(value, f"torque of {where} on body `{body}`", (3,))
            for body, value in load.torques.items()
        },
        generalized={
            speed: checked_real(value, f"force of {where} on speed `{speed}`", ())
            for speed, value in load.generalized.items()
        },
        potential=(
            None if load.potential is None else checked_real(load.potential, f"potential of {where}", ())
        ),
    )
    return (
        Gravity(checked.forces, checked.potential, load.direction) if isinstance(load, Gravity) else checked
    )


def potential_of(scene: Scene, pose: Pose) -> Scalar | None:
    """Return the scene's own potential energy, J; None if there is none."""
    V, what = scene.potential(pose), f"the result of `potential` of `{_name(scene)}`"
    return None if V is None else checked_real(V, what, (), advice="return the energy in J, or None")


def gauge_of(scene: Scene, pose: Pose) -> Scalar | None:
    """Return the scene's gauge function, J s; None if there is none."""
    S, what = scene.gauge(pose), f"the result of `gauge` of `{_name(scene)}`"
    return None if S is None else checked_real(S, what, (), advice="return a number in J s, or None")


def prescribed_of(scene: Scene, t) -> dict[str, Scalar]:
    """Return the prescribed coordinates and their values."""
    advice = "prescribe every coordinate by its own name"
    return _numbers(scene, "prescribed", t, '{"x": 0.1 * jnp.sin(t)}', "prescribed value of", advice)


def geometric_constraints_of(scene: Scene, pose: Pose) -> dict[str, Array]:
    """Return values of the scene's own geometric constraints."""
    return _numbers(scene, "geometric_constraints", pose, '{"edge": value}', "constraint", _VANISH, None)


def velocity_constraints_of(scene: Scene, motion: Motion) -> dict[str, Array]:
    """Return values of the scene's own velocity constraints, except those that may slip."""
    given = _dictionary(scene, "velocity_constraints", (motion,), '{"edge": value}')
    always = {name: value for name, value in given.items() if not isinstance(value, HeldRow)}
    _declared(scene, given.keys() - always, "velocity_constraints", "holds=")
    return _checked(scene, always, "constraint", _VANISH, None)


def _declared(scene: Scene, names: Iterable[str], method: str, word: str) -> None:
    for name in names:
        if name not in scene.switching.contacts:
            raise ValueError(
                f"no friction of `{name}` of `{_name(scene)}` was found when the scene was made; write "
                f"`{word}` in `{method}` itself, not in a function that it calls, and for every state"
            )


def held_rows_of(scene: Scene, motion: Motion) -> dict[str, HeldRow]:
    """Return the velocity constraints that slip if their force exceeds a limit, by name."""
    if not scene.switching.rows:
        return {}
    return held_rows(scene.velocity_constraints(motion), loads_of(scene, motion))


def contacts_of(scene: Scene, pose: Pose) -> dict[str, Contact]:
    """Return the contacts by name. In a phase, those that fly are absent, and those that roll have no
    friction.
    """
    phase = dict(scene.switching.phase)
    contacts = _dictionary(scene, "contacts", (pose,), '{"rim": jj.disc_contact(pose["disc"], radius)}')
    for name, contact in contacts.items():
        check_kind(
            contact,
            Contact,
            f"contact `{name}` of `{_name(scene)}`",
            "a `jj.disc_contact(...)` or another contact",
        )
        if (contact.friction is not None) != (name in scene.switching.contacts or name in phase):
            raise ValueError(
                f"contact `{name}` of `{_name(scene)}` gained or lost its friction after the scene was made; "
                "write `friction=` in `contacts` itself, not in a function that it calls, for every state or "
                "for none"
            )
    return {
        name: eqx.tree_at(lambda c: c.friction, contact, None) if phase.get(name) == ROLLS else contact
        for name, contact in contacts.items()
        if phase.get(name) != FLIES
    }


def events_of(scene: Scene, motion: Motion) -> dict[str, Event]:
    """Return the events by name; a plain value becomes an event that stops the motion."""
    advice = (
        "return a number, positive while the motion may continue, such as `1.4 - motion.q.lean`; name every "
        "condition"
    )
    found = {}
    for name, given in _dictionary(scene, "events", (motion,), '{"fallen": 1.4 - motion.q.lean}').items():
        event = given if isinstance(given, Event) else Event(given, stop=True)
        where = f"event `{name}` of `{_name(scene)}`"
        for what, changed in (("to", event.to), ("jump", event.jump)):
            check_kind(changed, Mapping, f"`{what}` of {where}", "a dictionary by name")
        if event.stop and (event.to or event.jump):
            raise ValueError(
                f"{where} stops the motion, so it cannot switch anything; omit `to` and `jump`, or `stop`"
            )
        check_names(event.to, dict(scene.modes.pairs), f"{where} switches `{{}}`, which is not a mode")
        check_names(
            event.jump, state_names(scene), f"{where} moves `{{}}`, which is not a coordinate or speed"
        )
        found[name] = Event(
            checked_real(event.value, where, (), advice=advice),
            {
                mode: checked_real(scene.modes.number(mode, value, where), f"mode `{mode}` of {where}", ())
                for mode, value in event.to.items()
            },
            {
                moved: checked_real(value, f"`{moved}` after {where}", ())
                for moved, value in event.jump.items()
            },
            event.stop,
        )
    return found


def invariants_of(scene: Scene, motion: Motion) -> dict[str, Scalar]:
    """Return values of the conserved quantities by name."""
    advice = "give every component its own name"
    return _numbers(
        scene, "invariants", motion, '{"momentum x": body.mass * body.velocity[0]}', "invariant", advice
    )


def visuals_of(scene: Scene, pose: Pose) -> dict[str, tuple[Visual, ...]]:
    """Return the scene's own shapes of its bodies; shapes under the name `""` are fixed in the
    inertial frame.
    """
    given = _dictionary(scene, "visuals", (pose,), '{"ball": jj.Visual.ball(0.1)}')
    found = {}
    for name, looks in given.items():
        if name and name not in pose:
            raise ValueError(
                f'`visuals` of `{_name(scene)}` names `{name}`, which is neither a body nor "" '
                f"(the inertial frame); {nearest(name, pose.bodies)}"
            )
        found[name] = tuple(looks) if isinstance(looks, list | tuple) else (looks,)
        for look in found[name]:
            if not isinstance(look, Visual):
                raise ValueError(
                    f"`visuals` of `{_name(scene)}` gives {described(look)} for `{name}`, "
                    "expected shapes, such as jj.Visual.ball(0.1)"
                )
    return found


def _dictionary(scene: Scene, method: str, at: tuple, example: str) -> dict:
    """Return a method's result, which must be a dictionary by name."""
    given = getattr(scene, method)(*at)
    if not isinstance(given, dict):
        raise ValueError(
            f"`{method}` of `{_name(scene)}` returned {described(given)}, expected a dictionary "
            f"by name; write `return {example}`"
        )
    for name in given:
        if not isinstance(name, str):
            raise ValueError(
                f"`{method}` of `{_name(scene)}` returned a dictionary with the key {name!r}, "
                "expected names (texts) as keys"
            )
    return given


def _numbers(
    scene: Scene, method: str, at, example: str, what: str, advice: str, shape: Shape | None = ()
) -> dict[str, Array]:
    """Return a method's result at a time, pose or motion: numbers by name, or arrays. `shape`: required shape
    of each value; None: any shape.
    """
    return _checked(scene, _dictionary(scene, method, (at,), example), what, advice, shape)


def _checked(scene: Scene, given: dict, what: str, advice: str, shape: Shape | None) -> dict[str, Array]:
    return {
        name: checked_real(value, f"{what} `{name}` of `{_name(scene)}`", shape, advice=advice)
        for name, value in given.items()
    }


def _name(scene: Scene) -> str:
    return type(scene).__name__
