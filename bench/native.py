"""Motions by machine code of our own against the same motions by XLA, in one run on one core: batches, alone, cold starts.

    taskset -c 0 python bench/native.py [--quick] [--json FILE] [--only batches|heyoka|records|times|watching|calls|single|laws|compilation ...]

Writes a list of {"figure", "model", "value", "required", "met"}; `required` is None where a figure is only told. Times of warm motions are processor
time, the least of some repeats, the two ways in turn; cold ones are wall time of fresh processes.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

import against_heyoka
import diffrax
import jax
import jax.numpy as jnp
import laws_of_force
import numpy as np
from baselines import disc_run, heyoka_lowered
from baselines.timing import least_processor_time

import jourdain_jax as jj
from jourdain_jax.motion.simulate import set_up
from jourdain_jax.motion.vector_fields.by_program import ByProgram

LANES = 1024
WAYS = {"native": "native", "XLA": "xla"}
COLD = """
import time; begin = time.perf_counter()
import jax, sys; jax.config.update("jax_enable_x64", True)
import jourdain_jax as jj
jax.block_until_ready(jj.simulate(jj.models.MODELS[sys.argv[1]](), backend=sys.argv[2].lower()).q)
print(time.perf_counter() - begin)
"""
SINGLE = """
import functools, json, sys
import equinox as eqx, jax, jax.numpy as jnp, numpy as np
import jourdain_jax as jj
from baselines.timing import least_processor_time
name, lanes = sys.argv[1], int(sys.argv[2])
scene, ts = jj.models.MODELS[name](), jnp.linspace(0.1, 2.0, 20)
start = jj.start(scene)
near = start.q + 0.01 * jax.random.normal(jax.random.key(0), (lanes, *start.q.shape))
found = {}
for who, qs in (("alone", near[0]), ("batch", near)):
    runs = {}
    for way in ("native", "xla"):
        def end(q, way=way):
            return jj.simulate(scene, eqx.tree_at(lambda s: s.q, start, q), ts=ts, rtol=1e-5, atol=1e-6, work=False, backend=way).q_end
        runs[way] = functools.partial(lambda run, qs: jax.block_until_ready(run(qs)), jax.jit(end if qs.ndim == 1 else jax.vmap(end)), qs)
    assert all(run().dtype == jnp.float32 for run in runs.values())
    found[who] = least_processor_time(runs, 20 if qs.ndim == 1 else 3)
print(json.dumps(found, separators=(",", ":")))
"""
Figure = dict
BARE = {"events": False, "formulation": jj.Formulation(stabilisation=None)}  # as in `lowering.py`
MOTIONS = (
    ("tilting-disc", 10.0, BARE),
    ("chaplygin-sleigh", 12.0, BARE),
    ("rattleback", 2.0, BARE),
    ("whipple-bicycle", 2.0, BARE),
    ("tilting-disc", 10.0, {}),
)


def figure(name: str, model: str, value: float, required: float | None = None) -> Figure:
    """One entry of the result."""
    print(f"  {name}, {model}: {value:.4g}" + ("" if required is None else f" (required: {required:g})"), flush=True)
    return {"figure": name, "model": model, "value": value, "required": required, "met": required is None or value <= required}


def spread_starts(scene: jj.Scene, lanes: int) -> jj.State:
    """Admissible starts near the scene's example: the disc's as in `disc_run`, of others each named number by 5 %."""
    if isinstance(scene, jj.models.TiltingDisc):
        y = disc_run.starts(lanes)
        values = {"yaw": y[:, 2], "lean": y[:, 3], "spin": y[:, 4], "yaw_rate": y[:, 5], "lean_rate": y[:, 6], "spin_rate": y[:, 7]}
    else:
        random = np.random.default_rng(0)
        values = {name: np.asarray(x) * (1 + 0.05 * random.normal(size=(lanes, *np.shape(x)))) for name, x in scene.example.items()}
    return jax.vmap(lambda values: jj.start(scene, **values))({name: jnp.asarray(x) for name, x in values.items()})


def runs_of(scene: jj.Scene, starts: jj.State, span: float, alone: bool, more: dict) -> dict[str, Callable]:
    """Way -> compiled function of a tolerance and starts that returns final states and steps; `more`: options of `simulate`."""

    def run(backend, tolerance, starts):
        options = {"ts": jnp.array([span]), "solver": diffrax.Dopri8(), "rtol": tolerance, "atol": tolerance, "backend": backend, **more}
        if alone:
            motion = jj.simulate(scene, jax.tree.map(lambda x: x[0], starts), **options)
        else:
            motion = jj.rollout(scene, starts, **options).lanes
        return motion.q_end, motion.accepted, motion.rejected

    return {way: partial(lambda run, tolerance: jax.block_until_ready(run(tolerance, starts)), jax.jit(partial(run, backend))) for way, backend in WAYS.items()}


def batches(quick: bool) -> Iterator[Figure]:
    """A thousand spread starts, and one alone, at three tolerances."""
    lanes = 128 if quick else LANES
    for name, span, more in MOTIONS[: 1 if quick else None]:
        scene = jj.models.MODELS[name]()
        assert not (reason := set_up(scene).reason_against_machine_code), reason
        starts = spread_starts(scene, lanes)
        for alone, who in ((False, f"batch of {lanes}"), (True, "alone")):
            who = who if more else f"{who}, default options"
            runs = runs_of(scene, starts, span, alone, more)
            for tolerance in (1e-8, 1e-10, 1e-12):
                found = {way: run(tolerance) for way, run in runs.items()}
                times = least_processor_time({way: partial(run, tolerance) for way, run in runs.items()}, 3 if quick else 7)
                count = 1 if alone else lanes
                for way, seconds in times.items():
                    yield figure(f"{who}, {tolerance:.0e}, {way}, us per trajectory", name, 1e6 * seconds / count)
                required = 0.5 if not alone and name == "tilting-disc" else 1.0
                yield figure(f"{who}, {tolerance:.0e}, native / XLA", name, times["native"] / times["XLA"], required)
                apart = float(jnp.max(jnp.abs(found["native"][0] - found["XLA"][0])))
                yield figure(f"{who}, {tolerance:.0e}, largest difference of final coordinates", name, apart)
                steps = {way: float(np.mean(run[1] + run[2])) for way, run in found.items()}
                yield figure(f"{who}, {tolerance:.0e}, tried steps, native", name, steps["native"])
                yield figure(f"{who}, {tolerance:.0e}, tried steps, XLA", name, steps["XLA"])


def heyoka(quick: bool) -> Iterator[Figure]:
    """A thousand spread starts, and motions alone, at equal final error."""
    if heyoka_lowered.heyoka is None:
        print(heyoka_lowered.MISSING)
        return
    for name, span, more in [entry for entry in MOTIONS if entry[2]][: 1 if quick else None]:
        starts = spread_starts(jj.models.MODELS[name](), 128 if quick else LANES)
        for what, value, required in against_heyoka.compared(name, starts, span, more, quick):
            yield figure(what, name, value, required)


def records(quick: bool) -> Iterator[Figure]:
    """2 s of a bicycle whose steer torque is a record of 201 samples, or a function of time, each lane its own; and derivatives for four parameters."""
    scene, name, lanes, scale = jj.models.MODELS["whipple-bicycle"](), "whipple-bicycle", 2 if quick else 8, 1e-8
    start, times = jj.start(scene, rear_spin_rate=15.0, lean_rate=0.05), np.linspace(0.0, 2.0, 201)
    torques = jnp.asarray(0.1 * np.random.default_rng(0).normal(size=(lanes, 201)))
    parameters = jnp.stack([scene.mB, scene.IBxx, scene.zB, scene.mH])

    def wave(torque):
        size, phase = torque[:2]
        return lambda t: size * jnp.sin(5.0 * t + phase)

    kinds = {"record": partial(jj.Sampled, times), "function of time": wave}

    def rates(backend, kind, parameters, torque):
        own = scene.replace(**dict(zip(("mB", "IBxx", "zB", "mH"), parameters, strict=True)))
        options = {"ts": jnp.linspace(0.05, 2.0, 40), "rtol": scale, "atol": scale, "events": False, "backend": backend}
        return jj.simulate(own, start, inputs={"steer_torque": kinds[kind](torque)}, **options).u

    for kind, (what, function) in itertools.product(kinds, (("motion", lambda f: f), ("its derivatives", jax.jacfwd))):
        runs, found = {}, {}
        for way, backend in WAYS.items():
            run = jax.jit(jax.vmap(function(partial(rates, backend, kind)), (None, 0)))
            begin = time.process_time()
            found[way] = np.asarray(run(parameters, torques))
            yield figure(f"{kind}, {what}, {way}, trace, compile and run, s", name, time.process_time() - begin)
            runs[way] = partial(lambda run: jax.block_until_ready(run(parameters, torques)), run)
        seconds = least_processor_time(runs, 3)
        for way in WAYS:
            yield figure(f"{kind}, {what}, {way}, ms per lane", name, 1e3 * seconds[way] / lanes)
        yield figure(f"{kind}, {what}, native / XLA", name, seconds["native"] / seconds["XLA"], 0.5)
        yield figure(f"{kind}, {what}, largest difference", name, float(np.max(np.abs(found["native"] - found["XLA"]))))


def times(quick: bool) -> Iterator[Figure]:
    """Derivatives of a motion with respect to a delay of its saved times, by both modes and both ways."""

    def seen(scene, start, options, delay):
        ts = jnp.linspace(0.2, 1.0, 21) - delay
        return jnp.sum(jnp.sin(jj.simulate(scene, start, t0=0.0, ts=ts, t1=1.0, **options, **BARE).q))

    for name in ("tilting-disc",) if quick else ("tilting-disc", "whipple-bicycle"):
        scene = jj.models.MODELS[name]()
        start = jj.start(scene, **scene.example)
        for mode, differentiated in (("forward", jax.jacfwd), ("reverse", jax.grad)):
            runs, compiled = {}, {}
            for way, backend in WAYS.items():
                slope = jax.jit(differentiated(partial(seen, scene, start, {"backend": backend})))
                begin = time.process_time()
                jax.block_until_ready(slope(0.013))
                compiled[way], runs[way] = time.process_time() - begin, partial(lambda slope: jax.block_until_ready(slope(0.013)), slope)
            seconds = least_processor_time(runs, 50)
            apart = abs(float(runs["native"]()) / float(runs["XLA"]()) - 1.0)
            for way in WAYS:
                yield figure(f"slope with respect to a delay, {mode}, {way}, trace and compile, s", name, compiled[way])
                yield figure(f"slope with respect to a delay, {mode}, {way}, ms", name, 1e3 * seconds[way])
            yield figure(f"slope with respect to a delay, {mode}, relative difference", name, apart, 1e-7)


def watching(quick: bool) -> Iterator[Figure]:
    """What it costs to judge, at every stage of every step, whether the privileged speeds still determine the others: motions with it over motions without."""
    scene, name = jj.models.MODELS["whipple-bicycle"](), "whipple-bicycle"
    speeds, watched = jnp.linspace(-16.0, -15.0, 256), ByProgram.has_pivots

    def last(spin_rate):
        start = {"rear_spin_rate": spin_rate, "lean_rate": 0.1}
        return jj.simulate(scene, start, ts=jnp.array([2.0]), work=False, backend="native").q_end

    def compiled(has_pivots) -> Callable:
        ByProgram.has_pivots = has_pivots
        try:
            run = jax.jit(jax.vmap(last))
            run(speeds).block_until_ready()
        finally:
            ByProgram.has_pivots = watched
        return lambda: run(speeds).block_until_ready()

    runs = {"watched": compiled(watched), "not watched": compiled(property(lambda field: False))}
    seconds = least_processor_time(runs, 15 if quick else 60)
    yield figure("motions whose pivots are watched over such whose are not", name, seconds["watched"] / seconds["not watched"], 1.05)


class Pushed(jj.Scene):
    """A mass that two inputs push, on springs."""

    stiffness: jax.Array = jj.parameter(4.0, unit="N/m")
    coordinates = jj.coordinates("x y")
    inputs = jj.inputs("f g")

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, jnp.stack([q.x, q.y, 0.0 * q.x]))}

    def loads(self, motion):
        f, g = motion.inputs.f - self.stiffness * motion.q.x, motion.inputs.g - self.stiffness * motion.q.y
        return (jj.generalized_force(motion, x_rate=f, y_rate=g),)


def calls(quick: bool) -> Iterator[Figure]:
    """What `simulate` called from Python costs more than the same motion, of 1 s saved 201 times, from a given state under the user's `jit`."""
    two = {
        "two numbers": {"f": 1.0, "g": 0.5},
        "two functions of time": {"f": jnp.sin, "g": lambda t: jnp.cos(2 * t)},
        "two records": {name: jj.Sampled(np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 11) ** power) for name, power in (("f", 2), ("g", 3))},
    }
    cases = [("tilting-disc", jj.models.TiltingDisc(), None, 0.3), ("whipple-bicycle", jj.models.MODELS["whipple-bicycle"](), None, 0.3)]
    cases += [(f"mass pushed by {what}", Pushed(), inputs, 0.5) for what, inputs in two.items()]
    for name, scene, inputs, required in cases[: 1 if quick else None]:
        values = dict(scene.example) or {"x": 0.1}
        options = {"t1": 1.0, "inputs": inputs}
        state = jj.start(scene, **values)
        compiled = jax.jit(lambda state, scene=scene, options=options: jj.simulate(scene, state, **options))
        runs = {
            "jit": lambda compiled=compiled, state=state: jax.block_until_ready(compiled(state)),
            "a state": lambda scene=scene, state=state, options=options: jax.block_until_ready(jj.simulate(scene, state, **options)),
            "named values": lambda scene=scene, values=values, options=options: jax.block_until_ready(jj.simulate(scene, values, **options)),
        }
        seconds = least_processor_time(runs, 50 if quick else 400)
        yield figure("a call under the user's jit, ms", name, 1e3 * seconds["jit"])
        for way in ("a state", "named values"):
            yield figure(f"called from Python with {way}, ms more", name, 1e3 * (seconds[way] - seconds["jit"]), required)


def single(quick: bool) -> Iterator[Figure]:
    """Motions of 2 s in single precision, in processes of their own: machine code rounds what it is given and returns, XLA all that it computes."""
    for name in ("tilting-disc", "whipple-bicycle")[: 1 if quick else 2]:
        lanes = 128 if quick else LANES
        found = json.loads(_output(SINGLE, name, str(lanes), JAX_ENABLE_X64="0", PYTHONPATH=os.pathsep.join(filter(None, sys.path))))
        for who, seconds in found.items():
            what = who if who == "alone" else f"batch of {lanes}"
            count = 1 if who == "alone" else lanes
            for way, time_of_all in seconds.items():
                yield figure(f"single precision, {what}, {way}, us per trajectory", name, 1e6 * time_of_all / count)
            yield figure(f"single precision, {what}, native / XLA", name, seconds["native"] / seconds["xla"], 1.0)


def laws(quick: bool) -> Iterator[Figure]:
    """Batches of scenes whose forces are functions beyond sine and cosine, and their derivatives with respect to the start."""
    lanes = 128 if quick else LANES
    for name, (scene, starts, span) in list(laws_of_force.cases(lanes).items())[: 1 if quick else None]:
        values = {key: jnp.asarray(x) for key, x in starts.items()}
        for what, count, of in (("motion", lanes, lambda f: f), ("forward mode", 8, jax.jacfwd), ("reverse mode", 8, jax.jacrev)):
            runs = {}
            for way, backend in WAYS.items():

                def end(start, scene=scene, span=span, backend=backend):
                    return jj.simulate(scene, start, ts=jnp.array([span]), rtol=1e-8, atol=1e-8, backend=backend).q_end

                run, given, begin = jax.jit(jax.vmap(of(end))), {key: x[:count] for key, x in values.items()}, time.process_time()
                jax.block_until_ready(run(given))
                yield figure(f"{what}, {way}, trace, compile and run, s", name, time.process_time() - begin)
                runs[way] = partial(lambda run, given: jax.block_until_ready(run(given)), run, given)
            seconds = least_processor_time(runs, 3 if quick else 7)
            for way in WAYS:
                yield figure(f"{what}, {way}, us per trajectory", name, 1e6 * seconds[way] / count)
            yield figure(f"{what}, native / XLA", name, seconds["native"] / seconds["XLA"], 1.0)


def compilation(quick: bool) -> Iterator[Figure]:
    """The motion alone, lowered and compiled in this process, once the scene is built; fresh processes to the end of a first motion."""
    for name in ("tilting-disc", "whipple-bicycle"):
        scene = jj.models.MODELS[name]()
        start = jj.start(scene)
        seconds = {}
        for way, backend in WAYS.items():
            begin = time.perf_counter()
            jax.jit(lambda start, backend=backend, scene=scene: jj.simulate(scene, start, backend=backend, t1=1.01).q).lower(start).compile()
            seconds[way] = time.perf_counter() - begin
            yield figure(f"trace and compile one motion, {way}, s", name, seconds[way])
        yield figure("trace and compile one motion, native / XLA", name, seconds["native"] / seconds["XLA"], 1.0)
        for way in WAYS:
            laps = [float(_output(COLD, name, way, JOURDAIN_JAX_CACHE="0")) for _ in range(1 if quick else 3)]
            yield figure(f"fresh process to the end of a first motion, {way}, s", name, min(laps))


def _output(program: str, *arguments: str, **environment: str) -> str:
    done = subprocess.run([sys.executable, "-c", program, *arguments], env=os.environ | environment, capture_output=True, text=True, check=True)
    return done.stdout.split()[-1]


def main() -> None:
    """All figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few lanes, the disc alone")
    parser.add_argument("--json", help="write the figures to this file")
    parts = {part.__name__: part for part in (batches, heyoka, records, times, watching, calls, single, laws, compilation)}
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts), help="these figures")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    figures = [entry for part in options.only for entry in parts[part](options.quick)]
    if options.json:
        with open(options.json, "w") as file:
            json.dump(figures, file, indent=1)


if __name__ == "__main__":
    main()
