"""heyoka on the scalar program of a scene, as the engine prints it (`jj.lower(scene).python_source()`):
Taylor series, alone and in SIMD batches.

Source: F. Biscani and D. Izzo, Mon. Not. R. Astron. Soc. 504 (2021) 2614.
"""

import inspect
import math

import numpy as np

import jourdain_jax as jj

try:
    import heyoka
except ImportError:
    heyoka = None

MISSING = "heyoka cannot be imported, so it is not measured; `pip install heyoka` (wheels for Linux only)"


def names(scene: jj.Scene):
    """Names of the program's state: coordinates, and the speeds that are integrated."""
    program = jj.lower(scene)
    return (*program.coordinates, *(program.speeds[i] for i in program.independent))


def states(scene: jj.Scene, q, u):
    """States of the program, (lanes, states), from all coordinates and speeds."""
    return np.concatenate([np.asarray(q), np.asarray(u)[:, list(jj.lower(scene).independent)]], axis=1)


def equations(scene: jj.Scene):
    """The scalar program as equations of heyoka; inputs are zero."""
    source = jj.lower(scene).python_source().replace("import math", "")
    in_numbers, in_symbols = {"math": math}, {"math": heyoka}
    exec(source, in_numbers)
    exec(source, in_symbols)
    parameters = [float(getattr(scene, name)) for name in inspect.signature(in_numbers["fixed"]).parameters]
    taken = list(inspect.signature(in_symbols["rates"]).parameters)[2:]  # after `fixed` and t
    y = heyoka.make_vars(*names(scene))
    inputs = [0.0] * (len(taken) - len(y))
    rates = in_symbols["rates"](in_numbers["fixed"](*parameters), heyoka.time, *y, *inputs)
    rates = (heyoka.expression(rate) if isinstance(rate, float) else rate for rate in rates)
    return list(zip(y, rates, strict=True))


def final_states(system, end, tolerance, width, compact=False):
    """A compiled function from initial states (lanes, states) to those at the time `end`.

    **Arguments:** `width`, trajectories per SIMD batch, which must divide the number of lanes (1: one by
    one); `compact`, heyoka's mode for long equations.
    **Raises:** `ValueError` where an integration does not reach its end.
    """
    # sums reordered: faster by a quarter on the disc, with the same error
    options = {"tol": tolerance, "fast_math": True, "compact_mode": compact}
    if width == 1:
        solver = heyoka.taylor_adaptive(system, np.zeros(len(system)), **options)
    else:
        solver = heyoka.taylor_adaptive_batch(system, np.zeros((len(system), width)), **options)

    def run(starts):
        groups = starts.reshape(-1, width, len(system)).transpose(0, 2, 1)  # (groups, states, width)
        found = np.empty_like(groups)
        for start, final in zip(groups, found, strict=True):
            solver.state[:] = start.reshape(solver.state.shape)
            if width == 1:
                solver.time = 0.0
            else:
                solver.set_time(0.0)
            solver.propagate_until(end)
            if np.any(solver.time != end):
                why = "a state is not finite or the tolerance is too small"
                raise ValueError(f"heyoka stopped at t = {solver.time}, expected {end}; {why}")
            final[:] = solver.state.reshape(final.shape)
        return found.transpose(0, 2, 1).reshape(starts.shape)

    return run


def extended(system, end, starts):
    """Final states in long double with a tolerance of 1e-18."""
    long = np.longdouble
    options = {"tol": long("1e-18"), "fp_type": long, "compact_mode": True}
    solver = heyoka.taylor_adaptive(system, starts[0].astype(long), **options)
    found = np.empty_like(starts)
    for start, final in zip(starts, found, strict=True):
        solver.time = long(0.0)
        solver.state[:] = start.astype(long)
        solver.propagate_until(long(end))
        final[:] = solver.state.astype(float)
    return found
