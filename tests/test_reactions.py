"""Constraint forces by row and by body, and contact forces, against statics, closed forms and the principle
of virtual power.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_scenes as small
from numpy.testing import assert_allclose
from tolerances import ROUND_OFF

import jourdain_jax as jj
from jourdain_jax import diagnose
from jourdain_jax.dynamics.reactions import contact_forces, row_reactions
from jourdain_jax.equations import partial_velocities
from jourdain_jax.models import (
    BallOnTurntable,
    ChaplyginSleigh,
    TiltingDiscQuaternion,
    TwoWheelAxleRedundant,
    VerticalDisc,
    WhippleBicycle,
)
from jourdain_jax.program.eager import eval_numpy

SCENES = [
    TwoWheelAxleRedundant(),
    ChaplyginSleigh(),
    small.DrivenPendulum(),
    BallOnTurntable(tilt=0.1),
    TiltingDiscQuaternion(),
    WhippleBicycle(),
]


@pytest.mark.parametrize("scene", SCENES, ids=small.name_of)
def test_forces_by_row_and_body_have_the_virtual_power_of_the_multipliers(scene):
    @eval_numpy
    @jax.vmap
    def compare(t, q, u):
        found = jj.accelerations(scene, t, q, u)
        rows = row_reactions(scene, t, q, u, found)
        partial, motion = partial_velocities(scene, t, q, u), jj.motion_at(scene, t, q, u)
        turned = jnp.stack([body.orientation for body in motion.bodies.values()])
        gamma = jnp.einsum("bij,bjk->bik", turned, partial.angular)  # space axes
        power = jnp.einsum("sbi,bik->k", rows.force, partial.linear) + jnp.einsum(
            "sbi,bik->k", rows.torque, gamma
        )
        return power + jnp.sum(rows.direct, axis=0), found.constraint_force

    states = [jnp.asarray(x) for x in jj.sample_states(scene, 10)]
    by_body, expected = compare(*states)
    assert jnp.max(jnp.abs(by_body - expected)) <= ROUND_OFF * jnp.max(jnp.abs(expected))


def at_a_state(scene):
    """Coordinates, and what rows exert there."""
    t, q, u = (jnp.asarray(x[0]) for x in jj.sample_states(scene, 1))
    return q, row_reactions(scene, t, q, u, jj.accelerations(scene, t, q, u))


def test_the_forces_of_a_blade_act_sideways_at_the_blade():
    q, rows = at_a_state(ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25))
    force, torque = rows.forces_on("sleigh")["blade"], rows.torques_on("sleigh")["blade"]
    heading = q[2]
    sideways, forward = (
        jnp.array([-jnp.sin(heading), jnp.cos(heading), 0.0]),
        jnp.array([jnp.cos(heading), jnp.sin(heading), 0.0]),
    )
    # the blade is `offset` behind the mass centre: torque = -offset * sideways force
    assert jnp.abs(force @ forward) <= ROUND_OFF
    assert_allclose(torque, jnp.array([0.0, 0.0, -0.25 * (force @ sideways)]), atol=ROUND_OFF)


def test_multipliers_of_dependent_rows_are_marked_as_not_determined():
    _, rows = at_a_state(TwoWheelAxleRedundant())
    unique = dict(zip(rows.row_names, rows.determined.tolist(), strict=True))
    # across the axle wheels and axle share the load as they like; the heights and the common heading are each
    # their own
    assert {row for row, alone in unique.items() if alone} == {
        "one heading",
        "wheel1 height",
        "wheel2 height",
    }


def rim(scene, q, u):
    """The force of the contact of this name."""
    return contact_forces(scene, 0.0, q, u, jj.accelerations(scene, 0.0, q, u))["rim"]


def test_a_vertical_disc_presses_with_its_weight_and_needs_the_friction_of_its_turn():
    # B4: multipliers -m w_heading R w_spin (sin heading, -cos heading); N = m g
    scene = VerticalDisc(mass=1.4, radius=0.7)
    q, u, _ = scene.named(
        heading=0.4, heading_rate=2.0, roll_rate=1.5, x_rate=1.05 * jnp.cos(0.4), y_rate=1.05 * jnp.sin(0.4)
    )
    contact = rim(scene, q, u)
    centripetal = 1.4 * 2.0 * 0.7 * 1.5
    assert_allclose(contact.normal, 1.4 * 9.81, rtol=ROUND_OFF)
    assert_allclose(
        contact.tangential, centripetal * jnp.array([-jnp.sin(0.4), jnp.cos(0.4)]), rtol=ROUND_OFF
    )
    assert_allclose(contact.friction_needed, centripetal / (1.4 * 9.81), rtol=ROUND_OFF)
    assert contact.determined
    assert not contact.pulls


def test_a_contact_that_would_have_to_pull_is_flagged():
    scene = small.DiscWithHeightRow(gravity=-9.81)
    contact = rim(scene, *scene.named()[:2])
    assert contact.pulls
    assert contact.normal < 0
    assert jnp.isinf(contact.friction_needed)


def test_a_contact_without_any_load_bears_nothing_and_is_honest():
    motion = jj.simulate(VerticalDisc(gravity=0.0), {"roll_rate": 3.0}, t1=1.0)  # straight on
    found = diagnose(motion).contacts["rim"]
    assert found.honest
    assert max(abs(found.lowest_normal), abs(found.highest_normal)) <= ROUND_OFF
    assert found.friction_needed == 0.0
    assert not np.any(motion.contact_forces()["rim"].pulls)
    assert "PULL" not in str(motion)


def test_a_contact_that_presses_nowhere_and_is_pushed_sideways_needs_infinite_friction():
    # no gravity, a turn: centripetal force m w_heading R w_roll without a normal force
    scene = VerticalDisc(mass=1.4, radius=0.7, gravity=0.0)
    contact = rim(scene, *scene.named(heading_rate=2.0, roll_rate=1.5, x_rate=1.05)[:2])
    assert_allclose(contact.tangential, 1.4 * 2.0 * 0.7 * 1.5 * jnp.array([0.0, 1.0]), atol=ROUND_OFF)
    assert jnp.isinf(contact.friction_needed)
    assert not contact.pulls


def test_friction_needed_has_a_finite_gradient_where_nothing_slides():
    def friction(radius):
        scene = VerticalDisc(radius=radius)
        return rim(scene, *scene.named()[:2]).friction_needed

    assert jnp.isfinite(jax.grad(friction)(0.7))
