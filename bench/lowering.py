"""Every figure about lowered equations, in one run on one core: operations, time per evaluation, whole
motions, gradients, growth.

    taskset -c 0 python bench/lowering.py [--quick] [--json FILE] [--only NAME ...]

Writes a list of {"figure", "model", "value", "required", "met"}. float64, warm unless said; ratios come from
one run, times are the fastest of some repeats. Baselines, frozen: `bench/baselines` (by hand, dense autodiff,
flat arrays).
"""

import os
import time
from functools import partial

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
# all is found and compiled here, and what is found beyond the budget of operations is kept for nobody
os.environ["JOURDAIN_JAX_CACHE"] = "0"

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense, disc_run
from baselines.hand_derived import HAND_DERIVED, operations
from figures import compiled, fastest, figure, least_processor_time, main
from minimal_states import final_states, starts_at

import jourdain_jax as jj
from jourdain_jax.models import PendulumChain, TrailerChain

BY_HAND_LANES, DENSE_LANES = 4096, 1024
COMPILED = {"forward": 6, "reverse": 10}  # s


def seconds_per_evaluation(rates, state, lanes, evaluations=20, repeats=60):
    """Time per evaluation of `rates(state)` of a whole batch and per lane, inside a compiled loop, as a
    solver calls it: fastest of some repeats, s.

    The loop takes explicit Euler steps, so short that the states stay where they start; one multiplication
    and addition per state are part of the time.
    """

    @jax.jit
    def loop(state):
        return jax.lax.fori_loop(
            0, evaluations, lambda _, y: jax.tree.map(lambda y, rate: y + 1e-6 * rate, y, rates(y)), state
        )

    return fastest(lambda: jax.block_until_ready(loop(state)), repeats) / (lanes * evaluations)


def states(name, lanes):
    """A scene, its lowered program, and admissible states with privileged speeds, one array of lanes per
    scalar.
    """
    scene = jj.models.MODELS[name]()
    program = jj.lower(scene)
    _, q, u = jj.sample_states(scene, lanes)
    speeds = u[:, list(program.independent)]
    return scene, program, (tuple(map(jnp.asarray, q.T)), tuple(map(jnp.asarray, speeds.T)))


def operation_ratios(quick):
    """Operations of the lowered right-hand side, relative to the one by hand."""
    for name in HAND_DERIVED:
        value = jj.lower(jj.models.MODELS[name]()).operations / operations(name)
        yield figure("operations, lowered / by hand", name, value, 1.5)
    yield figure("operations", "whipple-bicycle", jj.lower(jj.models.WhippleBicycle()).operations, 2500)


def evaluation_time(name, lanes):
    """Seconds per evaluation and lane of the lowered program."""
    scene, program, state = states(name, lanes)
    fixed, inputs = program.fixed_values(scene), jnp.zeros(len(scene.inputs))
    one = lambda q, y: program.rates(fixed, 0.0, q, y, inputs)[:2]
    return seconds_per_evaluation(lambda state: jax.vmap(one)(*state), state, len(state[0][0]))


def evaluation_ratios(quick):
    """Time per evaluation in a batch, relative to hand-written equations in the same layout, and to dense
    ones.
    """
    for name in ("tilting-disc",) if quick else HAND_DERIVED:
        known, (scene, _, state) = HAND_DERIVED[name], states(name, BY_HAND_LANES)
        parameters = {key: getattr(scene, key) for key in known.parameters}
        rates = lambda y, known=known, p=parameters: known.rates(p, 0.0, *y)
        by_hand = seconds_per_evaluation(rates, state, len(state[0][0]))
        ratio = evaluation_time(name, BY_HAND_LANES) / by_hand
        yield figure("time per evaluation in a batch of 4096, lowered / by hand", name, ratio, 1.5)
    _, q, u = jj.sample_states(jj.models.WhippleBicycle(), DENSE_LANES)
    rates = jax.vmap(lambda y: dense.bicycle_rates(dense.BICYCLE_PARAMETERS, 0.0, y))
    state, name = jnp.concatenate([q, u], axis=1), "whipple-bicycle"
    by_dense = seconds_per_evaluation(rates, state, len(q), evaluations=10, repeats=20)
    ratio = by_dense / evaluation_time(name, DENSE_LANES)
    yield figure("time per evaluation in a batch of 1024, dense / lowered", name, ratio, least=15)


RUN = {"solver": diffrax.Dopri8(), "events": False, "formulation": jj.Formulation(stabilisation=None)}


def disc_seconds(run, starts, expected, repeats):
    """Seconds per trajectory at the loosest tolerance with a final error of 1e-8."""
    tolerance = disc_run.loosest(lambda tolerance: run(tolerance, starts), expected, 1e-9)
    return fastest(lambda: run(tolerance, starts), repeats) / len(expected)


def disc_motions(quick):
    """10 s of the tilting disc, 1024 lanes, at a final error of 1e-8."""
    scene, name, what = jj.models.TiltingDisc(), "tilting-disc", "10 s of the disc at error 1e-8"
    starts, one = disc_run.starts(128 if quick else disc_run.LANES), disc_run.START[None]
    expected = disc_run.reference(starts)
    ours = disc_seconds(final_states(scene, disc_run.END, **RUN), starts_at(scene, starts), expected, 5)
    yield figure(f"{what} in a batch, ms per trajectory", name, 1e3 * ours)
    if not quick:
        plain = disc_seconds(disc_run.final_states("dense"), starts, expected, 2)
        yield figure(f"{what}, dense / ours", name, plain / ours, least=15)
    flat = disc_seconds(disc_run.final_states("flat"), starts, expected, 3)
    yield figure(f"{what}, by hand in a flat array / ours", name, flat / ours, least=3)
    run = final_states(scene, disc_run.END, True, **RUN)
    alone = disc_seconds(run, starts_at(scene, one), disc_run.reference(one), 20)
    yield figure(f"{what} alone, ms", name, 1e3 * alone)


# span in s, names of parameters, and which coordinates and speeds of the start vary: eight numbers in all
BY_EIGHT = {
    "tilting-disc": (10.0, ("mass", "radius", "gravity"), (2, 3), (4, 3, 5)),
    "whipple-bicycle": (2.0, ("w", "c", "g", "mB"), (3, 5), (3, 6)),
}
AT_MOST = {"tilting-disc": 4, "whipple-bicycle": 6}  # solves


def final_losses(name):
    """A loss of the final coordinates of every lane, as a function of eight numbers each; the eight
    numbers.
    """
    scene = jj.models.MODELS[name]()
    span, names, of_q, of_u = BY_EIGHT[name]
    of_q, of_u = jnp.array(of_q), jnp.array(of_u)
    turning = {"lean": 0.3, "yaw_rate": 0.5, "spin_rate": -3.0}
    start = jj.start(scene, turning if name == "tilting-disc" else scene.example)
    values = np.array([*(float(getattr(scene, p)) for p in names), *start.q[of_q], *start.u[of_u]])
    options = RUN | {"ts": jnp.array([span]), "rtol": 1e-9, "atol": 1e-9}

    def losses(x):
        parameters = dict(zip(names, x.T[: len(names)], strict=True))
        starts = jax.tree.map(lambda y: jnp.broadcast_to(y, (len(x), *jnp.shape(y))), start)
        q, u = jnp.split(x[:, len(names) :], [len(of_q)], axis=1)
        q, u = starts.q.at[:, of_q].set(q), starts.u.at[:, of_u].set(u)
        starts = eqx.tree_at(lambda state: (state.q, state.u), starts, (q, u))
        if len(x) == 1:
            alone = jax.tree.map(lambda y: y[0], (parameters, starts))
            return jnp.sum(jj.simulate(scene.replace(**alone[0]), alone[1], **options).q_end ** 2)[None]
        lanes = jj.rollout(scene, starts, parameters=parameters, **options).lanes
        return jnp.sum(lanes.q_end**2, axis=1)

    return losses, values


def by_forward_mode(losses, x):
    """The gradient of the loss of every lane by its eight numbers."""
    along = jnp.eye(8)[:, None, :] + jnp.zeros_like(x)
    return jax.vmap(lambda v: jax.jvp(losses, (x,), (v,))[1])(along).T


def assert_close(found, expected, off=1e-5):
    """Numbers are equal up to the tolerance of the motions."""
    np.testing.assert_allclose(found, expected, rtol=off, atol=off * np.max(np.abs(expected)))


def gradients(quick):
    """Gradient of a final-state loss by 8 numbers, best mode, relative to one forward solve at the same
    tolerance; what each mode takes to compile.
    """
    what = "gradient with respect to 8 numbers"
    for name in ("tilting-disc",) if quick else BY_EIGHT:
        losses, values = final_losses(name)
        ways = {
            "solve": losses,
            "forward": partial(by_forward_mode, losses),
            "reverse": jax.grad(lambda x, losses=losses: jnp.sum(losses(x))),
        }
        for where, lanes in (("alone", 1), ("batched", 1024))[: 1 if quick else 2]:
            x = jnp.asarray(values * (1 + 0.01 * np.random.default_rng(0).normal(size=(lanes, 8))))
            runs = {}
            for way, f in ways.items():
                runs[way], seconds = compiled(f, x)
                if way != "solve" and where == "alone":
                    yield figure(f"trace and compile the {what}, {way}, s", name, seconds, COMPILED[way])
            assert_close(runs["forward"](), runs["reverse"]())
            timed = least_processor_time(runs, 7)
            for way, seconds in timed.items():
                yield figure(f"{what}, {where}, {way}, ms", name, 1e3 * seconds / lanes)
            ratio = min(timed["forward"], timed["reverse"]) / timed["solve"]
            yield figure(f"{what} / one solve, {where}", name, ratio, AT_MOST[name])


def along_itself(function, x):
    """The derivative of a function of x along x."""
    return jax.jvp(function, (x,), (x,))[1]


def second_derivatives(quick):
    """Second derivatives of a final-state loss by 8 numbers in two ways, relative to one solve at the same
    tolerance; what each takes to compile.
    """
    for name in ("tilting-disc",) if quick else BY_EIGHT:
        losses, values = final_losses(name)
        x = jnp.asarray(values)
        loss = lambda x, losses=losses: losses(x[None])[0]
        slope, step = jax.jit(jax.jacfwd(loss)), 1e-4 * np.diag(np.maximum(np.abs(values), 0.1))
        differences = np.stack([(slope(x + h) - slope(x - h)) / (2 * np.sum(h)) for h in step])
        ways = {
            "jacfwd of jacfwd": (jax.jacfwd(jax.jacfwd(loss)), differences),
            "hessian": (jax.hessian(loss), differences),
            "hessian times a vector": (partial(along_itself, jax.grad(loss)), differences @ x),
        }
        runs, seconds = {"solve": compiled(loss, x)[0]}, {}
        for way, (f, expected) in ways.items():
            runs[way], seconds[way] = compiled(f, x)
            scale = np.max(np.abs(differences))
            np.testing.assert_allclose(runs[way](), expected, rtol=1e-4, atol=1e-4 * scale)
        timed = least_processor_time(runs, 7)
        for way in ways:
            what = f"second derivatives with respect to 8 numbers, {way}"
            yield figure(f"trace and compile {what}, s", name, seconds[way], 20)
            yield figure(f"{what}, ms", name, 1e3 * timed[way])
            yield figure(f"{what} / one solve", name, timed[way] / timed["solve"], 64)


def both_modes(what, name, loss, x, forward):
    """What the derivative of a loss takes to compile by each mode (`forward`: at most, s, by that), and once
    it is compiled.
    """
    jax.block_until_ready(loss(x))  # what is found of the scene is not counted
    found = {}
    for way, derivative in (("forward", jax.jacfwd), ("reverse", jax.grad)):
        run, seconds = compiled(derivative(loss), x)
        found[way] = np.concatenate([np.ravel(x) for x in jax.tree.leaves(run())])
        most = forward if way == "forward" else COMPILED[way]
        yield figure(f"trace and compile a derivative {what}, {way} mode, s", name, seconds, most)
        warm = least_processor_time({way: run}, 7)[way]
        yield figure(f"a derivative {what}, {way} mode, ms", name, 1e3 * warm)
    assert_close(found["forward"], found["reverse"])


NAMED = {
    "tilting-disc": ({"lean": 0.3, "spin_rate": -3.0}, ("radius", "mass", "gravity")),
    "whipple-bicycle": ({"lean": 0.05, "rear_spin_rate": 15.0, "lean_rate": 0.2}, ("IBxx", "mB", "c")),
}


def named_starts(quick):
    """Derivative of 2 s of a motion by three parameters, its start being named values, which depend on them
    where they are put onto the rows.
    """
    for name, (given, free) in list(NAMED.items())[: 1 if quick else 2]:
        scene, ts = jj.models.MODELS[name](), jnp.linspace(0.0, 2.0, 41)

        def loss(x, scene=scene, given=given, ts=ts):
            return jnp.sum(jj.simulate(scene.replace(**x), given, ts=ts)["lean"])

        x = {one: getattr(scene, one) for one in free}
        yield from both_modes("from named values", name, loss, x, COMPILED["forward"])


def all_parameters(quick):
    """Derivative of all speeds at the saved times of 1 s with respect to every parameter of a scene: what
    each mode takes to compile.
    """
    scenes = {
        "trailer-chain, n = 16": TrailerChain(trailers=16),
        "whipple-bicycle": jj.models.WhippleBicycle(),
    }
    ts = jnp.linspace(0.0, 1.0, 101)
    for name, scene in list(scenes.items())[: 1 if quick else 2]:
        start = jj.start(scene, scene.example)

        def loss(scene, start=start):
            return jnp.sum(jj.simulate(scene, start, ts=ts, work=False).u ** 2)

        yield from both_modes("by all parameters", name, loss, scene, 8)


LONGEST = 200  # trailers of the chain that is to be built in a minute


def growth(quick):
    """Time per step over n of motions of chains of trailers and of pendulums, and their compile time."""
    few, many = (2, 4) if quick else (8, 64)
    chains = (("trailer-chain", TrailerChain, "trailers"), ("pendulum-chain", PendulumChain, "links"))
    for name, chain, link in chains:
        laps, built = {}, {}
        for n in (few, many):
            scene, begin = chain(**{link: n}), time.perf_counter()
            try:
                program = jj.lower(scene)
            except jj.NotLowered as reason:
                print(f"  {name}, n = {n}: {reason}")
                break
            start = jj.start(scene, scene.example)
            moved = partial(jj.simulate, scene, ts=jnp.array([1.0]), events=False)
            run = partial(jax.jit(lambda start, moved=moved: moved(start)), start)
            motion = run().raise_if_failed()
            built[n] = time.perf_counter() - begin
            seconds = least_processor_time({"run": run}, 7)["run"]
            laps[n] = seconds / int(motion.accepted + motion.rejected) / n
            yield figure(f"operations, n = {n}", name, program.operations)
            yield figure(f"us per step and link, n = {n}, {motion.reduction}", name, 1e6 * laps[n])
        ratio = laps[many] / laps[few] if many in laps else None
        yield figure(f"time per step / n, n = {many} against n = {few}", name, ratio, 3)
        yield figure(f"build and compile time at n = {many}, s", name, built.get(many), 60)
    if not quick:
        begin = time.perf_counter()
        jj.simulate(TrailerChain(trailers=LONGEST), t1=1.0).raise_if_failed()
        seconds = time.perf_counter() - begin
        yield figure(f"n = {LONGEST}, built and its first motion, s", "trailer-chain", seconds, 60)


if __name__ == "__main__":
    main(
        __doc__,
        (
            operation_ratios,
            evaluation_ratios,
            disc_motions,
            gradients,
            second_derivatives,
            all_parameters,
            named_starts,
            growth,
        ),
    )
