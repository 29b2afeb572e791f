"""Cases of what happens between saved times, at events, knots and far times: E25 to E36. Scenes and
references are those of the search, `bench/hunting`.
"""

from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

import numpy as np
from hunting.families import family
from hunting.family import Ask, together
from hunting.oscillators import blow

import jourdain_jax as jj
from atlas_cases import elsewhere
from atlas_cases.case import Case, required, unanswered
from atlas_cases.motions import Motion, against, max_error
from atlas_cases.outcomes import Outcome, judged
from atlas_cases.scenes_motion import SteepEdge
from jourdain_jax.integrate import result_codes

ROWS_SKIP = {"naive": "its steps are those of E1 to E24"}
NO_ROWS_SKIP = ROWS_SKIP | {"reductions": "no rows", "constraints": "no rows"}


@dataclass
class Stopped(Motion):
    """A motion that ends at an event: which one, when, and where."""

    event: str = ""
    t_end: float = 0.0
    end: dict | None = None  # values by name

    def of_trajectory(self, motion: jj.Trajectory, tolerance) -> Outcome:
        """Right where the event, its time and the values there are."""
        code = int(motion.result)
        if code != result_codes.EVENT:
            return judged(np.inf, tolerance, motion.message if code else "")
        if motion.event_names[int(motion.event)] != self.event:
            return judged(np.inf, tolerance)
        at_end = against(self.scene, self.end, dict.fromkeys(self.end, 1.0))
        late = abs(float(motion.t_end) - self.t_end) / self.t_end
        off = at_end(np.asarray(motion.q_end)[None], np.asarray(motion.u_end)[None])
        return judged(max_error([late, off]), tolerance)


def of_family(name, numbers, saved, skip, **more) -> Motion:
    """A case of the search as a motion: with `saved` times after the start."""
    found, t0 = family(name), numbers.get("t0", 0.0)
    ts = found.saved(Ask("simulate", saved), numbers)
    truth = found.right(together([numbers]), ts[None])
    scene, names = found.scene().replace(**found.parameters(numbers)), found.names.split()
    options = found.given_inputs(numbers) | ({"t0": t0} if t0 else {})
    how = {"rtol": 1e-9, "atol": 1e-9, "skip": skip, "options": options} | more
    if truth.event is not None:
        how |= {"event": truth.event[0], "t_end": float(truth.t_end[0])}
        end = dict(zip(names, truth.last[0], strict=True))
        return Stopped(scene, found.begin(numbers), ts, lambda q, u: np.nan, end=end, **how)
    expected = dict(zip(names, truth.values[0].T, strict=True))
    scales = {name: max(1.0, float(np.max(np.abs(x)))) for name, x in expected.items()}
    return Motion(scene, found.begin(numbers), ts, against(scene, expected, scales), **how)


def rod_pendulum(saved) -> Motion:
    """A pendulum in x and z goes round, past positions where neither x nor z determines the other."""
    numbers = {"length": 1.0, "mass": 1.0, "v": 7.5, "whole": 1.0, "span": 2.0}
    name, how = ("rod-pendulum", {"asked": ("rollout",)}) if saved == 1 else ("rod-pendulum-in-step", {})
    by_mujoco = lambda: elsewhere.pendulum(1.0, 1.0, 7.5)
    return of_family(name, numbers, saved, ROWS_SKIP, by_mujoco=by_mujoco, **how)


def parallelogram() -> Motion:
    """A parallelogram linkage is laid flat, where two branches cross."""
    lengths = {"r1": 1.0, "r2": 2.0, "r3": 1.0, "d": 2.0}
    numbers = lengths | {"m1": 1.0, "m2": 1.5, "m3": 0.7, "g": 9.81, "s": 0.7, "s_rate": 8.0, "span": 1.5}
    bars = (1.0, 2.0, 1.0, 2.0), (1.0, 1.5, 0.7), 9.81, ((0.7, 0.0, 0.7), (8.0, 0.0, 8.0)), elsewhere.angles
    how = {"asked": ("rollout",), "by_mujoco": lambda: elsewhere.four_bar(*bars)}
    return of_family("parallelogram", numbers, 5, ROWS_SKIP, **how)


def slider_crank() -> Motion:
    """A slider-crank whose rod is as long as its crank, through right angles."""
    found = family("slider-crank-equal")
    return of_family("slider-crank-equal", found.draw(np.random.default_rng(3)), 5, ROWS_SKIP)


def steep_edge() -> Motion:
    """A particle over an edge of a potential, 1e-6 m wide: v^2 falls by twice its height."""
    scene, ts, v = SteepEdge(), np.array([0.2, 1.5]), 3.0
    after = np.sqrt(v**2 - 2 * 2.0)
    known = {"x": np.array([0.2 * v, 1.0 + after * (1.5 - 1.0 / v)]), "x_rate": np.array([v, after])}
    how = {"rtol": 1e-9, "atol": 1e-9, "skip": NO_ROWS_SKIP, "asked": ("rollout",)}
    return Motion(scene, {"x_rate": v}, ts, against(scene, known), **how)


def hammer_blow() -> Motion:
    """2,000 N for a millisecond, two seconds after the start."""
    flanks, force = blow(SimpleNamespace(**BLOW))
    by_mujoco = lambda: elsewhere.oscillator(BLOW["k"], 0.0, 0.0, 1e-4, lambda t: np.interp(t, flanks, force))
    return of_family("hammer", BLOW, 3, NO_ROWS_SKIP, asked=("rollout",), by_mujoco=by_mujoco)


def far_oscillator() -> Motion:
    """Eight turns, 54 years after the clock's zero."""
    by_mujoco = lambda: elsewhere.oscillator(FAR["k"], FAR["x"], FAR["x_rate"], 1e-5)
    return of_family("far-times", FAR, 3, NO_ROWS_SKIP, by_mujoco=by_mujoco)


OF_TOLERANCE = "a run at rtol = atol = 1e-9 (float32: 1e-5, 1e-6)"
STIFF = {"k": 1e6, "x": 0.0, "y": 7.3, "span": 5.0}
FLIGHT = {"z": 1.0, "x_rate": 4.5, "z_rate": 0.0, "width": 2.0, "height": 3.0, "span": 3.0}
STOP = {"k": 9.0, "stop": 1.0, "x": 0.2, "x_rate": 5.0, "span": 4.0}
BLOW = {"k": 4.0, "x": 0.0, "x_rate": 0.0, "when": 2.0137, "length": 1e-3, "force": 2000.0, "span": 10.0}
SAMPLED = {"size": 0.3, "rate": 2.0, "length": 1.0, "angle": 0.2, "angle_rate": 0.0, "span": 3.0}
FAR = {"k": 1e6, "x": 0.7, "x_rate": 300.0, "t0": 1.7e9, "span": 0.05}
GROWING, LATE = {"x": 5.3, "x_rate": 0.1, "span": 1.0}, {"late": 6.0, "speed": 0.3, "span": 10.0}
CASES = (
    required(
        "E25", "a stiff motion ends at a stop event",
        partial(of_family, "stiff-drop", STIFF, 3, NO_ROWS_SKIP, asked=("rollout", "Radau IIA")), 1e-5, 2e-2,
        "rtol 1e-9 over 5,000 steps of order 5; the reference leaves out k^-3",
    ),
    required(
        "E26", "a singular partition between two saved times: a pendulum in x, z", partial(rod_pendulum, 1),
        1e-6, 2e-2, OF_TOLERANCE,
    ),
    required(
        "E26 in step", "the same, saved once per turn", partial(rod_pendulum, 3), 1e-6, 2e-2, OF_TOLERANCE,
    ),
    Case(
        "E27", "a parallelogram linkage laid flat between saved times", parallelogram, 1e-5, 5e-2,
        OF_TOLERANCE + "; digits are lost near the crossing",
    ),
    Case(
        "E28", "a slider-crank with r = l through right angles", slider_crank, 1e-5, 5e-2,
        OF_TOLERANCE + "; digits are lost near the crossing",
    ),
    required(
        "E29", "two stop events in one step: the earlier one counts",
        partial(of_family, "room", FLIGHT, 1, NO_ROWS_SKIP, asked=("rollout",)), 1e-8, 1e-4,
        OF_TOLERANCE,
    ),
    required(
        "E30", "an event value that is no number beyond its boundary",
        partial(of_family, "stop-arcsine", STOP, 1, NO_ROWS_SKIP), 1e-6, 1e-2,
        OF_TOLERANCE + "; the value falls as a root",
    ),
    required("E31", "a hammer blow of 1 ms in ten seconds", hammer_blow, 1e-6, 1e-2, OF_TOLERANCE),
    required(
        "E32", "an oscillator at a time of 1.7e9 s", far_oscillator, 2e-5, 1e-2,
        OF_TOLERANCE + "; saved times are rounded to 2e-7 s, a phase of 2e-4 rad per second of it",
    ),
    required(
        "E33", "a force with a coefficient of 1e-24 that grows",
        partial(of_family, "tiny-force", GROWING, 1, NO_ROWS_SKIP), 1e-6, 1e-2, OF_TOLERANCE,
    ),
    Case(
        "E34", "a row that sets in after six seconds", partial(of_family, "late-row", LATE, 5, ROWS_SKIP),
        1e-5, 1e-2, OF_TOLERANCE,
    ),
    unanswered(
        "E35", "a pose by linear interpolation: no inertia",
        partial(of_family, "wagon-sampled", SAMPLED, 3, NO_ROWS_SKIP),
        "its accelerations are zero almost everywhere",
    ),
    Case(
        "E36", "an edge of a potential, 1e-6 m wide, that steps pass over", steep_edge, 1e-5, 1e-2,
        OF_TOLERANCE,
    ),
)  # fmt: skip
