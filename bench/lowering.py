"""Every figure about lowered equations, in one run on one core: operations, time per evaluation, whole motions, gradients, cold starts, growth.

    taskset -c 0 python bench/lowering.py [--quick] [--json FILE] [--only NAME ...]

Writes a list of {"figure", "model", "value", "required", "aim", "met"} (met: the required figure). float64, warm unless said; ratios come from
one run, times are the fastest of some repeats. Baselines, frozen: `bench/baselines` (by hand, dense autodiff, flat arrays, heyoka).
"""

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ["JOURDAIN_JAX_CACHE"] = "0"  # all is found and compiled here, and what is found beyond the budget of operations is kept for nobody

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense, disc_run, heyoka_disc
from baselines.hand_derived import HAND_DERIVED, operations
from baselines.timing import fastest, least_processor_time, seconds_per_evaluation

import jourdain_jax as jj
from jourdain_jax.models import PendulumChain, TiltingDisc, TrailerChain
from jourdain_jax.motion.batches import lockstep
from jourdain_jax.motion.vector_fields.choice import vector_field

Figure = dict
BY_HAND_LANES, DENSE_LANES = 4096, 1024
ALONE = 400  # evaluations per call for one lane: handing over hundreds of scalars takes longer than one evaluation
COLD = """
import time; begin = time.perf_counter()
import jax, sys, jourdain_jax as jj
scene = jj.models.MODELS[sys.argv[1]]()
motion = jj.simulate(scene, backend="auto" if sys.argv[2] == "lowered" else "dense")
jax.block_until_ready(motion.q)
print(time.perf_counter() - begin)
"""


def figure(name: str, model: str, value: float | None, required: float, aim: float, at_least: bool = False) -> Figure:
    """One entry of the result; `value` None where it could not be measured."""
    met = value is not None and (value >= required if at_least else value <= required)
    return {"figure": name, "model": model, "value": value, "required": required, "aim": aim, "met": bool(met)}


def states(name: str, lanes: int):
    """A scene, its lowered program, and admissible states with privileged speeds, one array of lanes per scalar."""
    scene = jj.models.MODELS[name]()
    program = jj.lower(scene)
    _, q, u = jj.sample_states(scene, lanes)
    return scene, program, (tuple(map(jnp.asarray, q.T)), tuple(jnp.asarray(u[:, k]) for k in program.independent))


def operation_ratios(quick: bool) -> Iterator[Figure]:
    """Operations of the lowered right-hand side, relative to the one by hand."""
    for name in HAND_DERIVED:
        value = jj.lower(jj.models.MODELS[name]()).operations / operations(name)
        yield figure("operations, lowered / by hand", name, value, 1.5, 1.1)
    yield figure("operations", "whipple-bicycle", jj.lower(jj.models.MODELS["whipple-bicycle"]()).operations, 2500, 1200)


def evaluation_time(name: str, lanes: int) -> float:
    """Seconds per evaluation and lane of the lowered program."""
    scene, program, state = states(name, lanes)
    fixed, inputs = program.fixed_values(scene), jnp.zeros(len(scene.inputs))
    one = lambda q, y: program.rates(fixed, 0.0, q, y, inputs)[:2]  # noqa: E731
    return seconds_per_evaluation(lambda state: jax.vmap(one)(*state), state, len(state[0][0]), repeats=60)


def evaluation_ratios(quick: bool) -> Iterator[Figure]:
    """Time per evaluation in a batch, relative to hand-written equations in the same layout, and to dense ones."""
    for name in ("tilting-disc",) if quick else HAND_DERIVED:
        known, (scene, _, state) = HAND_DERIVED[name], states(name, BY_HAND_LANES)
        parameters = {key: getattr(scene, key) for key in known.parameters}
        by_hand = seconds_per_evaluation(lambda y, known=known, p=parameters: known.rates(p, 0.0, *y), state, len(state[0][0]), repeats=60)
        yield figure("time per evaluation in a batch of 4096, lowered / by hand", name, evaluation_time(name, BY_HAND_LANES) / by_hand, 1.5, 1.1)
    scene = jj.models.MODELS["whipple-bicycle"]()
    _, q, u = jj.sample_states(scene, DENSE_LANES)
    rates = jax.vmap(lambda y: dense.bicycle_rates(dense.BICYCLE_PARAMETERS, 0.0, y))
    by_dense = seconds_per_evaluation(rates, jnp.concatenate([q, u], axis=1), len(q), evaluations=10, repeats=20)
    ratio = by_dense / evaluation_time("whipple-bicycle", DENSE_LANES)
    yield figure("time per evaluation in a batch of 1024, dense / lowered", "whipple-bicycle", ratio, 15, 40, at_least=True)


def our_starts(y) -> jj.State:
    """States of discs, for minimal ones (lanes, 8): the contact point's speeds follow from the rows."""
    start = jax.tree.map(lambda x: jnp.broadcast_to(0.0 * x, (len(y), *jnp.shape(x))), jj.start(jj.models.MODELS["tilting-disc"]()))
    q, u = y[:, :5], jnp.concatenate([jnp.zeros((len(y), 2)), y[:, 5:]], axis=1)
    return jj.State(start.t, q, u, start.moved_q, start.moved_u, start.residual, start.names, start.guess)


RUN = {"ts": jnp.array([disc_run.END]), "solver": diffrax.Dopri8(), "events": False, "formulation": jj.Formulation(stabilisation=None)}


def our_disc(alone: bool = False) -> Callable:
    """A compiled function `(tolerance, starts)` of initial minimal states to final ones, by `rollout` or `simulate`."""
    scene = jj.models.MODELS["tilting-disc"]()

    @jax.jit
    def compiled(tolerance, y):
        starts, options = our_starts(y), RUN | {"rtol": tolerance, "atol": tolerance}
        if alone:
            motion = jj.simulate(scene, jax.tree.map(lambda x: x[0], starts), **options)
            return jnp.concatenate([motion.q_end, motion.u_end[2:]])[None]
        lanes = jj.rollout(scene, starts, **options).lanes
        return jnp.concatenate([lanes.q_end, lanes.u_end[:, 2:]], axis=1)

    return lambda tolerance, starts: np.asarray(compiled(tolerance, starts))


def disc_seconds(run: Callable, starts, expected, first: float, repeats: int) -> float:
    """Seconds per trajectory at the loosest tolerance with a final error of 1e-8."""
    tolerance, _ = disc_run.loosest(lambda tolerance: run(tolerance, starts), expected, first)
    return fastest(lambda: run(tolerance, starts), repeats) / len(starts)


def disc_motions(quick: bool) -> Iterator[Figure]:
    """10 s of the tilting disc, 1024 lanes, at a final error of 1e-8."""
    starts = disc_run.starts(128 if quick else disc_run.LANES)
    expected = disc_run.reference(starts)
    ours = disc_seconds(our_disc(), starts, expected, 1e-9, 5)
    print(f"  ours: {1e3 * ours:.3f} ms per trajectory in a batch of {len(starts)}", flush=True)
    if not quick:
        plain = disc_seconds(disc_run.final_states("dense", "Dopri8"), starts, expected, 1e-9, 2)
        yield figure("10 s of the disc at error 1e-8, dense / ours", "tilting-disc", plain / ours, 15, 50, at_least=True)
    flat = disc_seconds(disc_run.final_states("flat", "Dopri8"), starts, expected, 1e-9, 3)
    yield figure("10 s of the disc at error 1e-8, by hand in a flat array / ours", "tilting-disc", flat / ours, 3, 10, at_least=True)
    one = disc_run.START[None]
    alone = disc_seconds(our_disc(alone=True), one, disc_run.reference(one), 1e-9, 20)
    print(f"  ours: {1e3 * alone:.3f} ms alone", flush=True)
    names = [("throughput in the batch, ours / heyoka's", ours, 8, 0.15, 1), ("throughput alone, ours / heyoka's", alone, 1, 0.05, 0.5)]
    for name, seconds, width, required, aim in names:
        if heyoka_disc.heyoka is None:
            print(heyoka_disc.MISSING)
            yield figure(name, "tilting-disc", None, required, aim, at_least=True)
            continue
        tolerance, _ = disc_run.loosest(lambda tolerance, width=width: heyoka_disc.final_states(tolerance, width)(starts), expected)
        theirs = heyoka_disc.seconds_per_trajectory(tolerance, width, lanes=len(starts))
        yield figure(name, "tilting-disc", theirs / seconds, required, aim, at_least=True)


# span in s, names of parameters, and which coordinates and speeds of the start vary: eight numbers in all
BY_EIGHT = {
    "tilting-disc": (10.0, ("mass", "radius", "gravity"), (2, 3), (4, 3, 5)),
    "whipple-bicycle": (2.0, ("w", "c", "g", "mB"), (3, 5), (3, 6)),
}
AT_MOST = {"tilting-disc": 4, "whipple-bicycle": 6}  # solves


def final_losses(name: str) -> tuple[Callable, np.ndarray]:
    """A loss of the final coordinates of every lane, as a function of eight numbers each and of an adjoint; the eight numbers."""
    scene = jj.models.MODELS[name]()
    span, parameters, of_q, of_u = BY_EIGHT[name]
    start = jj.start(scene, **({"lean": 0.3, "yaw_rate": 0.5, "spin_rate": -3.0} if name == "tilting-disc" else scene.example))
    values = np.array([*(float(getattr(scene, p)) for p in parameters), *start.q[jnp.array(of_q)], *start.u[jnp.array(of_u)]])

    def losses(x, adjoint):
        options = RUN | {"ts": jnp.array([span]), "rtol": 1e-9, "atol": 1e-9, "adjoint": adjoint}
        starts = jax.tree.map(lambda y: jnp.broadcast_to(y, (len(x), *jnp.shape(y))), start)
        first, middle = len(parameters), len(parameters) + len(of_q)
        q, u = starts.q.at[:, jnp.array(of_q)].set(x[:, first:middle]), starts.u.at[:, jnp.array(of_u)].set(x[:, middle:])
        starts = jj.State(starts.t, q, u, starts.moved_q, starts.moved_u, starts.residual, starts.names, starts.guess)
        if len(x) == 1:
            own = scene.replace(**{p: x[0, k] for k, p in enumerate(parameters)})
            return jnp.sum(jj.simulate(own, jax.tree.map(lambda x: x[0], starts), **options).q_end ** 2)[None]
        lanes = jj.rollout(scene, starts, parameters={p: x[:, k] for k, p in enumerate(parameters)}, **options).lanes
        return jnp.sum(lanes.q_end**2, axis=1)

    return losses, values


def gradients(quick: bool) -> Iterator[Figure]:
    """Gradient of a final-state loss by 8 numbers, best mode, relative to one forward solve at the same tolerance; what each mode takes to compile."""
    forward, reverse = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
    for name in ("tilting-disc",) if quick else BY_EIGHT:
        losses, values = final_losses(name)

        def by_forward_mode(x, losses=losses):
            along = jnp.eye(8)[:, None, :] + jnp.zeros_like(x)
            return jax.vmap(lambda v: jax.jvp(lambda x: losses(x, forward), (x,), (v,))[1])(along).T

        ways = {
            "solve": lambda x, losses=losses: losses(x, forward),
            "forward": by_forward_mode,
            "reverse": jax.grad(lambda x, losses=losses: jnp.sum(losses(x, reverse))),
        }
        for where, lanes in (("alone", 1), ("batched", 1024))[: 1 if quick else 2]:
            x = jnp.asarray(values * (1 + 0.01 * np.random.default_rng(0).normal(size=(lanes, 8))))
            runs, found = {}, {}
            for way, f in ways.items():
                begin = time.process_time()
                runs[way] = jax.jit(f).lower(x).compile()
                seconds = time.process_time() - begin
                found[way] = np.asarray(runs[way](x))
                if way != "solve" and where == "alone":
                    yield figure(
                        f"trace and compile the gradient with respect to 8 numbers, {way}, s", name, seconds, *((6, 3) if way == "forward" else (10, 5))
                    )
            timed = least_processor_time({way: lambda run=run, x=x: jax.block_until_ready(run(x)) for way, run in runs.items()}, 7)
            scale = np.max(np.abs(found["reverse"]))
            np.testing.assert_allclose(found["forward"], found["reverse"], rtol=1e-5, atol=1e-5 * scale)
            print(f"  {name}, {where}: " + ", ".join(f"{way} {1e3 * t / lanes:.3f} ms" for way, t in timed.items()), flush=True)
            best = min(timed["forward"], timed["reverse"])
            yield figure(f"gradient with respect to 8 numbers / one solve, {where}", name, best / timed["solve"], AT_MOST[name], 3)


def second_derivatives(quick: bool) -> Iterator[Figure]:
    """Second derivatives of a final-state loss by 8 numbers in two ways, relative to one solve at the same tolerance; what each takes to compile."""
    for name in ("tilting-disc",) if quick else BY_EIGHT:
        losses, values = final_losses(name)
        x = jnp.asarray(values)

        def forward(x, losses=losses):
            return losses(x[None], diffrax.ForwardMode())[0]

        def both(x, losses=losses):
            return losses(x[None], None)[0]

        def with_vector(x, v, both=both):
            return jax.jvp(jax.grad(both), (x,), (v,))[1]

        slope, step = jax.jit(jax.jacfwd(forward)), 1e-4 * np.diag(np.maximum(np.abs(values), 0.1))
        differences = np.stack([(slope(x + h) - slope(x - h)) / (2 * np.sum(h)) for h in step])
        runs, seconds = {}, {}
        ways = {"solve": (forward, x), "jacfwd of jacfwd": (jax.jacfwd(jax.jacfwd(forward)), x), "hessian": (jax.hessian(both), x)}
        for way, (f, *arguments) in (ways | {"hessian times a vector": (with_vector, x, x)}).items():
            begin = time.process_time()
            run = jax.jit(f).lower(*arguments).compile()
            seconds[way] = time.process_time() - begin
            runs[way] = lambda run=run, arguments=arguments: jax.block_until_ready(run(*arguments))
        scale = np.max(np.abs(differences))
        for way, expected in (("jacfwd of jacfwd", differences), ("hessian", differences), ("hessian times a vector", differences @ x)):
            np.testing.assert_allclose(runs[way](), expected, rtol=1e-4, atol=1e-4 * scale)
        timed = least_processor_time(runs, 7)
        for way in ("jacfwd of jacfwd", "hessian", "hessian times a vector"):
            print(f"  {name}: {way} with respect to 8 numbers compiled in {seconds[way]:.1f} s, {1e3 * timed[way]:.3f} ms", flush=True)
            yield figure(f"trace and compile second derivatives with respect to 8 numbers, {way}, s", name, seconds[way], 20, 10)
            yield figure(f"second derivatives with respect to 8 numbers, {way} / one solve", name, timed[way] / timed["solve"], 64, 32)


NAMED = {
    "tilting-disc": ({"lean": 0.3, "spin_rate": -3.0}, ("radius", "mass", "gravity"), "lean"),
    "whipple-bicycle": ({"lean": 0.05, "rear_spin_rate": 15.0, "lean_rate": 0.2}, ("IBxx", "mB", "c"), "lean"),
}


def named_starts(quick: bool) -> Iterator[Figure]:
    """Derivative of 2 s of a motion by three parameters, its start being named values, which depend on them where they are put onto the rows."""
    for name, (given, free, seen) in list(NAMED.items())[: 1 if quick else 2]:
        scene, ts = jj.models.MODELS[name](), jnp.linspace(0.0, 2.0, 41)

        def loss(x, adjoint, scene=scene, given=given, free=free, seen=seen, ts=ts):
            return jnp.sum(jj.simulate(scene.replace(**dict(zip(free, x, strict=True))), given, ts=ts, adjoint=adjoint)[seen])

        x = jnp.stack([getattr(scene, one) for one in free])
        jax.block_until_ready(jj.simulate(scene, given, ts=ts).q)  # what is found of the scene is not counted
        found = {}
        for way, derivative, adjoint in (("forward", jax.jacfwd, diffrax.ForwardMode()), ("reverse", jax.grad, None)):
            begin = time.process_time()
            run = jax.jit(lambda x, derivative=derivative, adjoint=adjoint: derivative(lambda x: loss(x, adjoint))(x)).lower(x).compile()
            seconds = time.process_time() - begin
            found[way] = np.asarray(run(x))
            warm = least_processor_time({way: lambda run=run, x=x: jax.block_until_ready(run(x))}, 7)[way]
            print(f"  {name}, {way} mode from named values: compiled in {seconds:.1f} s, {1e3 * warm:.3f} ms", flush=True)
            yield figure(f"trace and compile a derivative from named values, {way} mode, s", name, seconds, *((6, 3) if way == "forward" else (10, 5)))
        np.testing.assert_allclose(found["forward"], found["reverse"], rtol=1e-5, atol=1e-5 * np.max(np.abs(found["reverse"])))


def all_parameters(quick: bool) -> Iterator[Figure]:
    """Derivative of all speeds at the saved times of 1 s with respect to every parameter of a scene: what each mode takes to compile."""
    chain, ts = jj.models.TrailerChain(trailers=16), jnp.linspace(0.0, 1.0, 101)
    scenes = {"trailer-chain, n = 16": chain} | ({} if quick else {"whipple-bicycle": jj.models.WhippleBicycle()})
    for name, scene in scenes.items():
        start = jj.start(scene, **scene.example)

        def loss(scene, adjoint, start=start):
            return jnp.sum(jj.simulate(scene, start, ts=ts, adjoint=adjoint, work=False).u ** 2)

        jax.block_until_ready(loss(scene, None))  # what is found of the scene is not counted
        found = {}
        for way, derivative, adjoint in (("forward", jax.jacfwd, diffrax.ForwardMode()), ("reverse", jax.grad, None)):
            begin = time.process_time()
            run = jax.jit(derivative(lambda scene, loss=loss, adjoint=adjoint: loss(scene, adjoint))).lower(scene).compile()
            seconds = time.process_time() - begin
            found[way] = np.concatenate([np.ravel(x) for x in jax.tree.leaves(run(scene))])
            warm = least_processor_time({way: lambda run=run, scene=scene: jax.block_until_ready(run(scene))}, 7)[way]
            print(f"  {name}, {way} mode by all {found[way].size} parameters: compiled in {seconds:.1f} s, {1e3 * warm:.3f} ms", flush=True)
            yield figure(f"trace and compile a derivative by all parameters, {way} mode, s", name, seconds, *((8, 4) if way == "forward" else (10, 5)))
        np.testing.assert_allclose(found["forward"], found["reverse"], rtol=1e-5, atol=1e-5 * np.max(np.abs(found["reverse"])))


def cold_seconds(name: str, way: str) -> float:
    """From a fresh process to the first trajectory: import, build, probe, compile, run."""
    done = subprocess.run([sys.executable, "-c", COLD, name, way], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def cold_starts(quick: bool) -> Iterator[Figure]:
    """Fresh processes."""
    yield figure("fresh process to the first trajectory, s", "whipple-bicycle", cold_seconds("whipple-bicycle", "lowered"), 10, 4)
    for name in () if quick else jj.models.MODELS:
        ratio = cold_seconds(name, "lowered") / cold_seconds(name, "dense")
        yield figure("fresh process, lowered / dense", name, ratio, 1.5, 1)


LONGEST = 200  # trailers of the chain that is to be built in a minute


def growth(quick: bool) -> Iterator[Figure]:
    """Time per step over n of motions of chains of trailers and of pendulums, and their compile time."""
    few, many = (2, 4) if quick else (8, 64)
    for name, make in (("trailer-chain", lambda n: TrailerChain(trailers=n)), ("pendulum-chain", lambda n: PendulumChain(links=n))):
        laps, compile_time = {}, None
        for n in (few, many):
            scene = make(n)
            begin = time.perf_counter()
            try:
                program = jj.lower(scene)
            except jj.NotLowered as reason:
                print(f"  {name}, n = {n}: {reason}")
                break
            start = jj.start(scene, **scene.example)
            run = jax.jit(lambda start, scene=scene: jj.simulate(scene, start, ts=jnp.array([1.0]), events=False))
            motion = run(start).raise_if_failed()
            compile_time = time.perf_counter() - begin
            seconds = least_processor_time({"run": lambda run=run, start=start: jax.block_until_ready(run(start).q_end)}, 7)["run"]
            laps[n] = seconds / int(motion.accepted + motion.rejected) / n
            told = f"{1e6 * laps[n]:.2f} us per step and link ({motion.reduction}), built and compiled in {compile_time:.1f} s"
            print(f"  {name}, n = {n}: {program.operations} operations, {told}")
        complete = len(laps) == 2
        yield figure(f"time per step / n, n = {many} against n = {few}", name, laps[many] / laps[few] if complete else None, 3, 1.5)
        yield figure(f"build and compile time at n = {many}, s", name, compile_time if complete else None, 60, 15)
    if not quick:
        begin = time.perf_counter()
        jj.simulate(TrailerChain(trailers=LONGEST), t1=1.0).raise_if_failed()
        yield figure(f"n = {LONGEST}, built and its first motion, s", "trailer-chain", time.perf_counter() - begin, 60, 24)


class TabulatedDisc(TiltingDisc):
    """With rolling resistance by a table."""

    def loads(self, motion):
        speeds = jnp.linspace(0.0, 10.0, 21)
        resistance = jnp.sign(motion.u.spin_rate) * jnp.interp(jnp.abs(motion.u.spin_rate), speeds, 0.01 * jnp.sqrt(speeds))
        return (*super().loads(motion), jj.generalized_force(motion, spin_rate=-resistance))


class LearnedDisc(TiltingDisc):
    """With torques by a network of two hidden layers of 32."""

    first: object = eqx.field(default_factory=lambda: np.random.default_rng(0).normal(size=(32, 4)))
    second: object = eqx.field(default_factory=lambda: np.random.default_rng(1).normal(size=(32, 32)) / 8)
    last: object = eqx.field(default_factory=lambda: np.random.default_rng(2).normal(size=(2, 32)) / 100)

    def loads(self, motion):
        u = motion.u
        state = jnp.stack([motion.q.lean, u.lean_rate, u.yaw_rate, u.spin_rate])
        lean, spin = self.last @ jnp.tanh(self.second @ jnp.tanh(self.first @ state))
        return (*super().loads(motion), jj.generalized_force(motion, lean_rate=lean, spin_rate=spin))


class IteratedDisc(TiltingDisc):
    """With rolling resistance by Newton's method."""

    def loads(self, motion):
        newton = lambda v: v - (v**3 + v - motion.u.spin_rate) / (3 * v * v + 1)  # noqa: E731
        root = jax.lax.while_loop(lambda v: jnp.abs(newton(v) - v) > 1e-12, newton, jnp.zeros_like(motion.u.spin_rate))
        return (*super().loads(motion), jj.generalized_force(motion, spin_rate=-0.01 * root))


def opaque_calls(quick: bool) -> Iterator[Figure]:
    """2 s of a disc with a load that has no scalar form, alone and in a batch of 1024: our dense path relative to the lowered scene with a call."""
    if quick:
        return
    for scene in (TabulatedDisc(), LearnedDisc(), IteratedDisc()):
        for lanes in (1, 1024):
            lean = jnp.linspace(0.1, 0.3, lanes)
            seconds = {}
            for backend in ("auto", "dense"):
                options = {"ts": jnp.array([2.0]), "rtol": 1e-8, "atol": 1e-8, "events": False, "backend": backend}
                run = jax.jit(lambda lean, s=scene, o=options: jj.rollout(s, {"lean": lean, "spin_rate": -3.0}, **o).lanes.q_end)
                if lanes == 1:
                    run = jax.jit(lambda lean, s=scene, o=options: jj.simulate(s, {"lean": lean[0], "spin_rate": -3.0}, **o).q_end)
                seconds[backend] = fastest(lambda run=run, lean=lean: jax.block_until_ready(run(lean)), 5 if backend == "auto" else 2) / lanes
            print(f"  {type(scene).__name__}, {lanes} lanes: {1e3 * seconds['auto']:.3f} ms per trajectory, dense {1e3 * seconds['dense']:.3f} ms", flush=True)
            yield figure(f"2 s with a call, dense / lowered, {lanes} lanes", type(scene).__name__, seconds["dense"] / seconds["auto"], 5, 20, at_least=True)


class AngleChain(jj.Scene):
    """A plane chain of massless links in its joint angles, a particle at the end of each: no rows, M full, where unrolled elimination is at its worst."""

    links: int = eqx.field(static=True, default=4)
    mass: object = jj.parameter(0.2, unit="kg", positive=True)
    length: object = jj.parameter(0.3, unit="m", positive=True)

    @property
    def coordinates(self):
        """The angle of every joint."""
        return jj.coordinates(" ".join(f"angle{i}" for i in range(1, self.links + 1)))

    def bodies(self, t, q):
        """The particles, from the pivot on."""
        bodies, turn, place = {}, 0.0, jnp.zeros(3)
        for i in range(1, self.links + 1):
            turn = turn + q[f"angle{i}"]
            place = place + self.length * jnp.stack([jnp.sin(turn), 0.0 * turn, -jnp.cos(turn)])
            bodies[f"particle {i}"] = jj.Particle(self.mass, place)
        return bodies

    def loads(self, motion):
        """Weight."""
        return (jj.gravity(motion, 9.81),)


def many_times(rates: Callable, state, evaluations: int):
    """A state after so many explicit Euler steps of a microsecond."""
    return jax.lax.fori_loop(0, evaluations, lambda _, y: jax.tree.map(lambda y, rate: y + 1e-6 * rate, y, rates(y)), state)


def seconds_to_compile_and_run(function: Callable, state, lanes: int) -> tuple[float, float]:
    """Seconds to compile `many_times` of some rates, and per evaluation and lane."""
    evaluations, repeats = (ALONE, 20) if lanes == 1 else (10, 3)
    begin = time.perf_counter()
    compiled = jax.jit(lambda state: function(state, evaluations)).lower(state).compile()
    taken = time.perf_counter() - begin
    return taken, fastest(lambda: jax.block_until_ready(compiled(state)), repeats) / (evaluations * lanes)


BEYOND = 60_000  # operations, that `limit` asks for beyond the budget of the engine
SIZES = (
    ("angle-chain", lambda n: AngleChain(links=n), (4, 8, 12, 16, 20, 24)),
    ("pendulum-chain", lambda n: PendulumChain(links=n), (8, 16, 32)),
    ("trailer-chain", lambda n: TrailerChain(trailers=n), (8, 16)),  # 32: minutes to compile densely
)


def ways_of(scene: jj.Scene, program: jj.Lowered) -> dict[str, tuple]:
    """Way -> function of a state and of how often, the state, its lanes: by the program and densely, alone and in a batch as `rollout` runs it."""
    form, fixed, inputs = vector_field(scene, backend="dense"), program.fixed_values(scene), jnp.zeros(len(scene.inputs))
    _, q, u = (jnp.asarray(x) for x in jj.sample_states(scene, DENSE_LANES))
    by_program = lambda y: program.rates(fixed, 0.0, *y, inputs)[:2]  # noqa: E731
    densely = lambda y: form.rates(scene, (), 0.0, y, inputs)  # noqa: E731
    scalars, packed = (tuple(q.T), tuple(u[:, k] for k in program.independent)), jax.vmap(form.pack)(q, u)
    first = lambda state: jax.tree.map(lambda x: x[0], state)  # noqa: E731
    return {
        "lowered": (lambda y, n: many_times(by_program, y, n), first(scalars), 1),
        "lowered, batch": (lambda y, n: lockstep.in_blocks(lambda y: many_times(by_program, y, n), lockstep.width(program), y), scalars, DENSE_LANES),
        "dense": (lambda y, n: many_times(densely, y, n), first(packed), 1),
        "dense, batch": (lambda y, n: many_times(jax.vmap(densely), y, n), packed, DENSE_LANES),
    }


def limit(quick: bool) -> Iterator[Figure]:
    """Lowered against dense over the size of a scene, beyond the budget of operations too: time per evaluation, and what it takes to compile."""
    if quick:
        return
    lower_module = importlib.import_module("jourdain_jax.lowering.lower")
    budget, lower_module.MOST_OPERATIONS, lower_module.MOST_IN_MACHINE_CODE = lower_module.MOST_OPERATIONS, BEYOND, BEYOND
    for name, make, counts in SIZES:
        for n in counts:
            scene, begin = make(n), time.perf_counter()
            try:
                program = jj.lower(scene)
            except jj.NotLowered as reason:
                print(f"  {name}, n = {n}: {reason}", flush=True)
                continue
            built = time.perf_counter() - begin
            found = {way: seconds_to_compile_and_run(*asked) for way, asked in ways_of(scene, program).items()}
            print(f"  {name}, n = {n}: {program.operations} operations, lowered in {built:.1f} s", flush=True)
            for way, (compiled, seconds) in found.items():
                print(f"    {way}: compiled in {compiled:.1f} s, {1e6 * seconds:.2f} us per evaluation and lane", flush=True)
            if program.operations > budget:
                continue  # the engine takes the dense path
            for where in ("", ", batch"):
                ratio = found[f"lowered{where}"][1] / found[f"dense{where}"][1]
                yield figure(f"time per evaluation, lowered / dense{where}, n = {n}, {program.operations} operations", name, ratio, 1, 0.1)


FIGURES = {
    f.__name__: f
    for f in (
        operation_ratios,
        evaluation_ratios,
        disc_motions,
        gradients,
        second_derivatives,
        all_parameters,
        named_starts,
        cold_starts,
        growth,
        opaque_calls,
        limit,
    )
}


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a reduced set, in less than a minute")
    parser.add_argument("--json", help="file to write")
    parser.add_argument("--only", nargs="*", choices=FIGURES, default=list(FIGURES))
    options = parser.parse_args()
    print(f"jax {jax.__version__}, Python {platform.python_version()}, {platform.processor() or platform.machine()}, one core", flush=True)
    found = []
    for name in options.only:
        for entry in FIGURES[name](options.quick):
            found.append(entry)
            value = "not measured" if entry["value"] is None else f"{entry['value']:.3g}"
            said = f"{value:>12} (required {entry['required']}, aim {entry['aim']})  {entry['figure']}: {entry['model']}"
            print("met " if entry["met"] else "MISS", said, flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(found, file, indent=1)


if __name__ == "__main__":
    main()
