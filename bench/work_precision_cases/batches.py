"""Batches of 1, 100 and 10,000 trajectories with starts that differ by 5 %: time per trajectory against the
largest error over the first 100 lanes.
"""

from functools import cache, partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines import heyoka_disc, heyoka_lowered
from minimal_states import final_states, starts_at

import jourdain_jax as jj
from jourdain_jax.integrate.explicit_steps import order_for
from work_precision_cases import peer_c, peer_diffrax, peer_heyoka
from work_precision_cases import record as records
from work_precision_cases.curve import NotApplicable
from work_precision_cases.measure import fastest
from work_precision_cases.ours import MAX_STEPS

SIZES = (1, 100, 10_000)
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
PROBLEMS = ("tilting-disc", "chaplygin-sleigh")
JUDGED = 100  # lanes
SCATTER = 0.05
SIMD = 8
LONGEST = 60.0  # s: a method that would take longer than that for a batch is left out


def starts(problem, lanes):
    """Minimal states (lanes, states), every number of the start changed by 5 % (standard deviation)."""
    start = problem.minimal_start
    normal = np.random.default_rng(0).normal(size=(max(lanes, JUDGED), len(start)))
    return start * (1 + SCATTER * normal[:lanes])


def by_rollout(problem, solver=None):
    """`rollout` under `jit`, by Dopri8 unless said; the consistent starts are given."""
    options = {"solver": solver or diffrax.Dopri8(), "events": False, "max_steps": MAX_STEPS}
    run = final_states(problem.scene, problem.end, **options)

    def prepared(y):
        starts = starts_at(problem.scene, y)
        return lambda tolerance: np.asarray(run(jnp.asarray(tolerance), starts))

    return prepared


def by_series(problem):
    """As `by_rollout`, by Taylor series of the order for each tolerance."""
    made = cache(lambda tolerance: by_rollout(problem, jj.Taylor(order_for(tolerance))))

    def prepared(y):
        ready = cache(lambda tolerance: made(tolerance)(y))
        return lambda tolerance: ready(tolerance)(tolerance)

    return prepared


def by_vmap(problem):
    """diffrax under `vmap` on the equations by hand."""
    one = peer_diffrax.motion(problem)
    return _of_starts(lambda tolerance, y: jax.vmap(lambda y: one(tolerance, y)[0])(y))


def _of_starts(integrated):
    compiled = jax.jit(integrated)
    return lambda y: lambda tolerance: np.asarray(compiled(jnp.asarray(tolerance), jnp.asarray(y)))


def in_blocks(problem):
    """diffrax on the equations by hand, states as tuples of scalars, eight lanes side by side, one block of
    them after another.
    """
    one = peer_diffrax.motion(problem, stacked=False)
    end = lambda tolerance, y: jnp.stack(one(tolerance, tuple(y))[0])
    return _of_starts(lambda tolerance, y: jax.lax.map(partial(end, tolerance), y, batch_size=SIMD))


def by_c(problem):
    """The equations by hand in C, eight lanes side by side, one at a time alone."""
    alone, many = (peer_c.compiled(problem, width) for width in (1, SIMD))
    return lambda y: lambda tolerance: (many if len(y) >= SIMD else alone)(tolerance, y)[0]


def by_heyoka(system):
    """heyoka, eight trajectories in the lanes of SIMD registers, one at a time alone."""

    def of(problem):
        made = cache(partial(heyoka_lowered.final_states, system(problem), problem.end))

        def prepared(y):
            width = SIMD if len(y) >= SIMD else 1
            padded = np.concatenate([y, y[: -len(y) % width]])
            return lambda tolerance: made(tolerance, width)(padded)[: len(y)]

        return prepared

    return of


def methods(problem):
    """Name, preparation, packages."""
    jax_packages = ("jax", "jaxlib", "diffrax")
    found = [
        ("rollout, Dopri8", by_rollout, jax_packages),
        ("rollout, Taylor", by_series, jax_packages),
        ("JAX by hand, diffrax Dopri8", by_vmap, jax_packages),
        ("JAX by hand in blocks of eight, diffrax Dopri8", in_blocks, jax_packages),
        ("C by hand, Dopri8", by_c, ("sympy",)),
    ]
    if heyoka_lowered.heyoka is not None:
        if problem.name == "tilting-disc":
            found.append(
                ("heyoka, equations by hand", by_heyoka(lambda problem: heyoka_disc.system()), ("heyoka",))
            )
        found.append(("heyoka, the engine's equations", by_heyoka(peer_heyoka.system), ("heyoka",)))
    return found


def measured(problem, quick, say):
    """Records of a problem."""
    sizes = SIZES[:2] if quick else SIZES
    expected = by_vmap(problem)(starts(problem, JUDGED))(1e-14)
    for method, make, packages in methods(problem):
        kind = records.OURS if method.startswith("rollout") else records.PEER
        try:
            prepare, each = make(problem), 0.0
        except (NotApplicable, ImportError) as reason:
            say(f"  {method}: not measured: {reason}")
            continue
        for size in sizes:
            if each * size > LONGEST:
                say(f"  {method}: a batch of {size} is left out, it would take {each * size:.0f} s")
                continue
            run = prepare(starts(problem, size))
            for tolerance in TOLERANCES[1:3] if quick else TOLERANCES:
                found = run(tolerance)
                error = float(np.max(np.abs(found[:JUDGED] - expected[: len(found)])))
                each = fastest(lambda run=run, tolerance=tolerance: run(tolerance)) / size
                yield records.record(
                    problem=problem.name, method=method, kind=kind, setting=tolerance,
                    setting_unit="tolerance", batch=size, error=error, seconds=each,
                    note=f"starts scattered by 5 %; largest error over {min(size, JUDGED)} lanes",
                    versions=records.versions(*packages),
                )  # fmt: skip
