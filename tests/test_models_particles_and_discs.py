"""What holds of every scene of particles, blades, wheels, discs and balls, at random states and for other
parameters.
"""

import jax
import jax.numpy as jnp
import pytest
from tolerances import tolerance

import jourdain_jax as jj
from jourdain_jax.equations import coordinate_rates
from jourdain_jax.models import (
    BallOnTurntable,
    ChaplyginSleigh,
    HeisenbergParticle,
    IsokineticParticle,
    RosenbergParticle,
    Skate,
    SpringAndRod,
    TiltingDisc,
    TiltingDiscQuaternion,
    TwoWheelAxleCoordinates,
    TwoWheelAxleFree,
    TwoWheelAxleQuasi,
    TwoWheelAxleRedundant,
    VerticalDisc,
)

# Scene, degrees of freedom.
SCENES = [
    (TwoWheelAxleFree(radius=0.27, length=0.9, mass=1.7, rim_mass=0.4, slope=0.35), 2),
    (TwoWheelAxleRedundant(radius=0.27, length=0.9, mass=1.7, rim_mass=0.4, slope=0.35), 2),
    (TwoWheelAxleCoordinates(radius=0.27, length=0.9, mass=1.7, rim_mass=0.4, slope=0.35), 2),
    (TwoWheelAxleQuasi(radius=0.27, length=0.9, mass=1.7, rim_mass=0.4, slope=0.35), 2),
    (Skate(mass=1.4, inertia=0.3, slope=0.2), 2),
    (ChaplyginSleigh(mass=0.9, inertia=0.5, offset=0.35), 2),
    (VerticalDisc(mass=1.4, radius=0.6, roll_inertia=0.3, turn_inertia=0.2), 2),
    (TiltingDisc(mass=1.3, radius=0.4), 3),
    (TiltingDiscQuaternion(mass=1.3, radius=0.4), 3),
    (RosenbergParticle(mass=1.2), 2),
    (HeisenbergParticle(mass=1.2), 2),
    (BallOnTurntable(radius=0.08, inertia_ratio=2 / 3, turn_rate=1.5, tilt=0.2), 3),
    (SpringAndRod(mass1=0.8, mass2=0.7, stiffness=55.0, damping=0.3, rod_length=0.7), 3),
    (IsokineticParticle(mass=1.3, speed=1.9), 1),
]
every_scene = pytest.mark.parametrize(
    ("scene", "freedoms"), SCENES, ids=[type(scene).__name__ for scene, _ in SCENES]
)


def _states(scene, count):
    return tuple(jnp.asarray(x) for x in jj.sample_states(scene, count))


@every_scene
def test_the_scene_has_its_degrees_of_freedom(scene, freedoms):
    structure = jj.structure_of(scene)
    assert structure.degrees_of_freedom == freedoms
    assert len(scene.speed_names) - structure.rank == freedoms
    chosen = tuple(scene.speed_names.entries[i] for i in structure.independent)
    assert scene.privileged is None or chosen == scene.privileged


@pytest.mark.parametrize(
    "scene",
    [scene for scene, _ in SCENES if type(scene).invariants is not jj.Scene.invariants],
    ids=lambda x: type(x).__name__,
)
def test_known_integrals_do_not_change_along_the_motion(scene):
    t, q, u = _states(scene, 20)

    @jax.jit
    @jax.vmap
    def rates(t, q, u):
        udot = jj.accelerations(scene, t, q, u).udot
        velocity = jnp.ones_like(t), coordinate_rates(scene, t, q, u), udot

        def integrals(t, q, u):
            return scene.invariants(jj.motion_at(scene, t, q, u))

        rate = jax.jvp(integrals, (t, q, u), velocity)[1]
        gradient = jax.jacrev(integrals, argnums=(0, 1, 2))(t, q, u)
        norm = lambda xs: jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(xs)))
        return {name: (rate[name], norm(gradient[name]) * norm(velocity)) for name in rate}

    for name, (rate, size) in rates(t, q, u).items():
        assert jnp.max(jnp.abs(rate) / size) <= tolerance("round_off"), name
