"""Derivatives through simulations, against complex steps through references: exact to round-off.

A derivative that is NaN while the motion claims success is wrong; `SensitivityWarning` and errors of the
engine's own are flags.
"""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

import jourdain_jax as jj
from hunting.bodies import FAMILIES as BODIES
from hunting.events import ROOM
from hunting.family import Family, G, drawn, together
from hunting.judging import places_of
from hunting.linkages import FAMILIES as LINKAGES
from hunting.pendulums import ROD
from hunting.record import BY_CODE, BY_WARNING, RIGHT, Record, outcome_of, refusal
from hunting.reference import integrate

MODES = ("reverse", "forward", "reverse of a batch")
STEP = 1e-20
RTOL = 1e-9


@dataclass(frozen=True)
class Slopes:
    """A family of derivatives of the weighted end of a motion by every number but those that are `fixed`."""

    name: str
    what: str
    family: Family
    # numbers (complex, (cases, 1)), ts -> values of the names at the end; default: the family's truth
    end: Callable | None = None
    slack: float = 1e4  # error of a derivative over rtol
    cases: int = 30
    single: bool = False

    def run(self, seeds) -> list[Record]:
        """Records of the cases with these seeds."""
        groups = [(mode, [seed for seed in seeds if seed % len(MODES) == k]) for k, mode in enumerate(MODES)]
        found = [record for mode, own in groups if own for record in self._asked(mode, own)]
        return sorted(found, key=lambda record: record.seed)

    def ends(self, numbers):
        """Weighted ends of cases."""
        f = replace(self.family, truth=self.end or self.family.truth)
        return f.right(numbers, np.real(numbers["span"])[:, None]).values[:, -1] @ weights(f)

    def _asked(self, mode, seeds) -> list[Record]:
        begin, f = time.process_time(), self.family
        numbers = [f.draw(np.random.default_rng([seed, 79])) for seed in seeds]
        rows = together(numbers)
        names = [name for name in rows if name not in f.fixed]
        changed = [self.ends(rows | {name: rows[name] + 1j * STEP}) for name in names]
        expected, exact = np.imag(np.stack(changed, axis=1)) / STEP, np.real(self.ends(rows))

        def value(x, span):
            own = numbers[0] | dict(zip(names, x, strict=True)) | {"span": span}
            scene = f.scene().replace(**f.parameters(own))
            motion = jj.simulate(scene, f.begin(own), t1=span, ts=span[None], rtol=RTOL, atol=RTOL)
            end = jnp.stack([getattr(motion, f"{kind}_end")[i] for kind, i in places_of(f)]) @ weights(f)
            return end, (end, motion.result)

        def of_batch(x, span):
            values, more = jax.vmap(value)(x, span)
            return jnp.sum(values), more

        slope = jax.jit((jax.jacfwd if mode == "forward" else jax.grad)(value, has_aux=True))
        x, spans = jnp.array([[one[name] for name in names] for one in numbers]), jnp.asarray(rows["span"])
        failed = None
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            try:
                if mode == MODES[2]:
                    slopes, (ends, codes) = jax.jit(jax.grad(of_batch, has_aux=True))(x, spans)
                else:
                    each = map(slope, x, spans)
                    slopes, (ends, codes) = jax.tree.map(lambda *one: jnp.stack(one), *each)
            except Exception as error:
                failed = refusal(error)
        told = "; ".join(str(w.message) for w in said if issubclass(w.category, jj.SensitivityWarning))
        seconds, records = (time.process_time() - begin) / len(seeds), []
        for i, seed in enumerate(seeds):
            values = ", ".join(f"{name}={float(value)!r}" for name, value in numbers[i].items())
            asked = f"gradient, {mode}, rtol={RTOL:g}; {values}"
            outcome, error, words = (failed[0], None, failed[1]) if failed else (None, None, "")
            if not failed:
                got, right = np.asarray(slopes[i]), expected[i]
                # a derivative need not be better than its motion
                tolerance = max(RTOL, abs(float(ends[i]) - exact[i]) / (1.0 + abs(exact[i])))
                allowed = self.slack * tolerance * (np.max(np.abs(right)) + 1.0)
                error, code = float(np.max(np.abs(got - right)) / allowed), int(codes[i])
                outcome = outcome_of(code, error, told)
                words = {BY_CODE: f"code {code}", RIGHT: "", BY_WARNING: told[:160]}
                words = words.get(outcome, f"slopes {got} for {right}")
            records.append(Record(self.name, seed, "float64", asked, outcome, error, words, seconds))
        return records


def weights(f: Family):
    """Of the names in the value that is differentiated."""
    return np.cos(np.arange(len(f.names.split())))


def _flight_end(n, ts):
    """Where and when a ball in a room meets the floor or the wall, whichever comes first."""
    fall = (n.z_rate + np.sqrt(n.z_rate**2 + 2 * G * n.z)) / G
    reach = n.width / n.x_rate
    t = np.where(np.real(fall) < np.real(reach), fall, reach)
    return n.x_rate * t, n.z + n.z_rate * t - G / 2 * t**2, n.x_rate, n.z_rate - G * t


def _bar_end(n, ts):
    """One angle: (m1/3 + m2 + m3/3) r^2 a'' = -g r (m1/2 + m2 + m3/2) cos(a)."""
    a, w = integrate(lambda _, a, w: (w, -1.2 * G * np.cos(a)), (n.s, n.s_rate), ts)
    return a, 0 * a, a, w, 0 * a, w


SLEIGH, FLAT = (f for f in (*BODIES, *LINKAGES) if f.name in ("sleigh", "parallelogram"))
FLIGHT = drawn(z=(0.5, 2.5), x_rate=(0.5, 8.0), z_rate=(-4.0, 4.0), width=(0.5, 3.0), span=3.0, height=100.0)
LENGTHS = {"r1": 1.0, "r2": 2.0, "r3": 1.0, "d": 2.0, "m1": 1.0, "m2": 1.0, "m3": 1.0, "g": G}
SWINGING = drawn(length=1.0, mass=1.0, v=(2, 9), span=(0.3, 2))
ROD_PENDULUM = Family(name="rod", what="", draw=SWINGING, fixed=("span", "mass"), **ROD)
FLYING = Family(name="room", what="", draw=FLIGHT, fixed=("span", "height"), **ROOM)
BAR = replace(
    FLAT, draw=drawn(**LENGTHS, s=(0.5, 2.0), s_rate=(3.0, 6.0), span=(0.3, 1.0)), fixed=("span", *LENGTHS)
)
FAMILIES = (
    Slopes("gradient-rod", "gradients of the pendulum with a rod and a narrow domain", ROD_PENDULUM),
    Slopes("gradient-sleigh", "gradients of Chaplygin's sleigh", SLEIGH),
    Slopes("gradient-room", "gradients of where a ball in a room is stopped", FLYING, _flight_end),
    Slopes(
        "gradient-parallelogram", "gradients of a parallelogram laid flat", BAR, _bar_end, cases=15, slack=1e5
    ),
)
