"""Every figure about lowered equations, in one run on one core: operations, time per evaluation, whole motions, gradients, growth.

    taskset -c 0 python bench/lowering.py [--quick] [--json FILE] [--only NAME ...]

Writes a list of {"figure", "model", "value", "required", "aim", "met"} (met: the required figure). float64, warm unless said; ratios come from
one run, times are the fastest of some repeats. Baselines, frozen: `bench/baselines` (by hand, dense autodiff, flat arrays).
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Iterator

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ["JOURDAIN_JAX_CACHE"] = "0"  # all is found and compiled here, and what is found beyond the budget of operations is kept for nobody

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense, disc_run
from baselines.hand_derived import HAND_DERIVED, operations
from baselines.timing import fastest, least_processor_time, seconds_per_evaluation

import jourdain_jax as jj
from jourdain_jax.models import PendulumChain, TrailerChain

Figure = dict
BY_HAND_LANES, DENSE_LANES = 4096, 1024


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


# span in s, names of parameters, and which coordinates and speeds of the start vary: eight numbers in all
BY_EIGHT = {
    "tilting-disc": (10.0, ("mass", "radius", "gravity"), (2, 3), (4, 3, 5)),
    "whipple-bicycle": (2.0, ("w", "c", "g", "mB"), (3, 5), (3, 6)),
}
AT_MOST = {"tilting-disc": 4, "whipple-bicycle": 6}  # solves


def final_losses(name: str) -> tuple[Callable, np.ndarray]:
    """A loss of the final coordinates of every lane, as a function of eight numbers each; the eight numbers."""
    scene = jj.models.MODELS[name]()
    span, parameters, of_q, of_u = BY_EIGHT[name]
    start = jj.start(scene, **({"lean": 0.3, "yaw_rate": 0.5, "spin_rate": -3.0} if name == "tilting-disc" else scene.example))
    values = np.array([*(float(getattr(scene, p)) for p in parameters), *start.q[jnp.array(of_q)], *start.u[jnp.array(of_u)]])

    def losses(x):
        options = RUN | {"ts": jnp.array([span]), "rtol": 1e-9, "atol": 1e-9}
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
    for name in ("tilting-disc",) if quick else BY_EIGHT:
        losses, values = final_losses(name)

        def by_forward_mode(x, losses=losses):
            along = jnp.eye(8)[:, None, :] + jnp.zeros_like(x)
            return jax.vmap(lambda v: jax.jvp(losses, (x,), (v,))[1])(along).T

        ways = {
            "solve": losses,
            "forward": by_forward_mode,
            "reverse": jax.grad(lambda x, losses=losses: jnp.sum(losses(x))),
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

        def loss(x, losses=losses):
            return losses(x[None])[0]

        def with_vector(x, v, loss=loss):
            return jax.jvp(jax.grad(loss), (x,), (v,))[1]

        slope, step = jax.jit(jax.jacfwd(loss)), 1e-4 * np.diag(np.maximum(np.abs(values), 0.1))
        differences = np.stack([(slope(x + h) - slope(x - h)) / (2 * np.sum(h)) for h in step])
        runs, seconds = {}, {}
        ways = {"solve": (loss, x), "jacfwd of jacfwd": (jax.jacfwd(jax.jacfwd(loss)), x), "hessian": (jax.hessian(loss), x)}
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

        def loss(x, scene=scene, given=given, free=free, seen=seen, ts=ts):
            return jnp.sum(jj.simulate(scene.replace(**dict(zip(free, x, strict=True))), given, ts=ts)[seen])

        x = jnp.stack([getattr(scene, one) for one in free])
        jax.block_until_ready(jj.simulate(scene, given, ts=ts).q)  # what is found of the scene is not counted
        found = {}
        for way, derivative in (("forward", jax.jacfwd), ("reverse", jax.grad)):
            begin = time.process_time()
            run = jax.jit(derivative(loss)).lower(x).compile()
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

        def loss(scene, start=start):
            return jnp.sum(jj.simulate(scene, start, ts=ts, work=False).u ** 2)

        jax.block_until_ready(loss(scene))  # what is found of the scene is not counted
        found = {}
        for way, derivative in (("forward", jax.jacfwd), ("reverse", jax.grad)):
            begin = time.process_time()
            run = jax.jit(derivative(loss)).lower(scene).compile()
            seconds = time.process_time() - begin
            found[way] = np.concatenate([np.ravel(x) for x in jax.tree.leaves(run(scene))])
            warm = least_processor_time({way: lambda run=run, scene=scene: jax.block_until_ready(run(scene))}, 7)[way]
            print(f"  {name}, {way} mode by all {found[way].size} parameters: compiled in {seconds:.1f} s, {1e3 * warm:.3f} ms", flush=True)
            yield figure(f"trace and compile a derivative by all parameters, {way} mode, s", name, seconds, *((8, 4) if way == "forward" else (10, 5)))
        np.testing.assert_allclose(found["forward"], found["reverse"], rtol=1e-5, atol=1e-5 * np.max(np.abs(found["reverse"])))


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
        growth,
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
