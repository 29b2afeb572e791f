"""Minimisation of a fit by multiple shooting: first with gaps between pieces, then without.

1. First guesses of nodes come from measurements (`first_nodes`).
2. Gaps c_i are residuals of decreasing width: minimise F + sum (c_i / width)^2 / 2 by Levenberg-Marquardt.
3. Gaps are closed, c_i = 0, by sequential quadratic programming with the Gauss-Newton Hessian: minimise
   |r + J d|^2 / 2 over the unknowns of the whole run, d = (dx_0, dtheta), where nodes change by
   ds_i = L_i d + g_i. Steps are full unless residuals change much.

With step 2, all 20 first guesses of a chaotic double pendulum lead to the minimum; without it, 17, 16 and 8
do (5, 10, 20 s of `bench/identification.py`). A fit has converged if a step changes the vector of residuals
by at most `tolerance` and no unknown by more than that fraction, and pieces join to the tolerance of the
simulation.

Source: H. G. Bock, in: Modelling of Chemical Reaction Systems (1981) 102; H. G. Bock, E. Kostina and J. P.
Schlöder, GAMM-Mitteilungen 30 (2007) 376.

First guesses of nodes: a measured coordinate or speed, and the rate of a measured coordinate, come from a
parabola through the nearest samples. Speeds change as little as possible to satisfy qdot = N(q) u + nu. Other
quantities keep their value at the start, except that coordinates on which no geometric constraint depends
accumulate their changes over the pieces. Readings are corrected for delay, and for lag by y + lag y'.
"""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.calculus.reals import largest
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.identification.data.experiment import Experiment, ideal
from jourdain_jax.identification.solve.levenberg_marquardt import (
    Control,
    Linearised,
    Minimum,
    column_scaling,
    damped_step,
    minimise,
)
from jourdain_jax.identification.solve.piecewise import Piecewise
from jourdain_jax.identification.solve.unknowns import Places, check_starts
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.scene import Scene


def first_nodes(
    scene: Scene,
    run: Experiment,
    ends: Int[np.ndarray, "ends"],
    q: Float[np.ndarray, "coordinates"],
    u: Float[np.ndarray, "speeds"],
) -> Float[np.ndarray, "pieces states"]:
    """Return first guesses of the states at the beginning of all pieces of a run. q, u: start of the run."""
    ts = np.asarray(run.ts, float)
    at = np.concatenate([[float(run.t0)], ts[ends[1:-1]]])
    qs, us, rates = np.tile(q, (len(at), 1)), np.tile(u, (len(at), 1)), np.full((len(at), len(q)), np.nan)
    speeds, filters = np.zeros(len(u), bool), []
    for name, values in run.values.items():
        reading = run.readings.get(name, ideal(name))
        gain, bias, delay, lag = (
            np.asarray(reading.numbers[number]) for number in ("gain", "bias", "delay", "lag")
        )
        y = ((np.asarray(values, float) - bias) / np.where(gain == 0, 1.0, gain)).reshape(len(ts), -1)
        found = np.array(
            [[_parabola(ts - delay, column, t) for column in y.T] for t in at]
        )  # (nodes, entries, 2)
        if reading.has_filter:
            filters.append(np.nan_to_num(found[..., 0]))
        if reading.operation is not None or np.any(gain == 0):
            continue
        found[..., 0] += lag * found[..., 1]
        for names, state, of_speeds in ((scene.coordinate_names, qs, False), (scene.speed_names, us, True)):
            if reading.name in names:
                where = np.atleast_1d(names.view(np.arange(len(names)))[reading.name])
                state[:, where] = np.where(np.isfinite(found[..., 0]), found[..., 0], state[:, where])
                if of_speeds:
                    speeds[where] = True
                else:
                    rates[:, where] = found[..., 1]
    if np.isfinite(rates).any():
        qdot, N = _rates(scene, at, qs, us)
        for k in range(len(at)):
            known = np.isfinite(rates[k])
            us[k, ~speeds] += np.linalg.lstsq(
                N[k][np.ix_(known, ~speeds)], (rates[k] - qdot[k])[known], rcond=1e-8
            )[0]
    return np.concatenate([qs, us, *filters], axis=1)


def goes_on(scene: Scene, q: Float[np.ndarray, "coordinates"]) -> np.ndarray:
    """Return the coordinates, such as headings and distances, on which no geometric constraint and no unit
    norm depends.
    """
    beside = q + 0.1 * np.sin(1.0 + np.arange(q.size))  # where no slope vanishes by symmetry
    return ~np.any(_closures(scene, beside) != 0, axis=0)


@eval_numpy
def _closures(scene: Scene, q):
    return jax.jacfwd(lambda q: closure_residual(scene, 0.0, q))(q)


@eval_numpy
def _rates(scene: Scene, t, q, u):
    """Return qdot and N at every node."""

    def one(t, q, u):
        return coordinate_rates(scene, t, q, u), jax.jacfwd(coordinate_rates, 3)(scene, t, q, u)

    return jax.vmap(one)(t, q, u)


def _parabola(ts: Float[np.ndarray, "times"], x: Float[np.ndarray, "times"], t: float) -> tuple[float, float]:
    """Return value and derivative at a time of the parabola through the nearest samples; NaN for fewer than
    three.
    """
    there = np.flatnonzero(np.isfinite(x))
    near = there[np.argsort(np.abs(ts[there] - t), kind="stable")[:5]]
    if len(near) < 3:
        return np.nan, np.nan
    _, slope, value = np.polyfit(ts[near] - t, x[near], 2)
    return float(value), float(slope)


def shot(problem: Piecewise, theta: Places) -> Minimum:
    """Return the minimum from each `theta`."""
    check_starts(problem.scene, problem.runs, problem.unknowns)
    begin, control = _begun(problem, theta), problem.asked.control
    roughly = replace(control, tolerance=1.0, most_steps=min(15, control.most_steps))
    every = np.arange(len(theta))

    def with_gaps(begin: np.ndarray, width: float) -> Minimum:
        what = f"pieces with gaps of {width:g}"  # in sizes of the states
        evaluate = lambda x, members: problem.with_gaps(x, members, width)
        return minimise(evaluate, begin, problem.pieces.unknowns, roughly, what)

    found = with_gaps(begin, 0.1)
    found = with_gaps(found.theta, 0.01).after(found, every)
    return _closed(problem, problem.put(found.theta)).after(found, every)


def _begun(problem: Piecewise, theta: np.ndarray) -> np.ndarray:
    """Return first guesses of the unknowns of all pieces, nodes included."""
    count, coordinates = len(theta), len(problem.scene.coordinate_names)
    places = np.arange(problem.states)
    of_q, of_y = places < coordinates, places >= coordinates + len(problem.scene.speed_names)
    nodes = np.zeros((count, len(problem.follows), problem.states))
    starts = np.zeros((len(problem.follows), problem.states))
    for run, data in enumerate(problem.runs):
        q, u = _start(problem, data, theta[0], run)
        starts[problem.run_of == run, : q.size + u.size] = np.concatenate([q, u])
        found = first_nodes(problem.scene, data, problem.ends_of[run], q, u)
        nodes[:, problem.run_of == run, : found.shape[1]] = found
    guess = problem.spread(theta)
    local = problem.pieces.unknowns.split(guess)[1]  # a view
    local[:, problem.follows, problem.own :] = nodes[:, problem.follows]
    _put_starts(problem, local, nodes)
    _, ends = problem.with_ends(guess, np.arange(count))
    changes = ends[..., -1] - nodes
    failed = ~np.isfinite(changes).all(axis=2)
    changes[failed] = 0.0
    for run in range(len(problem.runs)):
        here = np.flatnonzero(problem.run_of == run)
        still = (np.ptp(nodes[:, here, :coordinates], axis=(0, 1)) == 0) & goes_on(
            problem.scene, starts[here[0], :coordinates]
        )
        nodes[:, here[1:, None], np.flatnonzero(still)] += np.cumsum(
            changes[:, here[:-1, None], np.flatnonzero(still)], axis=1
        )
    # a piece whose motion fails begins in the start state of its run
    nodes = np.where(failed[..., None] & ~of_y, starts, nodes)
    local[:, problem.follows, problem.own :] = nodes[:, problem.follows]
    # sizes of states: their spread over the nodes, and their change over a piece
    sizes = np.maximum(np.std(nodes, axis=(0, 1)), np.sqrt(np.mean(changes**2, axis=(0, 1))))
    sizes = np.maximum(sizes, 0.01 * largest(nodes, (0, 1)))
    least = np.where(
        of_y,
        sizes,
        np.where(of_q, np.max(sizes[of_q], initial=0.0), np.max(sizes[~of_q & ~of_y], initial=0.0)),
    )
    problem.measure(np.where(least > 0, np.maximum(sizes, 1e-4 * least), 1.0))
    return guess


def _start(
    problem: Piecewise, data: Experiment, theta: np.ndarray, run: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates and speeds of the start of a run at the first guess."""
    shared, own = problem.unknowns.split(theta)
    layout = problem.unknowns.layout
    state = consistent_start(
        layout.scene(problem.scene, shared),
        t0=data.t0,
        inputs=data.inputs,
        **layout.start(data.start, shared, own[run]),
    )
    return np.asarray(state.q), np.asarray(state.u)


def _put_starts(problem: Piecewise, local: np.ndarray, nodes: np.ndarray) -> None:
    """Set unknown start values without a prior to measured values, if these lie within the bounds."""
    unknowns, scene = problem.unknowns, problem.scene
    low, high = unknowns.low, unknowns.high
    for run, first in enumerate(np.flatnonzero(~problem.follows).tolist()):
        q, u, _ = np.split(
            nodes[:, first], np.cumsum([len(scene.coordinate_names), len(scene.speed_names)]), axis=-1
        )
        for place in (place for place in unknowns.layout.local if place.kind == "start"):
            where = np.arange(place.begin, place.end)
            at = problem.shared + run * problem.own + where
            is_coordinate = place.name in scene.coordinate_names
            names, x = (scene.coordinate_names, q) if is_coordinate else (scene.speed_names, u)
            value = names.view(x)[place.name].reshape(len(x), -1)
            free = (
                ~unknowns.fixed[at]
                & (unknowns.prior_weight[at] == 0)
                & (low[at] < value)
                & (value < high[at])
            )
            local[:, first, where] = np.where(free, value, local[:, first, where])


def _closed(problem: Piecewise, theta: np.ndarray) -> Minimum:
    """Return the minimum with all gaps closed, by sequential quadratic programming from these pieces."""
    unknowns, control = problem.unknowns, problem.asked.control

    def evaluate(theta: np.ndarray, members: np.ndarray, share: np.ndarray) -> Linearised:
        return problem.assembled(theta, members, problem.moved(theta, members, share), problem.taus(members))

    shares = np.ones(len(theta))
    way = Minimum.begun(theta, evaluate(theta, np.arange(len(theta)), shares), "pieces that join")
    far = 2.0 * np.sqrt(max(problem.samples, 1))  # a step may change residuals by two sigmas (rms)
    for _ in range(control.most_steps):
        here, arrow, x = way.here()
        if not here.size:
            break
        # a tiny damping: held unknowns would make the system singular
        size, undamped = unknowns.sizes(x), np.full(here.size, 1e-24)
        d = damped_step(
            arrow, x, column_scaling(arrow, size), undamped, unknowns, cutoff_of(problem, control, here)
        )
        length = problem.change(way.at.sigma[here], d, here)
        done = (
            problem.closed(here)
            & (length <= control.tolerance)
            & (np.abs(d) <= control.tolerance * size).all(axis=1)
        )
        here, d, x, length = way.arrived(here, done), d[~done], x[~done], length[~done]
        if not here.size:
            break
        share = np.minimum(shares[here], far / np.maximum(length, far))
        end = x + share[:, None] * d
        trial = evaluate(end, here, share)
        good = np.isfinite(trial.cost)
        way.go(here, end, trial, good)
        shares[here] = np.where(good, np.minimum(2 * shares[here], 1.0), 0.25 * share)
        way.give_up(shares < 1e-3)
    return way


def cutoff_of(problem: Piecewise, control: Control, members: np.ndarray) -> float:
    """Return the fraction of the largest singular value below which singular values count as zero. It is
    smaller if the motion amplifies small changes, since this increases only the largest singular value.
    """
    return max(control.cutoff / float(np.max(problem.growth(members))), 1e-14)  # round-off of singular values
