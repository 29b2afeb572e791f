"""In single precision: motions, accelerations and gradients are right to what float32 holds, and nothing
turns into float64 on the way.

The precision is chosen before JAX starts, so that all of it runs in one process of its own; its findings come
back as JSON. By default it looks at the skate; at other models, reductions, a verification and a motion that
nothing continues where slow tests run. Motions are integrated by machine code, which works in double
precision and rounds what it returns, and by XLA, which works in single precision.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from oracles import chaplygin_sleigh, skate
from tolerances import relative_error

import jourdain_jax as jj
from jourdain_jax.models import MODELS

NAMES = ("skate", "chaplygin-sleigh", "tilting-disc-quaternion")
TS = np.linspace(0.1, 2.0, 20)
SINGLE = 1e-4  # relative: rtol is 1e-5 per step, over some 30 steps
GRADIENT = 1e-3

PROGRAM = """
import gc, json, warnings
import jax, jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from jourdain_jax.models import MODELS
from jourdain_jax.integrate import result_codes
from jourdain_jax.kernels import host

gc.disable()  # a process of a minute
host.EFFORT = 0  # of LLVM, as in the other tests
names, ts, slow = json.loads(input())


def types(tree):
    return sorted(
        {
            str(x.dtype)
            for x in jax.tree.leaves(tree)
            if hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.floating)
        }
    )


def motion_of(scene, start, **options):
    return jj.simulate(scene, start, ts=jnp.asarray(ts), rtol=1e-5, atol=1e-6, **options)


found = {}
for name in names:
    scene = MODELS[name]()
    state = jj.start(scene, **scene.example)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = motion_of(scene, state)
    by_xla = motion_of(scene, state, backend="xla")
    t, q, u = (jnp.asarray(x) for x in jj.sample_states(scene, 4))
    ways = jj.reductions(scene) if slow else ["svd"]
    solve = jax.jit(
        jax.vmap(lambda t, q, u: {way: jj.accelerations(scene, t, q, u, reduction=way) for way in ways})
    )
    by_reduction = solve(t, q, u)
    middle = by_reduction["svd"].udot
    found[name] = {
        "q": [way.q.tolist() for way in (motion, by_xla)],
        "u": [way.u.tolist() for way in (motion, by_xla)],
        "result": [int(way.result) for way in (motion, by_xla)] == [result_codes.SUCCESS] * 2,
        "reduction": motion.reduction,
        "operations": jj.lower(scene).operations,
        "types": types(
            (
                scene,
                state,
                motion,
                by_xla,
                motion.energies(),
                motion.accelerations(),
                motion.contact_forces(),
                by_reduction,
            )
        ),
        "warnings": [str(w.message) for w in caught],
        "drift": float(jj.diagnose(motion).energy_drift / motion.energies().kinetic[0]),
        "states": [t.tolist(), q.tolist(), u.tolist()],
        "udot": middle.tolist(),
        "spread": {
            way: float(jnp.max(jnp.abs(a.udot - middle)) / (1 + jnp.max(jnp.abs(middle))))
            for way, a in by_reduction.items()
        },
        "applicable": bool(jnp.all(jnp.stack([a.applicable for a in by_reduction.values()]))),
    }

skate = MODELS["skate"]()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    tight = jj.simulate(skate, skate.example, t1=0.1, rtol=1e-8, atol=1e-8)
found["tight"] = {
    "warnings": [str(w.message) for w in caught],
    "files": [w.filename for w in caught],
    "finite": bool(jnp.all(jnp.isfinite(tight.q))),
}
found["few steps"] = motion_of(skate, skate.example, max_steps=3).message
try:
    found["contradiction"] = str(
        motion_of(skate, {"heading": 0.0, "x_rate": 1.0, "y_rate": 0.1, "heading_rate": 0.0}).u[0]
    )
except ValueError as error:
    found["contradiction"] = str(error)


class Beside(jj.Scene):
    "An oscillator, and a particle that goes past far away."

    coordinates = jj.coordinates("x far")

    def bodies(self, t, q):
        return {
            name: jj.Particle(1.0, jnp.stack([x, 0 * x, 0 * x])) for name, x in (("a", q.x), ("b", q.far))
        }

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=-1e4 * motion.q.x),)


found["far away"] = [
    motion_of(Beside(), {"x": 1.0, "far": 1e6, "far_rate": 1.0}, backend=way)["far"].tolist()
    for way in ("auto", "xla")
]


if slow:

    class Pushed(jj.Scene):
        "A particle on a wire that is pushed by a record, until it is at 1 m."

        mass: float = jj.parameter(2.0, unit="kg")
        coordinates, inputs = jj.coordinates("x"), jj.inputs("push")

        def bodies(self, t, q):
            return {"bead": jj.Particle(self.mass, jnp.stack([q.x, 0 * q.x, 0 * q.x]))}

        def loads(self, motion):
            return (jj.generalized_force(motion, x_rate=motion.inputs.push),)

        def events(self, motion):
            return {"arrived": 1.0 - motion.q.x}

    def arrival(push, mass=2.0):
        record = jj.Sampled([0.0, 1.0, 3.0], jnp.stack([0 * push, push, push]))
        return jj.simulate(
            Pushed(mass), {"x": 0.0}, t1=3.0, rtol=1e-6, atol=1e-6, inputs={"push": record}, work=False
        )

    pushes = jnp.asarray([2.0, 4.0, 8.0])
    of_one = arrival(pushes[0])
    found["arrivals"] = {
        "ways": of_one.reduction,
        "alone": float(of_one.t_end),
        "batch": jax.vmap(lambda push: arrival(push).t_end)(pushes).tolist(),
        "slopes": jax.vmap(jax.grad(lambda mass, push: arrival(push, mass).t_end), (None, 0))(
            2.0, pushes
        ).tolist(),
    }

    class Twice(jj.Scene):
        "A particle on a circle, by two rows that depend on each other exactly on the circle."

        coordinates = jj.coordinates("x y")

        def bodies(self, t, q):
            return {"bead": jj.Particle(1.0, jnp.stack([q.x, q.y, 0 * q.x]))}

        def geometric_constraints(self, pose):
            q = pose.q
            circle = (q.x**2 + q.y**2 - 1.0) / 2
            return {"circle": circle, "once more": (2.0 + q.x + 3.0 * q.y) * circle}

    round_the_circle = motion_of(Twice(), jj.start(Twice(), x=0.6, x_rate=-0.4))
    found["circle"] = [
        jnp.stack([round_the_circle["x"], round_the_circle["y"]]).tolist(),
        round_the_circle.message,
    ]
    board = MODELS["snakeboard"]()
    nowhere = {
        "steer": jnp.pi / 2,
        "steer_rate": 0.5,
        "y_rate": 0.5,
        "heading_rate": 0.3,
    }  # at parallel rows with a sideways velocity
    ended = jj.simulate(board, nowhere, ts=[0.0, 1.0], rtol=1e-5, atol=1e-5, retry=True)
    found["no motion continues"] = [int(ended.result), int(ended.accepted + ended.rejected)]
    options = {"rtol": 1e-5, "atol": 1e-5}
    found["far in time"] = [
        jj.simulate(Beside(), {"x": 1.0}, t0=t0, ts=[t0 + 0.5, t0 + 1.0], **options)["x"].tolist()
        for t0 in (0.0, 1e4)
    ]
    sleigh = MODELS["chaplygin-sleigh"]()
    found["verified"] = str(jj.verify(sleigh, jj.start(sleigh, **sleigh.example)))
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def single(request):
    """What the program above found in a process with 32-bit floats."""
    slow = any(
        item.path == request.path and item.get_closest_marker("slow") for item in request.session.items
    )
    source = Path(jj.__file__).parents[1]
    environment = os.environ | {
        "JAX_ENABLE_X64": "0",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir or "",
        "JAX_ENABLE_COMPILATION_CACHE": "0",
        "PYTHONPATH": os.pathsep.join([str(source), os.environ.get("PYTHONPATH", "")]),
    }
    text = json.dumps([NAMES if slow else NAMES[:1], TS.tolist(), slow])
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=text, env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module", params=NAMES)
def compared(request, single):
    """The model's name, what 32-bit floats gave, and the scene and its motion with 64-bit floats."""
    scene = MODELS[request.param]()
    return (
        request.param,
        single[request.param],
        scene,
        jj.simulate(scene, scene.example, ts=TS, rtol=1e-10, atol=1e-10),
    )


def test_single_precision_gives_nothing_but_single_precision(compared):
    _, found, *_ = compared
    assert found["types"] == ["float32"]
    assert found["result"]
    assert found["warnings"] == []


def test_programs_in_single_precision_are_those_of_double_precision(compared):
    _, found, scene, exact = compared
    assert found["reduction"] == exact.reduction
    assert found["operations"] == jj.lower(scene).operations


def test_motions_in_single_precision_follow_those_in_double_precision(compared):
    _, found, _, exact = compared
    for q, u in zip(found["q"], found["u"], strict=True):
        assert relative_error(q, exact.q) <= SINGLE
        assert relative_error(u, exact.u) <= SINGLE
    assert found["drift"] <= SINGLE


@pytest.mark.parametrize(
    ("name", "oracle"),
    [("skate", skate), ("chaplygin-sleigh", chaplygin_sleigh)],
    ids=["skate", "chaplygin-sleigh"],
)
def test_skate_and_sleigh_follow_their_closed_forms_in_single_precision(name, oracle, single):
    motion = oracle.motion(
        np.concatenate([[0.0], TS]), **oracle.RUN
    )  # both models' defaults and examples are the runs of the oracles
    expected = np.stack([motion["x"], motion["y"], motion["th"]], axis=-1)[1:]
    for q in single[name]["q"]:
        assert relative_error(q, expected) <= SINGLE


def test_batches_events_and_records_are_right_in_single_precision(single):
    # of a force that grows to F within 1 s: x = F t^3/12 up to then, and x = F (1/12 + (t - 1)/4 + (t -
    # 1)^2/4) after it
    F, found = np.array([2.0, 4.0, 8.0]), single["arrivals"]
    s = (-1 + np.sqrt(1 + 4 * (4 / F - 1 / 3))) / 2
    slopes = 2 / F / (1 + 2 * s)  # with respect to the mass of 2 kg
    assert found["ways"].endswith("machine code")
    assert found["alone"] == found["batch"][0]
    assert_allclose(found["batch"], 1 + s, rtol=SINGLE)
    assert_allclose(found["slopes"], slopes, rtol=GRADIENT)


def test_reductions_agree_in_single_precision(compared):
    _, found, scene, _ = compared
    assert found["applicable"]
    assert max(found["spread"].values()) <= SINGLE
    t, q, u = (jnp.asarray(x) for x in found["states"])
    exact = jax.vmap(lambda t, q, u: jj.accelerations(scene, t, q, u).udot)(t, q, u)
    assert relative_error(found["udot"], exact) <= SINGLE


def test_tolerances_below_single_precision_are_warned_of(single):
    assert any("is too small for float32" in text for text in single["tight"]["warnings"])
    assert single["tight"]["files"] == ["<string>"]  # the line of the call
    assert single["tight"]["finite"]


def test_result_codes_hold_in_single_precision(single):
    assert single["few steps"].startswith("ran out of steps")


def test_values_that_contradict_each_other_are_refused_in_single_precision(single):
    assert single["contradiction"].startswith(
        "the start of `Skate` violates constraint `edge`: residual 0.1 remains"
    )  # not moved, as if it were round-off


def test_increments_below_the_last_digit_of_a_state_add_up(single):
    # at 1e6 m a step of 4 ms at 1 m/s is less than half of the last digit, 1/16 m
    for far in single["far away"]:
        assert np.max(np.abs(np.array(far) - (1e6 + TS))) <= 1 / 16


def test_single_precision_far_in_time_is_as_right_as_at_zero(single):
    near, far = single["far in time"]
    assert far == near


def test_rows_that_depend_on_each_other_do_so_at_rounded_coordinates(single):
    (x, y), message = single["circle"]
    angle = np.arctan2(np.copysign(0.8, y[0]), 0.6) + np.copysign(0.5, y[0]) * TS
    assert message.startswith("reached")
    assert relative_error(np.array([x, y]), np.array([np.cos(angle), np.sin(angle)])) <= SINGLE


def test_a_motion_that_nothing_continues_ends_soon_in_single_precision(single):
    # once a coordinate stood still just before the rows that stop the motion, while time went on in 100,000
    # short steps
    code, steps = single["no motion continues"]
    assert code == results.STEP_TOO_SMALL
    assert steps < 1000


def test_verification_knows_what_single_precision_can_show(single):
    assert "passed" in single["verified"].splitlines()[0], single["verified"]
