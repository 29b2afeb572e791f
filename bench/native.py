"""Motions by machine code of our own against the same motions by XLA, in one run on one core: batches, alone,
derivatives.

    taskset -c 0 python bench/native.py [--quick] [--json FILE] [--only PART ...]

PART: batches, heyoka, records, times, watching, calls, single, laws.

Writes a list of {"figure", "model", "value", "required", "met"}; `required` is None where a figure is only
told. Times of warm motions are processor time, the least of some repeats, the two ways in turn.
"""

import os
from collections.abc import Generator
from functools import partial

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

import against_heyoka
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import laws_of_force
import numpy as np
from baselines import disc_run, heyoka_lowered
from figures import figure, fresh, least_processor_time, main, seconds_of
from minimal_states import starts_at
from small_scenes import OnPlane

import jourdain_jax as jj
from jourdain_jax.integrate.vector_fields.field import ByProgram
from jourdain_jax.motion.simulate import set_up

LANES, FEW = 1024, 128
WAYS = {"native": "native", "XLA": "xla"}
BARE = {"events": False, "formulation": jj.Formulation(stabilisation=None)}  # as in `lowering.py`
MOTIONS = (
    ("tilting-disc", 10.0, BARE),
    ("chaplygin-sleigh", 12.0, BARE),
    ("rattleback", 2.0, BARE),
    ("whipple-bicycle", 2.0, BARE),
    ("tilting-disc", 10.0, {}),
)


def compared(what, model, call, count, required, repeats) -> Generator:
    """Both ways of a call, which takes a backend and returns arrays: the first time, warm, one over the
    other, and how far apart; returns what they give.
    """
    calls, found = {way: call(backend) for way, backend in WAYS.items()}, {}
    for way, run in calls.items():
        found[way], seconds = seconds_of(run)
        yield figure(f"{what}, {way}, trace, compile and run, s", model, seconds)
    seconds = least_processor_time(calls, repeats)
    for way in WAYS:
        yield figure(f"{what}, {way}, us per trajectory", model, 1e6 * seconds[way] / count)
    yield figure(f"{what}, native / XLA", model, seconds["native"] / seconds["XLA"], required)
    first, second = (np.asarray(jax.tree.leaves(found[way])[0]) for way in WAYS)
    yield figure(f"{what}, largest difference", model, np.max(np.abs(first - second)))
    return found


def spread_starts(scene: jj.Scene, lanes) -> jj.State:
    """Admissible starts near the scene's example: the disc's as in `disc_run`, of others each named number by
    5 %.
    """
    if isinstance(scene, jj.models.TiltingDisc):
        return starts_at(scene, disc_run.starts(lanes))
    random = np.random.default_rng(0)
    changed = lambda x: jnp.asarray(x) * (1 + 0.05 * random.normal(size=(lanes, *np.shape(x))))
    values = {name: changed(x) for name, x in scene.example.items()}
    return jax.vmap(lambda values: jj.start(scene, values))(values)


def batches(quick):
    """A thousand spread starts, and one alone, at three tolerances."""
    lanes = FEW if quick else LANES
    for name, span, more in MOTIONS[: 1 if quick else None]:
        scene = jj.models.MODELS[name]()
        assert not (reason := set_up(scene).reason_against_machine_code), reason
        starts = spread_starts(scene, lanes)
        for alone, who in ((False, f"batch of {lanes}"), (True, "alone")):

            @partial(jax.jit, static_argnums=0)
            def run(backend, tolerance, starts, scene=scene, span=span, more=more, alone=alone):
                options = {"ts": jnp.array([span]), "solver": diffrax.Dopri8(), "backend": backend} | more
                options |= {"rtol": tolerance, "atol": tolerance}
                if alone:
                    motion = jj.simulate(scene, jax.tree.map(lambda x: x[0], starts), **options)
                else:
                    motion = jj.rollout(scene, starts, **options).lanes
                return motion.q_end, motion.accepted + motion.rejected

            for tolerance in (1e-8, 1e-10, 1e-12):
                what = f"{who if more else f'{who}, default options'}, {tolerance:.0e}"
                required = 0.5 if not alone and name == "tilting-disc" else 1.0
                call = lambda backend, run=run, given=(tolerance, starts): partial(run, backend, *given)
                count, repeats = 1 if alone else lanes, 3 if quick else 7
                found = yield from compared(what, name, call, count, required, repeats)
                for way in WAYS:
                    yield figure(f"{what}, tried steps, {way}", name, np.mean(found[way][1]))


def heyoka(quick):
    """A thousand spread starts, and motions alone, at equal final error."""
    if heyoka_lowered.heyoka is None:
        print(heyoka_lowered.MISSING)
        return
    for name, span, more in [entry for entry in MOTIONS if entry[2]][: 1 if quick else None]:
        starts = spread_starts(jj.models.MODELS[name](), FEW if quick else LANES)
        yield from against_heyoka.compared(name, starts, span, more, quick)


def records(quick):
    """2 s of a bicycle whose steer torque is a record of 201 samples, or a function of time, each lane its
    own; and derivatives for four parameters.
    """
    scene, name, lanes = jj.models.WhippleBicycle(), "whipple-bicycle", 2 if quick else 8
    start, times = jj.start(scene, rear_spin_rate=15.0, lean_rate=0.05), np.linspace(0.0, 2.0, 201)
    torques = jnp.asarray(0.1 * np.random.default_rng(0).normal(size=(lanes, 201)))
    names = ("mB", "IBxx", "zB", "mH")
    parameters = jnp.stack([getattr(scene, name) for name in names])

    def wave(torque):
        size, phase = torque[:2]
        return lambda t: size * jnp.sin(5.0 * t + phase)

    kinds = {"record": partial(jj.Sampled, times), "function of time": wave}

    def rates(backend, kind, parameters, torque):
        inputs = {"steer_torque": kinds[kind](torque)}
        options = {"ts": jnp.linspace(0.05, 2.0, 40), "rtol": 1e-8, "atol": 1e-8, "events": False}
        own = scene.replace(**dict(zip(names, parameters, strict=True)))
        return jj.simulate(own, start, inputs=inputs, backend=backend, **options).u

    def call(backend, kind, function):
        run = jax.jit(jax.vmap(function(partial(rates, backend, kind)), (None, 0)))
        return partial(run, parameters, torques)

    for kind in kinds:
        for what, function in (("motion", lambda f: f), ("its derivatives", jax.jacfwd)):
            asked = partial(call, kind=kind, function=function)
            yield from compared(f"{kind}, {what}", name, asked, lanes, 0.5, 3)


def times(quick):
    """Derivatives of a motion with respect to a delay of its saved times, by both modes and both ways."""
    for name in ("tilting-disc",) if quick else ("tilting-disc", "whipple-bicycle"):
        scene = jj.models.MODELS[name]()
        start = jj.start(scene, **scene.example)

        def seen(delay, backend, scene=scene, start=start):
            ts = jnp.linspace(0.2, 1.0, 21) - delay
            motion = jj.simulate(scene, start, t0=0.0, ts=ts, t1=1.0, backend=backend, **BARE)
            return jnp.sum(jnp.sin(motion.q))

        for mode, differentiated in (("forward", jax.jacfwd), ("reverse", jax.grad)):
            what = f"slope with respect to a delay, {mode}"
            call = lambda backend, slope=differentiated, seen=seen: partial(
                jax.jit(slope(partial(seen, backend=backend))), 0.013
            )
            found = yield from compared(what, name, call, 1, None, 50)
            off = abs(float(found["native"]) / float(found["XLA"]) - 1.0)
            yield figure(f"{what}, relative difference", name, off, 1e-7)


def watching(quick):
    """What it costs to judge, at every stage of every step, whether the privileged speeds still determine the
    others: motions with it over motions without.
    """
    scene, watched = jj.models.WhippleBicycle(), ByProgram.has_pivots
    speeds = jnp.linspace(-16.0, -15.0, 256)

    def last(spin_rate):
        start = {"rear_spin_rate": spin_rate, "lean_rate": 0.1}
        return jj.simulate(scene, start, ts=jnp.array([2.0]), work=False, backend="native").q_end

    def compiled(has_pivots):
        ByProgram.has_pivots = has_pivots
        try:
            run = jax.jit(jax.vmap(last))
            run(speeds)
        finally:
            ByProgram.has_pivots = watched
        return partial(run, speeds)

    runs = {"watched": compiled(watched), "not watched": compiled(property(lambda field: False))}
    seconds = least_processor_time(runs, 15 if quick else 60)
    ratio = seconds["watched"] / seconds["not watched"]
    yield figure("motions whose pivots are watched over such whose are not", "whipple-bicycle", ratio, 1.05)


class Pushed(OnPlane):
    """A mass that two inputs push, on springs."""

    stiffness: jax.Array = jj.parameter(4.0, unit="N/m")
    inputs = jj.inputs("f g")

    def loads(self, motion):
        f, g = motion.inputs.f - self.stiffness * motion.q.x, motion.inputs.g - self.stiffness * motion.q.y
        return jj.generalized_force(motion, x_rate=f, y_rate=g)


def calls(quick):
    """What `simulate` called from Python costs more than the same motion, of 1 s saved 201 times, from a
    given state under the user's `jit`.
    """
    knots = np.linspace(0.0, 1.0, 11)
    two = {
        "two numbers": {"f": 1.0, "g": 0.5},
        "two functions of time": {"f": jnp.sin, "g": lambda t: jnp.cos(2 * t)},
        "two records": {"f": jj.Sampled(knots, knots**2), "g": jj.Sampled(knots, knots**3)},
    }
    cases = [(name, jj.models.MODELS[name](), None, 0.3) for name in ("tilting-disc", "whipple-bicycle")]
    cases += [(f"mass pushed by {what}", Pushed(), inputs, 0.5) for what, inputs in two.items()]
    for name, scene, inputs, required in cases[: 1 if quick else None]:
        values = dict(scene.example) or {"x": 0.1}
        moved = partial(jj.simulate, scene, t1=1.0, inputs=inputs)
        state, compiled = jj.start(scene, values), jax.jit(lambda state, moved=moved: moved(state))
        ways = {"a state": partial(moved, state), "named values": partial(moved, values)}
        runs = {"jit": partial(compiled, state)} | ways
        seconds = least_processor_time(runs, 50 if quick else 400)
        yield figure("a call under the user's jit, ms", name, 1e3 * seconds["jit"])
        for way in ways:
            more = 1e3 * (seconds[way] - seconds["jit"])
            yield figure(f"called from Python with {way}, ms more", name, more, required)


def in_single(name, lanes):
    """Motions of 2 s in single precision, alone and as a batch, for a process of its own."""
    scene, ts = jj.models.MODELS[name](), jnp.linspace(0.1, 2.0, 20)
    start, found = jj.start(scene), []
    near = start.q + 0.01 * jax.random.normal(jax.random.key(0), (lanes, *start.q.shape))
    assert near.dtype == jnp.float32

    def call(backend, qs):
        options = {"ts": ts, "rtol": 1e-5, "atol": 1e-6, "work": False, "backend": backend}
        end = lambda q: jj.simulate(scene, eqx.tree_at(lambda s: s.q, start, q), **options).q_end
        return partial(jax.jit(end if qs.ndim == 1 else jax.vmap(end)), qs)

    for who, qs, count, repeats in (("alone", near[0], 1, 20), (f"batch of {lanes}", near, lanes, 3)):
        found += compared(f"single precision, {who}", name, partial(call, qs=qs), count, 1.0, repeats)
    return found


def single(quick):
    """Motions in single precision, in processes of their own: machine code rounds what it is given and
    returns, XLA all that it computes.
    """
    program = "import json, native, sys; print(json.dumps(native.in_single(sys.argv[1], int(sys.argv[2]))))"
    for name in ("tilting-disc", "whipple-bicycle")[: 1 if quick else 2]:
        yield from fresh(program, name, FEW if quick else LANES, JAX_ENABLE_X64="0")


def laws(quick):
    """Batches of scenes whose forces are functions beyond sine and cosine, and their derivatives with respect
    to the start.
    """
    lanes = FEW if quick else LANES
    for name, (scene, starts, span) in list(laws_of_force.cases(lanes).items())[: 1 if quick else None]:

        def end(start, backend, scene=scene, span=span):
            options = {"ts": jnp.array([span]), "rtol": 1e-8, "atol": 1e-8, "backend": backend}
            return jj.simulate(scene, start, **options).q_end

        ways = {"motion": lambda f: f, "forward mode": jax.jacfwd, "reverse mode": jax.jacrev}
        for what, of in ways.items():
            count = lanes if what == "motion" else 8
            given = {key: jnp.asarray(x[:count]) for key, x in starts.items()}
            call = lambda backend, of=of, end=end, given=given: partial(
                jax.jit(jax.vmap(of(partial(end, backend=backend)))), given
            )
            yield from compared(what, name, call, count, 1.0, 3 if quick else 7)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(__doc__, (batches, heyoka, records, times, watching, calls, single, laws))
