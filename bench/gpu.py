"""Kernels of NVIDIA GPUs: what they return is that of the CPU's machine code to the last bit, and how many
motions a second they make.

    python bench/gpu.py [--quick] [--json FILE] [--only NAME ...]

Needs a checkout, llvmlite and, for figures, JAX with CUDA. Without a GPU it runs the checks that need none
(threads of a GPU one after the other on the CPU; text for NVIDIA's driver; `ptxas`, where it is installed)
and writes those rows alone. With `--quick` it looks at six models, otherwise at all. What cannot begin in 7.5
minutes, with `--quick` in three, is left out and named; after ten, with `--quick` four, the process ends.

Bits: programs run on the CPU; every call of machine code in them is made once more on the GPU, with the same
numbers. Figures: starts are made on the device, one time is saved, and the end, its code and the counts come
back; the best of three calls. `--json` writes a list of {"figure", "model", "value", "required", "met"}.
"""

import re
import signal
import sys
import tempfile
import threading
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from figures import figure, main, seconds_of
from jax.interpreters import mlir

import jourdain_jax as jj
from jourdain_jax.integrate.loop import value_kernels
from jourdain_jax.kernels import ffi, host, nvidia
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.studies import Uniform

DISC, BICYCLE = jj.models.TiltingDisc(), jj.models.MODELS["whipple-bicycle"]()
NUMBERS = ("mB", "mR", "mF", "mH", "rR", "rF", "w", "c")  # of a bicycle, by which it is differentiated
TIGHT = {"rtol": 1e-8, "atol": 1e-8}


def disc(spin_rate, t1=2.0, scene=DISC, **options):
    options = {"rtol": 1e-6, "atol": 1e-6, "work": False} | options
    return jj.simulate(scene, {"lean": 0.3, "spin_rate": spin_rate}, ts=[t1], **options)


def bicycle(lean_rate, scene=BICYCLE):
    start = BICYCLE.upright(4.6) | {"lean_rate": lean_rate}
    return jj.simulate(scene, start, ts=[2.0], rtol=1e-6, atol=1e-6, work=False)


def ends(run):
    def of(x):
        found = run(x)
        return found.q_end, found.t_end, found.result

    return of


def size(found):
    return jnp.sum(found.q_end**2)


# least number of motions a second, and the function of what is spread
DISCS = {
    "values": (1.2e8, ends(disc)),
    "tangent": (6e7, lambda x: jax.jacfwd(lambda r: disc(x, scene=DISC.replace(radius=r)).q_end)(0.5)),
    "gradient": (5e6, lambda x: jax.grad(lambda scene: size(disc(x, scene=scene)))(DISC)),
    "10 s at 1e-8, Dopri8": (2e7, ends(lambda x: disc(x, 10.0, **TIGHT))),
    "10 s at 1e-8, Taylor": (3.5e7, ends(lambda x: disc(x, 10.0, solver=jj.Taylor(), **TIGHT))),
}
BICYCLES = {
    "values": (1.8e6, ends(bicycle)),
    "tangent": (1.5e5, lambda x: jax.jacfwd(lambda m: bicycle(x, BICYCLE.replace(mB=m)).q_end)(BICYCLE.mB)),
    "gradient": (
        5e4,
        lambda x: jax.grad(lambda new: size(bicycle(x, BICYCLE.replace(**new))))(
            {name: getattr(BICYCLE, name) for name in NUMBERS}
        ),
    ),
}
KINDS = {"disc": DISCS, "bicycle": BICYCLES}
SPREAD = {"disc": (-6.0, -3.0), "bicycle": (0.1, 0.5)}
FOUR = ("chaplygin-sleigh", "double-pendulum-rods", "rattleback", "snakeboard")
FORMS, SECOND = ("values", "tangent", "gradient"), "second derivatives"
NAMES = {"disc": "tilting-disc", "bicycle": "whipple-bicycle"}
ASSEMBLED = {
    "registers": r"Used (\d+) r",
    "bytes of stack": r"(\d+) bytes stack",
    "bytes spilled": r"(\d+) bytes spill st",
}
OTHERS = sorted(set(jj.models.MODELS) - set(NAMES.values()))


def functions_of(of):
    """Return values, a tangent, a gradient and second derivatives of a model's motion, as functions of the
    varied number.
    """
    from ends_of_models import end_of_model

    model = NAMES.get(of, of)
    numbers = [p for p, value, _ in parameters_of(jj.models.MODELS[model]()) if np.ndim(value) == 0]
    end, x = end_of_model(model, None, numbers[:1], ts=[0.1, 0.2])
    along = lambda s: end(x + s)
    found = {"values": along, "tangent": jax.jacfwd(along)}
    found |= {"gradient": lambda s: jax.grad(end)(x + s), SECOND: lambda s: jax.hessian(end)(x + s)}
    return found | {name: function for name, (_, function) in KINDS.get(of, {}).items()}


def spread(of, lanes) -> jax.Array:
    """Return the number of each lane."""
    return jnp.linspace(*SPREAD.get(of, (0.0, 0.01)), lanes)


def calls_of(f, lanes, of):
    """Every call of machine code in `f` of so many spread lanes on the CPU, with its arguments and
    results.
    """
    calls = []

    def lowered(ctx, *values, handler, lanes, threads, operands, **how):
        results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ctx.avals_out]
        how |= {"handler": handler, "lanes": lanes, "threads": threads, "operands": operands}

        def note(given, found):
            calls.append((how, [*map(np.asarray, given)], [*map(np.asarray, found)]))

        def call(*values):
            found = jax.ffi.ffi_call(handler(lanes, threads), results)(*operands.side_by_side(*values))
            jax.debug.callback(note, values, found)
            return found

        return mlir.lower_fun(call)(ctx, *values)

    jax.clear_caches()
    mlir.register_lowering(value_kernels._call_p, lowered, platform="cpu")
    try:
        with jax.default_device(jax.devices("cpu")[0]):
            jax.block_until_ready(jax.jit(jax.vmap(f))(spread(of, lanes)))
            jax.effects_barrier()
    finally:
        mlir.register_lowering(value_kernels._call_p, value_kernels.on_cpu, platform="cpu")
        jax.clear_caches()
    return calls


def bits(of, name, quick):
    """How many numbers that kernels return differ in a bit from those of the CPU."""
    lanes, differ, count = 10_000, 0, 0
    for how, given, expected in calls_of(functions_of(of)[name], lanes, of):
        found = jax.jit(lambda *x, how=how: value_kernels._call_p.bind(*x, **how))(*given)
        for ours, theirs in zip(map(np.asarray, found), expected, strict=True):
            differ += int(np.sum(ours.view(np.int64) != theirs.view(np.int64)))
            differ -= int(np.sum(np.isnan(ours) & np.isnan(theirs)))
            count += theirs.size
    what = f"numbers of {count} that differ in a bit, {name}"
    yield figure(what, f"{lanes} lanes, {of}", max(differ, 0), 0)


def speed(of, name, lanes, quick):
    """Motions a second."""
    if quick and (of, name) == ("bicycle", "gradient"):
        lanes = 20_000
    (low, high), (required, function), model = SPREAD[of], KINDS[of][name], f"{lanes:g} lanes of a {of}"
    run = jax.jit(lambda: jax.vmap(function)(low + (high - low) * jnp.arange(lanes) / lanes))
    first, seconds = first_and_least(run, 3)
    least = required if lanes >= 1e5 else None
    yield figure(f"motions a second, {name}", model, lanes / seconds, least=least)
    yield figure(f"first call, s, {name}", model, first)


def first_and_least(run, repeats):
    """Return the wall time of the first call, and the least of later ones, s."""
    first, *others = (seconds_of(run, time.perf_counter)[1] for _ in range(1 + repeats))
    return first, min(others)


def alone(of, name, x, required, first_within, quick):
    """One motion."""
    first, seconds = first_and_least(partial(jax.jit(KINDS[of][name][1]), x), 20)
    yield figure(f"compiled and run, s, {name}", f"one {of}", first, first_within)
    yield figure(f"time, ms, {name}", f"one {of}", 1e3 * seconds, required)


def study(lanes, least, quick):
    """A study of discs: samples drawn, motions, statistics of their ends; one lane in a thousand is
    stored.
    """
    of = jj.Study(DISC, start={"lean": 0.3, "spin_rate": Uniform(*SPREAD["disc"])}, samples=lanes)
    with tempfile.TemporaryDirectory() as folder:
        how = {"t1": 2.0, "rtol": 1e-6, "atol": 1e-6, "save": "statistics", "keep_every": 1000}
        run = partial(of.run, progress=False, **how)
        seconds = min(seconds_of(partial(run, f"{folder}/{k}"), time.perf_counter)[1] for k in range(2))
    what = "motions a second, statistics of a study, one lane in a thousand stored"
    yield figure(what, f"{lanes:g} discs", lanes / seconds, least=least)


def failures(quick):
    """A lane that is no number leaves the others alone; what does not fit into memory is an error, after
    which all goes on.
    """
    x = jnp.linspace(-6.0, -3.0, 1000)
    run = jax.jit(jax.vmap(DISCS["values"][1]))
    good, bad = run(x), run(x.at[500].set(jnp.nan))
    changed = jnp.any(good[0] != bad[0], axis=1).at[500].set(False)
    yield figure("lanes beside a failed one that changed", "1000 discs", jnp.sum(changed), 0)
    yield figure("code of a lane that is no number", "disc", int(bad[2][500]), least=1)
    try:
        jax.block_until_ready(jax.jit(lambda: jax.vmap(DISCS["values"][1])(jnp.zeros(2_000_000_000)))())
        said = "nothing"
    except Exception as error:
        said = "RESOURCE_EXHAUSTED" if "RESOURCE_EXHAUSTED" in str(error) else str(error)[:200]
    yield figure("too many lanes are refused", "disc", said)
    yield figure("numbers that changed after that", "1000 discs", jnp.sum(run(x)[0] != good[0]), 0)


def interrupted(quick):
    """Ctrl-C while the device works; then all goes on."""
    x = jnp.linspace(-6.0, -3.0, 3_000_000)
    run = jax.jit(jax.vmap(DISCS["values"][1]))
    good = jax.block_until_ready(run(x))
    timer, said = threading.Timer(0.02, signal.raise_signal, [signal.SIGINT]), "nothing"
    try:
        timer.start()
        jax.block_until_ready(run(x))
        timer.join()
    except KeyboardInterrupt:
        said = "KeyboardInterrupt"
    yield figure("Ctrl-C ends in", "3e6 discs", said)
    yield figure("numbers that changed after that", "3e6 discs", jnp.sum(run(x)[0] != good[0]), 0)


def twin(of, name, quick):
    """What needs no GPU: threads of one on the CPU, and text for its driver."""
    import gpu_twin

    own = jax.vmap(functions_of(of)[name])
    run = lambda: [np.asarray(x) for x in jax.tree.leaves(jax.jit(own)(spread(of, 7)))]
    expected = run()
    for order in ("in order", "reversed", "at once"):
        with gpu_twin.in_place_of_a_gpu(order, memory=2**20) as texts:
            differ = sum(not np.array_equal(*x) for x in zip(run(), expected, strict=True))
        what = f"arrays that differ, threads of a GPU on the CPU {order}, {name}"
        yield figure(what, f"7 lanes, {of}", differ, 0)
    for architecture in ("sm_75", "sm_80", "sm_90", "sm_100"):
        every = [nvidia.text_for(text, architecture) for text in texts]
        missing = sum(len(re.findall(r"^\.extern", ptx, re.M)) for ptx in every)
        yield figure(f"undefined functions for {architecture}, {name}", of, missing, 0)


def resources(of, name, quick):
    """Registers, stack and spills of the kernels of a model, by `ptxas` for compute capability 9.0; kernels
    of an earlier part in the same process are left out.
    """
    import gpu_twin

    before = len(gpu_twin.DRIVER.loaded)
    with gpu_twin.in_place_of_a_gpu():
        jax.jit(jax.vmap(functions_of(of)[name])).lower(spread(of, 7))
    texts = gpu_twin.DRIVER.loaded[before:]
    said = "".join(gpu_twin.said_by_assembler(nvidia.text_for(text, "sm_90")) for text in texts)
    found = [max(map(int, re.findall(pattern, said)), default=0) for pattern in ASSEMBLED.values()]
    yield figure(f"{', '.join(ASSEMBLED)} for sm_90, {name}", of, ", ".join(map(str, found)))


def device(quick):
    """The GPU."""
    yield figure("device", f"jax {jax.__version__}", str(jax.devices()[0].device_kind))


def without_gpu():
    """Parts, and those of `--quick`."""
    if reason := host.reason_against() or nvidia.reason_against_text():
        print(f"no text for GPUs is made: {reason}")
        return {}, []
    import gpu_twin

    pairs = [(of, name) for of in (*KINDS, *FOUR, *OTHERS) for name in (*KINDS.get(of, FORMS), SECOND)]
    parts = {f"on the CPU, {of}, {name}": partial(twin, of, name) for of, name in pairs if name != SECOND}
    if gpu_twin.assembler():
        parts |= {f"assembler, {of}, {name}": partial(resources, of, name) for of, name in pairs}
    parts["on the CPU, study"] = partial(study, 20_000, None)  # the calls alone: the figure is one of the CPU
    quick = ("disc, values", "disc, gradient", "study", *(f"{of}, values" for of in (*FOUR, "bicycle")))
    return parts, [f"on the CPU, {name}" for name in quick]


def with_gpu():
    """Parts, and those of `--quick`."""
    parts = {"device": device}
    parts |= {f"bits, {of}, {name}": partial(bits, of, name) for of in KINDS for name in FORMS}
    parts["one disc, values"] = partial(alone, "disc", "values", -4.0, 1.0, 3.0)
    parts["one disc, gradient"] = partial(alone, "disc", "gradient", -4.0, 3.0, None)
    parts |= {f"speed, disc, {lanes:g}": partial(speed, "disc", "values", lanes) for lanes in (10**6, 10**7)}
    parts |= {f"speed, disc, {name}": partial(speed, "disc", name, 10**6) for name in list(DISCS)[1:]}
    parts |= {"failures": failures, "interrupted": interrupted}
    parts |= {f"speed, bicycle, {name}": partial(speed, "bicycle", name, 10**5) for name in BICYCLES}
    parts["study"] = partial(study, 10**7, 2e7)
    parts["one bicycle, values"] = partial(alone, "bicycle", "values", 0.3, None, 8.0)
    others = {f"bits, {of}, {name}": partial(bits, of, name) for of in (*FOUR, *OTHERS) for name in FORMS}
    quick = parts.keys() - {"bits, bicycle, tangent", "bits, bicycle, gradient"}
    quick |= {name for name in others if any(of in name for of in FOUR)}
    parts |= others
    return parts, [name for name in parts if name in quick]


def in_time(name, part, until):
    """Return a part that does not begin after a time."""

    def run(quick):
        if time.monotonic() > until:
            yield figure("left out: no time was left", name, 1)
        else:
            yield from part(quick)

    return run


if __name__ == "__main__":
    seconds = 240 if "--quick" in sys.argv else 600
    signal.alarm(seconds)  # ends the process
    last = time.monotonic() + 0.75 * seconds
    reason = ffi.reason_against() if jax.default_backend() == "gpu" else "JAX's default backend is no GPU"
    if reason:
        print(f"no GPU: {reason}")
    parts, quick = without_gpu() if reason else with_gpu()
    main(__doc__, {name: in_time(name, part, last) for name, part in parts.items()}, quick=quick)
