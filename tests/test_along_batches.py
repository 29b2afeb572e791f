"""What a motion is asked for at all its times, and a batch at all its lanes, is what its single states and
lanes answer.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import Oscillator
from test_inputs import OnBelt

import jourdain_jax as jj
from jourdain_jax.models import DoublePendulumRods, TiltingDiscQuaternion, model

TS = np.linspace(0.0, 0.3, 4)
BELT = {"speed": lambda t: 1.0 + t, "push": 0.5}
SCENES = {
    "disc": (TiltingDiscQuaternion(), model("tilting-disc-quaternion").example, None),
    "rods": (DoublePendulumRods(), DoublePendulumRods.example, None),
    "belt": (OnBelt(), {"y": 0.1}, BELT),
}


@pytest.fixture(scope="module", params=SCENES, ids=SCENES)
def moved(request):
    scene, start, inputs = SCENES[request.param]
    return jj.simulate(scene, start, ts=TS, inputs=inputs)


@pytest.fixture(scope="module", params=SCENES, ids=SCENES)
def lanes(request):
    scene, start, inputs = SCENES[request.param]
    return jj.rollout(
        scene, start, parameters={"mass" if inputs else "gravity": np.array([9.7, 9.9])}, ts=TS, inputs=inputs
    )


def test_points_of_bodies_along_a_motion_are_those_at_each_time(moved):
    motions, local = moved.motions(), np.array([0.1, -0.2, 0.3])
    for name, body in motions.bodies.items():
        assert name in motions
        assert body.orientation.shape == (len(TS), 3, 3)
        point = body.point(local)
        assert_allclose(point.position, moved.point(name, local), rtol=0, atol=1e-14)
        each = jax.jit(
            jax.vmap(lambda body: (body.point(local).velocity, body.velocity_at(body.place(local))))
        )
        assert_allclose((point.velocity, body.velocity_at(point.position)), each(body), rtol=0, atol=1e-14)


QUANTITIES = {
    "motions": lambda m: m.motions(),
    "energies": lambda m: m.energies().balance,
    # its rank and smallest singular value are judged by typical lengths of rows, which belong to the
    # parameters of one lane
    "accelerations": lambda m: [
        getattr(m.accelerations(), name)
        for name in ("udot", "multipliers", "constraint_force", "residual", "applicable")
    ],
    "forces": lambda m: next(iter(m.constraint_forces().forces_on(next(iter(m.motions().bodies))).values())),
    "contacts": lambda m: m.contact_forces(),
    "residuals": lambda m: m.residuals(),
    "invariants": lambda m: m.invariants(),
    "point": lambda m: m.point(next(iter(m.motions().bodies))),
}


@pytest.mark.parametrize("quantity", QUANTITIES.values(), ids=QUANTITIES)
def test_a_batch_is_asked_as_its_lanes_are(lanes, quantity):
    together = quantity(lanes.lanes)
    for i in range(len(lanes)):
        own = jax.tree.leaves(quantity(lanes.lane(i)))
        for all_lanes, one in zip(jax.tree.leaves(together), own, strict=True):
            assert_allclose(all_lanes[i], one, rtol=1e-9, atol=1e-9)


def test_names_say_what_they_hold(lanes):
    scene = lanes.lanes.scene
    for name in scene.coordinate_names.entries:
        assert name in scene.coordinate_names
        assert name in lanes
        assert name in lanes.lane(0)
    assert "phi" not in scene.coordinate_names
    assert "phi" not in lanes
    assert 3 not in scene.speed_names
    assert list(scene.speed_names) == list(scene.speed_names.entries)
    start = jj.start(SCENES["disc"][0], **SCENES["disc"][1])
    assert "attitude" in start
    assert "attitude_omega" in start
    assert "t" in lanes
    assert "lean" not in start


@pytest.mark.parametrize("kind", ["coordinate", "speed"])
def test_a_name_that_would_shadow_the_time_is_refused_where_it_is_stated(kind):
    with pytest.raises(ValueError, match=f"{kind} name `t` is reserved for time"):
        jj.coordinates("x t") if kind == "coordinate" else jj.speeds("t v")
    assert "t" in jj.inputs("t")


def test_a_failed_motion_gives_nan_where_it_is_asked_to_and_its_neighbours_keep_their_derivatives():
    def loss(amplitude, stiffness):
        def one(stiffness):
            motion = jj.simulate(
                Oscillator(mass=1.0, damping=0.0, stiffness=stiffness),
                {"x": amplitude},
                ts=[0.5, 1.0],
                max_steps=60,
            )
            marked = motion.nan_if_failed()
            return motion.succeeded, motion.q_end, marked.q_end, marked.q, marked.u_end

        done, last, end, q, u_end = jax.vmap(one)(stiffness)
        return jnp.sum(jnp.where(done[:, None], end, 0.0)), (done, last, end, q, u_end)

    slope, (done, last, end, q, u_end) = jax.jit(jax.grad(loss, has_aux=True))(0.5, jnp.array([1.0, 1e8]))
    assert done.tolist() == [True, False]
    assert np.isfinite(last).all()
    assert np.isnan(end[1]).all()
    assert np.isnan(q[1]).all()
    assert np.isnan(u_end[1]).all()
    assert_allclose(end[0], 0.5 * np.cos(1.0), rtol=1e-7)
    assert_allclose(slope, np.cos(1.0), rtol=1e-7)
