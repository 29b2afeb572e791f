"""True values at the end of every problem, each with a second computation that shares neither equations nor
integrator with the first.

First: closed forms and extended-precision integrations of `tests/oracles`; for the bicycle, which has none,
heyoka in extended precision on the engine's equations. Second: heyoka in extended precision on the engine's
equations, or for the bicycle dense autodiff by diffrax; where heyoka is not installed, the engine at a
tolerance of 1e-14. The uncertainty is their largest difference over the quantities compared.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense
from oracles import chaplygin_sleigh, rattleback, rolling_disc

import jourdain_jax as jj
from work_precision_cases import peer_heyoka
from work_precision_cases.problem import Reference, largest_error

TIGHT = 1e-14


def by_engine(problem):
    """The engine's own end, at a tolerance of 1e-14; not inside `jit`, where a motion that fails is not run
    again in another way.
    """
    options = {"ts": jnp.array([problem.end]), "rtol": TIGHT, "atol": TIGHT, "events": False}
    motion = jj.simulate(problem.scene, problem.state, solver=diffrax.Dopri8(), **options).raise_if_failed()
    return problem.named(motion.q_end, motion.u_end)


def second(problem):
    """Another computation of the end."""
    if peer_heyoka.heyoka is not None:
        return peer_heyoka.extended(problem), "heyoka, extended precision, the engine's equations"
    return by_engine(problem), "the engine, Dopri8 at 1e-14"


def checked(problem, values, how) -> Reference:
    """Values with the largest difference from a second computation."""
    other, by = second(problem)
    names = tuple(name for name in problem.compared.split() if name in other)
    return Reference(values, how, largest_error(other, values, names), by)


def disc(problem) -> Reference:
    """Euler's equations in Appell's variables, by the oracle."""
    found = rolling_disc.motion_yaw_lean_spin([0.0, problem.end], **rolling_disc.RUN)
    values = {name: found[name][-1] for name in ("x", "y", "yaw", "lean", "spin")}
    values |= {"lean_rate": found["w1"][-1], "yaw_rate": found["w2"][-1] / np.cos(values["lean"])}
    values["spin_rate"] = -found["w3"][-1] - values["yaw_rate"] * np.sin(values["lean"])
    return checked(problem, values, "Appell's equations, extrapolation of order 18 in extended precision")


def sleigh(problem) -> Reference:
    """Closed form; the path by quadrature."""
    run = chaplygin_sleigh.RUN
    found = chaplygin_sleigh.motion([0.0, problem.end], **_without(run, "t_end"))
    x, y, th, v, w = (found[name][-1] for name in ("x", "y", "th", "v", "w"))
    c, s, across = np.cos(th), np.sin(th), run["a"] * w
    values = {"x": x, "y": y, "heading": th, "heading_rate": w}
    values |= {"x_rate": v * c - across * s, "y_rate": v * s + across * c}
    return checked(problem, values, "closed form; path by Gauss-Legendre quadrature")


def celt(problem) -> Reference:
    """Kane and Levinson's equations, by the oracle."""
    found = rattleback.motion([0.0, problem.end], **_without(rattleback.RUN, "t_end"))
    values = {name: found[name][-1] for name in rattleback.NAMES}
    how = "Kane and Levinson's equations, extrapolation of order 18 in extended precision"
    return checked(problem, values, how)


def bicycle(problem) -> Reference:
    """No closed form: heyoka on the engine's equations against dense autodiff of poses written by hand, or
    the engine against the latter.
    """
    values, how = second(problem)
    rates, parameters = dense.bicycle_rates, dense.BICYCLE_PARAMETERS
    integrated = jax.jit(lambda y: dense.integrate(rates, parameters, y, problem.end, tolerance=1e-13))
    found = np.asarray(integrated(np.concatenate([problem.state.q, problem.state.u])[None])[0])
    off = largest_error(problem.named(found), values, problem.compared.split())
    return Reference(values, how, off, "dense autodiff of poses by hand, diffrax Dopri8 at 1e-13")


def _without(values, *names):
    return {name: value for name, value in values.items() if name not in names}
