"""Our explicit Runge-Kutta loop, as XLA compiles it, against that of diffrax on the same scalar program: one by one, in blocks of lanes, with gradients.

    taskset -c 0 python bench/loops.py [--quick] [--json FILE]

Both loops are given the same rates (`motion/integrators/integrands.py: rates`), tuples of scalars as states, Dopri8, the same tolerance, first step and norm of
the error, one saved time at the end, no events. Lanes go one by one, or in the same blocks of eight. diffrax is called as it comes, without what a motion of
ours asks of it besides (pivots that are watched, steps that end at saved times, causes of failures), so that this is the least it can take; ours has all that.

    solve      end states
    forward    a derivative of a loss of the end states along one direction, as JAX pushes it through either loop
    reverse    the gradient of that loss with respect to the starts: our recorded steps, and `RecursiveCheckpointAdjoint` with room for `MOST_STEPS` steps

Processor time, warm, the least of some repeats in turn; the numbers that the two find must agree to 1e-6. The JSON is a list of {"figure", "model", "value",
"required", "met"}: time of diffrax over ours. Our loop could go where none of them were above 1.2.
"""

import argparse
import json
import os
from collections.abc import Callable, Iterator

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from baselines.timing import least_processor_time

import jourdain_jax as jj
from jourdain_jax.motion.batches.lockstep import TOGETHER, in_blocks
from jourdain_jax.motion.integration import _begin
from jourdain_jax.motion.integrators import integrands
from jourdain_jax.motion.setup import Begun, Setup
from jourdain_jax.motion.simulate import set_up

jax.config.update("jax_enable_x64", True)

SPANS = {"tilting-disc": 5.0, "chaplygin-sleigh": 5.0, "whipple-bicycle": 2.0}  # s
LANES, REPEATS, TOLERANCE = 128, 7, 1e-8
MOST_STEPS = 256  # of diffrax: what its checkpoints and its record of steps are made for
EARNED = 1.2
ADJOINTS = {"reverse": diffrax.RecursiveCheckpointAdjoint, "forward": diffrax.ForwardMode}


def lanes_of(name: str, adjoint: diffrax.AbstractAdjoint) -> tuple[Setup, Begun]:
    """Motions of a model's example from starts that differ by a hundredth."""
    scene = jj.models.MODELS[name]()
    start = jj.start(scene, **scene.example)
    scales = 1 + 0.01 * np.random.default_rng(0).normal(size=(LANES, 1))
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (LANES, *jnp.shape(x))), start)
    starts = eqx.tree_at(lambda s: s.u, starts, starts.u * scales)
    options = {"ts": jnp.array([SPANS[name]]), "solver": diffrax.Dopri8(), "rtol": TOLERANCE, "atol": TOLERANCE, "events": False, "work": False}
    setups = eqx.filter_vmap(lambda start: set_up(scene, start, backend="xla", adjoint=adjoint, **options))(starts)
    return setups, eqx.filter_vmap(_begin)(setups)


def solved_by_plain_diffrax(setup: Setup, begun: Begun):
    """The end state of one motion by `diffrax.diffeqsolve`, with nothing around it."""
    rtol, atol = setup.tolerances
    return diffrax.diffeqsolve(
        diffrax.ODETerm(integrands.rates),
        diffrax.Dopri8(),
        setup.t0,
        setup.t1,
        setup.dt0,
        begun.y0,
        begun.args,
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol, norm=integrands.state_norm),
        adjoint=ADJOINTS[setup.integrator.mode](),
        max_steps=MOST_STEPS,
        throw=False,
    ).ys


def one_by_one(function: Callable, setups: Setup, begun: Begun):
    """`function` of one lane after another."""
    arrays, rest = eqx.partition((setups, begun), eqx.is_array)
    return jax.lax.map(lambda arrays: function(*eqx.combine(arrays, rest)), arrays)


def apart(setups: Setup) -> Setup:
    """With times that XLA does not know to be the same in all lanes: it moves those through diffrax's `nextafter`, one operation per pass."""
    return eqx.tree_at(lambda s: (s.t0, s.t1, s.dt0), setups, jax.lax.optimization_barrier((setups.t0, setups.t1, setups.dt0)))


def end_states(loop: str, blocks: bool) -> Callable:
    """A function of setups and starts to end states."""
    if loop == "ours":
        solved, lanes_solved = (lambda setup, begun, of=of: getattr(setup.integrator, of)(setup, begun) for of in ("solved", "lanes_solved"))
        solve = lanes_solved if blocks else lambda *lanes: one_by_one(solved, *lanes)
        return lambda *lanes: solve(*lanes).y_end
    if blocks:
        return lambda setups, begun: in_blocks(eqx.filter_vmap(solved_by_plain_diffrax), TOGETHER, apart(setups), begun)
    return lambda *lanes: one_by_one(solved_by_plain_diffrax, *lanes)


def compiled(kind: str, find: Callable, setups: Setup, begun: Begun) -> Callable:
    """What `kind` asks, as a compiled function without arguments."""
    arrays, rest = eqx.partition((setups, begun), eqx.is_array)

    def loss(y0, arrays):
        setups, begun = eqx.combine(arrays, rest)
        found = find(setups, eqx.tree_at(lambda b: b.y0, begun, y0))
        return sum(jnp.sum(x**2) for x in (*found.q, *found.v)), found.q

    along = jax.tree.map(jnp.ones_like, begun.y0)
    asked = {
        "solve": lambda y0, arrays: loss(y0, arrays)[1],
        "forward": lambda y0, arrays: jax.jvp(lambda y0: loss(y0, arrays)[0], (y0,), (along,))[1],
        "reverse": jax.grad(lambda y0, arrays: loss(y0, arrays)[0]),
    }
    run = jax.jit(asked[kind]).lower(begun.y0, arrays).compile()
    return lambda: jax.block_until_ready(run(begun.y0, arrays))


def ratios(quick: bool) -> Iterator[dict]:
    """Time of diffrax over ours."""
    for name in ("tilting-disc",) if quick else SPANS:
        for kind in ("solve",) if quick else ("solve", "forward", "reverse"):
            lanes = lanes_of(name, ADJOINTS["reverse" if kind == "reverse" else "forward"]())
            for blocks in (False, True):
                runs = {loop: compiled(kind, end_states(loop, blocks), *lanes) for loop in ("ours", "diffrax")}
                ours, theirs = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(run())]) for run in runs.values())
                np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6 * np.max(np.abs(theirs)))
                seconds = least_processor_time(runs, 3 if quick else REPEATS)
                where = f"{kind}, {'blocks of eight lanes' if blocks else 'one by one'}"
                print(f"  {name}, {where}: " + ", ".join(f"{loop} {1e3 * s / LANES:.4f} ms" for loop, s in seconds.items()), flush=True)
                value = seconds["diffrax"] / seconds["ours"]
                yield {"figure": f"diffrax / our loop of XLA, {where}", "model": name, "value": value, "required": EARNED, "met": value >= EARNED}


def main() -> None:
    """Measure, print, and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one model, no gradients")
    parser.add_argument("--json", help="file to write")
    options = parser.parse_args()
    found = []
    for entry in ratios(options.quick):
        found.append(entry)
        print("met " if entry["met"] else "MISS", f"{entry['value']:8.2f} (required {entry['required']})  {entry['figure']}: {entry['model']}", flush=True)
    if options.json:
        with open(options.json, "w") as file:
            json.dump(found, file, indent=1)


if __name__ == "__main__":
    main()
