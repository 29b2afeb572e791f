"""Motions by machine code of our own, Dopri8 and Taylor series, against heyoka on the same equations at equal
final error: part `heyoka` of `native.py`.

The error of a method is the median over lanes of the largest error of a number of the final state, absolute
in SI units, against heyoka in extended precision. The tolerance that gives an error of 1e-8 or 1e-12 is read
off the curve of error over tolerance (straight between points, in logarithms), and the motions are timed at
it, the methods in turn. Alone means one motion after another inside one compiled program, which knows nothing
of the other motions.
"""

from functools import partial

import diffrax
import jax
import numpy as np
from baselines import heyoka_disc, heyoka_lowered
from figures import figure, least_processor_time
from minimal_states import final_states

import jourdain_jax as jj
from jourdain_jax.integrate.explicit_steps import order_for
from jourdain_jax.motion.simulate import set_up

ERRORS = (1e-8, 1e-12)
TOLERANCES = tuple(10.0**-k for k in range(7, 16))
JUDGED = 64  # lanes whose final states are compared with the reference
REPEATED = 64  # motions alone in one call
REQUIRED = {"tilting-disc": 1.2, "chaplygin-sleigh": 1.2, "rattleback": 0.5, "whipple-bicycle": 0.5}
REQUIRED_ALONE = 1.5


def tolerance_at(wanted, run, starts, expected):
    """The tolerance whose final states have an error, straight between points in logarithms."""
    before = None
    for tolerance in TOLERANCES:
        error = float(np.median(np.max(np.abs(np.asarray(run(tolerance, starts)) - expected), axis=1)))
        if error <= wanted and before is None:
            return tolerance
        if error <= wanted:
            share = np.log(before[1] / wanted) / np.log(before[1] / error)
            return float(before[0] * (tolerance / before[0]) ** share)
        before = tolerance, error
    raise ValueError(f"no tolerance down to {TOLERANCES[-1]:.0e} gives a final error of {wanted:.0e}")


def compared(name, starts: jj.State, end, options, quick):
    """Figures of one model."""
    scene = jj.models.MODELS[name]()
    system, plain = heyoka_lowered.equations(scene), heyoka_lowered.states(scene, starts.q, starts.u)
    expected = heyoka_lowered.extended(system, end, plain[:JUDGED])

    systems = {"": system}
    if name == "tilting-disc":
        systems["by hand, "] = heyoka_disc.system()  # as an expert writes them, with fewer operations
    for wanted in ERRORS:
        at = {}
        for how, equations in systems.items():
            run = lambda tolerance, y, equations=equations: heyoka_lowered.final_states(
                equations, end, tolerance, 4, compact=True
            )(y)
            at[how] = tolerance_at(wanted, run, plain[:JUDGED], expected)
        for alone, count, widths in ((False, len(plain), (4, 8)), (True, REPEATED, (1,))):
            who = f"{'alone' if alone else f'batch of {count}'}, error {wanted:.0e}"
            judged, first = (
                jax.tree.map(lambda x, count=count: x[:count], starts) for count in (JUDGED, count)
            )
            runs = {}
            for solver in _our_solvers(scene, wanted, options):
                run = final_states(scene, end, alone, backend="native", solver=solver, **options)
                runs[f"ours, {type(solver).__name__}"] = partial(
                    run, tolerance_at(wanted, run, judged, expected), first
                )
            own = list(runs)
            for how, compact, width in (
                (how, compact, width) for how in systems for compact in (False, True) for width in widths
            ):
                way = f"heyoka, {how}{width} side by side, {'compact' if compact else 'normal'} mode"
                runs[way] = partial(
                    heyoka_lowered.final_states(systems[how], end, at[how], width, compact), plain[:count]
                )
            seconds = least_processor_time(runs, 3 if quick else 7)
            for way, value in seconds.items():
                yield figure(f"{who}, {way}, us per trajectory", name, 1e6 * value / count)
            best, theirs = (
                min(value for way, value in seconds.items() if (way in own) is is_ours)
                for is_ours in (True, False)
            )
            yield figure(
                f"{who}, ours at its best / heyoka at its best",
                name,
                best / theirs,
                REQUIRED_ALONE if alone else REQUIRED[name],
            )
            if len(own) > 1:
                yield figure(f"{who}, Taylor / Dopri8", name, seconds[own[1]] / seconds[own[0]])


def _our_solvers(scene: jj.Scene, wanted, options):
    """Dopri8, and Taylor series of the order for the tolerance that gives an error, some tenth of it, where
    they serve.
    """
    series = jj.Taylor(order_for(0.1 * wanted))
    try:
        set_up(scene, **options, solver=series)
    except ValueError:
        return [diffrax.Dopri8()]
    return [diffrax.Dopri8(), series]
