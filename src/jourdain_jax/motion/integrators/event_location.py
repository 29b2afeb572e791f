"""Where in time a stop event lies, to the accuracy of the steps and with the right derivative.

For motions by diffrax, which stops at the end of the step in which an event happened (our own loop: `event_search`). The solver remembers where that
step began, (t_0, y_0); the event is found by shorter steps Y(h) of the same solver from there, so that a motion that the solver follows, stiff or not,
is followed to the event:

    h* with c(t_0 + h*, Y(h*)) = 0 (held constant in differentiation),   then   h <- h - c / (dc/dh) thrice,   t_e = t_0 + h,   y_e = Y(h)

The last corrections are zero in value, and carry the derivatives of the event time and of the state at the event (the saltation term). Newton's
method doubles the order at which it is right: one correction at h* gives first derivatives, two give the second and third ones too.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.motion.integrators import event_search
from jourdain_jax.motion.integrators.event_search import Bracket, bracket, chosen, next_trial
from jourdain_jax.motion.integrators.wrapping_solver import WrappingSolver

_CORRECTIONS = 3  # the first makes h* exact
_TRIALS = 72
_INSIDE = (0.25, 0.5, 0.75)  # of a step: where events are looked for besides its end


class Located(eqx.Module):
    """Time and state of an event, its index, and whether the steps to it were solved."""

    t: Float[Array, ""]
    y: PyTree
    event: Int[Array, ""]
    solved: Bool[Array, ""]


class Remembering(WrappingSolver):
    """`solver`, which remembers where its last step began, and refuses a step inside of which an event happened that is over at its end, by the dense output.

    `values(t, y, args)`: of the events. The error estimate of a step that is refused is infinite; a solver without one takes all its steps.
    """

    solver: diffrax.AbstractSolver
    values: Callable

    def init(self, terms, t0, t1, y0, args):
        """The start, and what the wrapped solver carries."""
        return t0, y0, self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step of the wrapped solver."""
        y1, error, dense, inner, result = self.solver.step(terms, t0, t1, y0, args, solver_state[2], made_jump)
        if error is not None:
            direction = jnp.sign(terms.contr(t0, t1))  # diffrax counts time along the direction of the motion

            def free(t, y):
                return self.values(t * direction, y, args) > 0

            between = self.interpolation_cls(t0=t0, t1=t1, **dense)
            times = t0 + jnp.asarray(_INSIDE, jnp.result_type(t0)) * (t1 - t0)
            hidden = jnp.any(free(t1, y1) & ~jnp.all(jax.vmap(lambda t: free(t, between.evaluate(t)))(times), axis=0))
            error = jax.tree.map(lambda e: jnp.where(hidden, jnp.inf, e), error)
        return y1, error, dense, (t0, y0, inner), result


class Along(diffrax.AbstractTerm):
    """`term` in time that counts along the `direction` of the motion, as diffrax hands it to its solvers."""

    term: diffrax.AbstractTerm
    direction: Float[Array, ""]

    def vf(self, t, y, args):
        """The rates."""
        return self.term.vf(t * self.direction, y, args)

    def contr(self, t0, t1, **kwargs):
        """The signed step."""
        return self.direction * (t1 - t0)

    def prod(self, vf, control):
        """Rates times step."""
        return self.term.prod(vf, control)


def locate(
    solver: diffrax.AbstractSolver, term: diffrax.AbstractTerm, values: Callable, begun: tuple, t_f, y_f: PyTree, args: PyTree, happened: Bool[Array, ""]
) -> Located:
    """Time and state of the first event in the last step of a motion, which `solver` took from `begun`, a time and a state, to (t_f, y_f).

    (t_f, y_f) itself where nothing happened. `term`: what is integrated; `values(t, y, args)`: of the events, (events,).
    """
    (t_0, y_0), direction = begun, jnp.sign(t_f - begun[0])
    solver = _for_trials(solver)
    moving = happened & (t_f != t_0)
    longest = jnp.where(moving, jnp.abs(t_f - t_0), jnp.ones_like(t_0))

    def stepped(h, t_0, y_0, args, direction):
        """The state after a step by |h|, NaN where the solver failed, and whether it did not."""
        along, first = Along(term, direction), t_0 * direction
        y, error, _, _, result = solver.step(along, first, first + h, y_0, args, solver.init(along, first, first + h, y_0, args), True)
        solved = diffrax.is_successful(result)
        for part in jax.tree.leaves(error):
            solved &= jnp.all(jnp.isfinite(part))
        return jax.tree.map(lambda x: jnp.where(solved, x, jnp.nan), y), solved

    def numbers(tree):
        return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)

    fixed = numbers((t_0, y_0, args, jnp.where(moving, direction, 1.0)))

    def tried(h) -> tuple[Float[Array, "events"], Bool[Array, ""]]:
        t_0, y_0, args, direction = fixed
        y, solved = stepped(h, t_0, y_0, args, direction)
        return values(t_0 + direction * h, y, args), solved

    last = numbers(longest)
    known = bracket(jnp.zeros_like(last), values(fixed[0], fixed[1], fixed[2]), last, values(*numbers((t_f, y_f, args))))
    slopes = event_search.mean_slope(known)

    def not_found(carry):
        known, k, _ = carry
        return moving & ~next_trial(known, last, k >= _TRIALS).near

    def search(carry) -> tuple[Bracket, Int[Array, ""], Bool[Array, ""]]:
        known, k, right = carry
        h = next_trial(known, last, k >= _TRIALS).t
        c, solved = tried(h)
        known = known.narrowed(h, c)
        return known, k + 1, jnp.where(known.before, right, solved)

    # a step that is not solved says nothing of events: an event found where such steps begin is none
    known, _, right = jax.lax.while_loop(not_found, search, (known, jnp.zeros((), jnp.int32), jnp.array(True)))
    event = known.first
    slope = chosen(event, slopes)

    def corrected(h, k):
        def at(h):
            t, (y, _) = t_0 + direction * h, stepped(h, t_0, y_0, args, direction)
            return chosen(event, values(t, y, args)), y

        (c, y), (c_dot, f) = jax.jvp(at, (h,), (jnp.ones_like(h),))
        shift = event_search.newton_shift(known, last, c, c_dot, moving)
        shift = event_search.without_slope(shift, c, moving & (k == _CORRECTIONS - 1) & event_search.is_flat(c_dot, slope))
        return h + shift, jax.tree.map(lambda y, f: y + shift * f, y, f)

    h, ys = jax.lax.scan(corrected, jnp.where(moving, known.t[0], longest), jnp.arange(_CORRECTIONS))
    t = jnp.where(moving, t_0 + direction * h, t_f)
    y = jax.tree.map(lambda y, end: jnp.where(moving, y[-1], end), ys, y_f)
    return Located(t, y, jnp.where(happened, event, -1).astype(jnp.int32), right)


def _for_trials(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """The solver with a loop over its stages that can be differentiated in both modes, and Newton's method in place of a chord, which fails more often."""
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        return eqx.tree_at(lambda s: s.solver, solver, _for_trials(solver.solver))
    if isinstance(solver, diffrax.AbstractImplicitSolver) and isinstance(solver.root_finder, diffrax.VeryChord):
        chord = solver.root_finder
        solver = eqx.tree_at(lambda s: s.root_finder, solver, optx.Newton(rtol=chord.rtol, atol=chord.atol, norm=chord.norm))
    if isinstance(solver, diffrax.AbstractRungeKutta):
        return eqx.tree_at(lambda s: s.scan_kind, solver, "bounded", is_leaf=lambda x: x is None)
    return solver


_OF_THE_CONTROLLER = diffrax.Kvaerno3().root_finder.rtol  # stands for what an implicit solver takes from the step-size control


def with_tolerances(solver: diffrax.AbstractSolver, controller: diffrax.AbstractStepSizeController) -> diffrax.AbstractSolver:
    """The solver with the tolerances of its inner solve, which diffrax would take from the control of step sizes."""
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        return eqx.tree_at(lambda s: s.solver, solver, with_tolerances(solver.solver, controller))
    if not isinstance(solver, diffrax.AbstractImplicitSolver) or not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        return solver
    missing = [name for name in ("rtol", "atol", "norm") if getattr(solver.root_finder, name) is _OF_THE_CONTROLLER]
    if not missing:
        return solver
    return eqx.tree_at(lambda s: [getattr(s.root_finder, name) for name in missing], solver, [getattr(controller, name) for name in missing])
