"""Coordinates recovered by quadrature: which they are, that they are as accurate as the method, and when the motion says that they are not."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import chaplygin_sleigh, rolling_disc

import jourdain_jax as jj
from jourdain_jax.lowering.recoverable import recoverable
from jourdain_jax.models import MODELS
from jourdain_jax.motion import results
from jourdain_jax.motion.recovery import TOO_LONG

RECOVERED = {
    "tilting-disc": ("x", "y", "yaw", "spin"),
    "two-wheel-axle-coordinates": ("x1", "y1", "psi1", "x2", "y2", "psi2"),
    "whipple-bicycle": ("x", "y", "yaw", "rear_spin", "front_spin"),
    "ball-on-turntable": (),  # x and y decide the rolling of the attitude, which is kept at norm one
    "chaplygin-sleigh": ("x", "y"),
}


@pytest.mark.parametrize("name", RECOVERED)
def test_coordinates_on_which_nothing_else_depends_are_found(name):
    program = jj.lower(MODELS[name]())
    assert tuple(program.coordinates[i] for i in program.recoverable()) == RECOVERED[name]
    assert f"as nothing else depends on them: {', '.join(RECOVERED[name]) or 'none'}" in str(program)


def test_what_leads_back_to_itself_or_to_what_is_wanted_is_no_quadrature():
    chain = {0: frozenset(), 1: frozenset({0}), 2: frozenset({1})}
    assert recoverable(chain, ()) == (0, 1, 2)
    assert recoverable(chain, (1,)) == (2,)
    assert recoverable(chain | {0: frozenset({2})}, ()) == ()  # in a circle
    assert recoverable(chain | {1: frozenset({0, 1})}, ()) == (2,)  # 1 depends on itself, and on 0


class FencedDisc(jj.models.TiltingDisc):
    """Stops before a fence across y."""

    def events(self, motion):
        return {"fence": 0.4 + motion.q.y}


def test_a_coordinate_on_which_an_event_depends_is_kept_and_with_it_what_it_depends_on():
    program = jj.lower(FencedDisc())
    assert tuple(program.coordinates[i] for i in program.recoverable()) == ("x", "spin")
    assert tuple(program.coordinates[i] for i in program.recoverable(events=False)) == RECOVERED["tilting-disc"]
    start = {"lean": 0.3, "yaw_rate": 0.5, "spin_rate": -3.0}
    stopped, asked = (jj.simulate(FencedDisc(), start, t1=4.0, recover=way) for way in ("quadrature", None))
    assert stopped.recovered == ("x", "spin")
    assert int(stopped.result) == int(asked.result) == results.EVENT
    np.testing.assert_allclose(stopped.t_end, asked.t_end, rtol=1e-7)


DISC = {name: value for name, value in rolling_disc.RUN.items() if name != "t_end"}
SLEIGH = {name: value for name, value in chaplygin_sleigh.RUN.items() if name != "t_end"}


def disc_at(span):
    names = ("x", "y", "yaw", "spin")
    end = rolling_disc.motion_yaw_lean_spin(np.array([0.0, span]), **DISC)
    return np.array([end[name][-1] for name in names], float)


def sleigh_at(span):
    end = chaplygin_sleigh.motion(np.array([0.0, span]), **SLEIGH)
    return np.array([end["x"][-1], end["y"][-1]], float)


def disc_and_start():
    names = ("yaw", "lean", "spin", "yaw_rate", "lean_rate", "spin_rate")
    return MODELS["tilting-disc"](mass=DISC["mass"], radius=DISC["radius"], gravity=DISC["gravity"]), {name: DISC[name] for name in names}


def sleigh_and_start():
    scene = MODELS["chaplygin-sleigh"](mass=SLEIGH["mass"], inertia=SLEIGH["inertia"], offset=SLEIGH["a"])
    v, w, a = SLEIGH["v0"], SLEIGH["w0"], SLEIGH["a"]
    return scene, {"x": 0.0, "y": 0.0, "heading": 0.0, "x_rate": v, "y_rate": a * w, "heading_rate": w}


CASES = {"disc": (disc_and_start, disc_at, ("x", "y", "yaw", "spin")), "sleigh": (sleigh_and_start, sleigh_at, ("x", "y"))}


@pytest.mark.parametrize("name", CASES)
def test_recovered_coordinates_are_as_accurate_as_the_method_at_every_tolerance(name):
    of, exact_at, names = CASES[name]
    (scene, start), exact = of(), exact_at(5.0)
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        found = {way: jj.simulate(scene, start, ts=[2.5, 5.0], t1=5.0, rtol=tolerance, atol=tolerance, recover=way) for way in (None, "quadrature")}
        errors = {way: max(abs(float(motion[x][-1]) - e) for x, e in zip(names, exact, strict=True)) for way, motion in found.items()}
        assert errors["quadrature"] <= max(2 * errors[None], 50 * tolerance)
        assert found["quadrature"].recovered == names
        assert 0 < float(found["quadrature"].quadrature_error) < TOO_LONG
        assert found[None].recovered == ()
        assert float(found[None].quadrature_error) == 0


def test_what_was_recovered_is_said_and_steps_too_long_for_it_are_warned_of():
    disc = MODELS["vertical-disc"]()
    start = {"heading_rate": 5.0, "roll_rate": 4.0}  # a circle: no speed changes, so that nothing keeps the steps short
    far, near = (jj.simulate(disc, start, ts=jnp.linspace(0.0, 6.0, n), recover="quadrature") for n in (2, 101))
    assert int(far.accepted) < int(jj.simulate(disc, start, ts=jnp.linspace(0.0, 6.0, 2)).accepted)
    assert float(far.quadrature_error) > TOO_LONG
    (warning,) = far.warnings
    assert "steps were too long for the recovered coordinates x, y" in warning
    assert "x, y, heading, roll by quadrature" in str(near)
    assert near.warnings == ()
    np.testing.assert_allclose(near["x"], 4.0 * float(disc.radius) / 5.0 * np.sin(5.0 * near.ts), atol=1e-7)


@pytest.mark.slow
def test_derivatives_of_recovered_coordinates_are_those_of_the_motion():
    scene, start = disc_and_start()

    def end(x, recover, adjoint=None):
        own = start | {"spin_rate": x[0], "lean": x[1]}
        motion = jj.simulate(scene.replace(radius=x[2]), own, ts=jnp.array([1.0]), rtol=1e-10, atol=1e-10, recover=recover, adjoint=adjoint)
        return jnp.sum(jnp.sin(motion.q_end))

    x, v = jnp.array([-3.0, 0.3, 0.5]), jnp.array([1.0, 0.5, -0.3])
    forward = jax.jvp(lambda x: end(x, "quadrature", diffrax.ForwardMode()), (x,), (v,))[1]
    expected = jax.jvp(lambda x: end(x, None, diffrax.ForwardMode()), (x,), (v,))[1]
    np.testing.assert_allclose(forward, expected, rtol=1e-7)
    np.testing.assert_allclose(jnp.vdot(jax.grad(lambda x: end(x, "quadrature"))(x), v), expected, rtol=1e-7)


def test_lanes_of_a_rollout_are_recovered_alike():
    scene, start = disc_and_start()
    leans = np.array([0.2, 0.3])
    lanes = jj.rollout(scene, start | {"lean": leans}, ts=[2.5, 5.0], t1=5.0, recover="quadrature")
    assert lanes.lane(1).recovered == CASES["disc"][2]
    found = np.array([lanes[name][1, -1] for name in CASES["disc"][2]])
    np.testing.assert_allclose(found, disc_at(5.0), atol=1e-6)
    assert np.all(np.asarray(lanes.lanes.quadrature_error) > 0)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"recover": "quadratur"}, "`recover` is 'quadratur', expected None or 'quadrature'"),
        ({"lowering": False}, "needs the scalar program of the scene"),
        ({"reduction": "qr"}, "needs the scalar program of the scene"),
        ({"solver": diffrax.Kvaerno5()}, "belongs to the step-size control of the default solvers"),
        ({"adjoint": diffrax.DirectAdjoint()}, "belongs to the step-size control of the default solvers"),
        ({"land_on_ts": False}, "belongs to the step-size control of the default solvers"),
    ],
)
def test_uses_that_do_not_apply_are_refused_with_the_reason(options, sentence):
    with pytest.raises(ValueError, match=sentence):
        jj.simulate(MODELS["chaplygin-sleigh"](), t1=1.0, **{"recover": "quadrature"} | options)
    with pytest.raises(ValueError, match=sentence):
        jj.rollout(MODELS["chaplygin-sleigh"](), {"y_rate": np.zeros(2)}, t1=1.0, **{"recover": "quadrature"} | options)


def test_a_scene_without_such_coordinates_moves_as_always():
    ball = MODELS["ball-on-turntable"]()
    asked, plain = (jj.simulate(ball, t1=1.0, recover=way) for way in ("quadrature", None))
    assert asked.recovered == ()
    np.testing.assert_array_equal(asked.q, plain.q)
    assert "recovered" not in str(asked)
