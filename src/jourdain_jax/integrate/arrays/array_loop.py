"""The loop over steps in JAX: the code of a step (`integrate/loop/step.py`), with JAX functions.

The batch axis is last. In each pass of the loop all samples try a step, each towards its own next time; a
sample that has ended does not change. Tangents are integrated together with the state, and JAX differentiates
only the rates:

    (y, dy)' = (f(y, p), df/dy dy + df/dp dp)

For higher derivatives, tangents of these values are added (`integrate/loop/form.py`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import PerLane
from jourdain_jax.integrate.arrays.array_functions import Functions
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter, Pointer, Rows
from jourdain_jax.integrate.arrays.implicit_stages import tried_by_equations
from jourdain_jax.integrate.event_search import LOCATING, RUNNING
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.integrate.loop.form import CONTROL, Form
from jourdain_jax.integrate.loop.handover import Found, Start, constant_rows
from jourdain_jax.integrate.loop.lanes import Lanes
from jourdain_jax.integrate.loop.step import IDLE, step, tried_by_stages


class Going(NamedTuple):
    """Motion during integration."""

    y: Float[Array, "y *lanes"]  # with its tangents
    rows: dict[int, PerLane]  # other rows that steps change
    log: list[Float[Array, "transitions *lanes"]]
    passed: Int[Array, "*lanes"]  # number of saved times


class Loop(NamedTuple):
    """Loop over the steps of a motion, without arrays, which are in the `Start`."""

    form: Form
    method: Method | ImplicitMethod
    rest: tuple  # arguments of the rates, without their arrays
    most: int  # maximum number of steps

    def begun(self, start: Start) -> tuple[Going, dict[int, Array]]:
        """Return the motion at its start, and the rows that steps do not change."""
        t, form = start.goals[0], self.form
        given = {first + i: x for first, run in constant_rows(form).items() for i, x in enumerate(run)}
        later = [row for row in range(form.integrated, form.rows["mode"].stop) if row not in given]
        given |= dict(zip(later, start._replace(known=((),)).numbers(), strict=True))
        given = {row: jnp.broadcast_to(jnp.asarray(x, t.dtype), t.shape) for row, x in given.items()}
        fixed = {row: given[row] for name in CONTROL for row in form.rows[name]}
        logged = {row for block in self.log for row in block}
        moving = {
            row: given.get(row, jnp.zeros_like(t))
            for row in range(form.integrated, form.all)
            if row not in fixed and row not in logged
        }
        log = [jnp.zeros((len(block), *t.shape), t.dtype) for block in self.log]
        return Going(jnp.concatenate(start.y), moving, log, jnp.zeros(t.shape, jnp.int32)), fixed

    @property
    def log(self) -> list[range]:
        """Return the rows that record transitions, one range per recorded quantity."""
        names = [name for name in ("log_event", "log_mode", "log_lost", "log_t") if name in self.form.rows]
        most = max(self.form.transitions, 1)
        return [
            range(k, k + most)
            for name in names
            for k in range(self.form.rows[name].start, self.form.rows[name].stop, most)
        ]

    def writer(self, start: Start, asked: Sequence[int] = ()) -> ArrayWriter:
        """Return a writer with the functions that a step calls."""
        w = ArrayWriter(start.goals[0])
        w.functions = Functions(w, self.form, self.rest, start.known, tuple(asked), self.method)
        return w

    def rows_in(self, w: ArrayWriter, going: Going, fixed: dict) -> Pointer:
        """Put the rows of all samples into memory."""
        state = w.holding(going.y)
        logged = {
            row: (array, i)
            for block, array in zip(self.log, going.log, strict=True)
            for i, row in enumerate(block)
        }
        rows = going.rows | fixed | logged
        state.room.rows.extend(rows[row] for row in range(self.form.integrated, self.form.all))
        return state

    def tried(self, going: Going, fixed: dict, start: Start) -> tuple[Going, Array]:
        """Try a step in all running samples. Also return the rates at its stages."""
        w = self.writer(start)
        state, k = self.rows_in(w, going, fixed), w.room(self.form.integrated * self.method.needed)
        tried = tried_by_stages if isinstance(self.method, Method) else tried_by_equations
        step(w, self.form, self.method, Lanes(w, self.form, state), k, tried)
        return going._replace(
            y=w.load(state, Rows(0, self.form.integrated)),
            rows={row: w.load(state, row) for row in going.rows},
            log=[w.load(state, Rows(block.start, len(block))) for block in self.log],
        ), w.whole(k.room)

    def _row(self, name: str) -> int:
        return self.form.rows[name].start

    def saving(self, start: Start, going: Going, ys: Array | None) -> tuple[Going, Array | None]:
        """Count the times reached, set the next one, and, unless `ys` is None, save the states there."""
        code_, t_, goal_ = map(self._row, ("code", "t", "goal"))
        times, y = len(start.goals), going.y

        def due(code, passed):
            return (code == RUNNING) & (
                going.rows[t_] == at_number(start.goals, jnp.minimum(passed, times - 1))
            )

        def save(carry):
            code, passed, ys = carry
            here = due(code, passed)
            if ys is not None:
                ys = (
                    jnp.where((numbers(times, y) == passed) & here, y, ys)
                    if y.ndim > 1
                    else jax.lax.dynamic_update_index_in_dim(ys, y, passed, 0)
                )
            passed = passed + here
            return jnp.where(here & (passed >= times), IDLE, code), passed, ys

        code, passed, ys = jax.lax.while_loop(
            lambda carry: eqxi.unvmap_any(jnp.any(due(*carry[:2]))),
            save,
            (going.rows[code_], going.passed, ys),
        )
        goal = at_number(start.goals, jnp.minimum(passed, times - 1))
        for knots in start.of_samples:
            direction = jnp.sign(start.goals[-1])
            ahead = jnp.where((knots - going.rows[t_]) * direction > 0, knots * direction, jnp.inf)
            goal = direction * jnp.minimum(goal * direction, jnp.min(ahead, axis=0))
        return going._replace(rows=going.rows | {code_: code, goal_: goal}, passed=passed), ys

    def on_its_way(self, going: Going) -> Array:
        """Return whether any sample is still running."""
        code = going.rows[self._row("code")]
        return eqxi.unvmap_any(jnp.any((code == RUNNING) | (code == LOCATING)))

    def run(self, start: Start) -> Found:
        """Integrate the motion to its end."""
        begun, fixed = self.begun(start)
        ys = jnp.zeros((len(start.goals), *begun.y.shape), begun.y.dtype)

        def tried(carry):
            going, ys = carry
            return self.saving(start, self.tried(going, fixed, start)[0], ys)

        going, ys = jax.lax.while_loop(
            lambda carry: self.on_its_way(carry[0]), tried, self.saving(start, begun, ys)
        )
        ys = jnp.where(numbers(len(ys), going.y) >= going.passed, going.y, ys)
        code, w = self._row("code"), self.writer(start)
        rows = going.rows | {code: jnp.where(going.rows[code] == IDLE, RUNNING * 1.0, going.rows[code])}
        state = self.rows_in(w, going._replace(rows=rows), fixed)
        end = w.load(state, Rows(0, self.form.returned))
        return Found.of(self.form, ys, end, going.passed.astype(end.dtype)[None])


def at_number(x: Float[Array, "times *lanes"], i) -> PerLane:
    """Return for each sample the time with its index `i`."""
    return x[i] if x.ndim == 1 else jnp.take_along_axis(x, i[None], 0)[0]


def numbers(times: int, y: Float[Array, "y *lanes"]) -> Int[Array, "times *ones"]:
    """Return the indices of the times, shaped to broadcast against states `y`."""
    return jnp.reshape(jnp.arange(times), (-1, *[1] * y.ndim))
