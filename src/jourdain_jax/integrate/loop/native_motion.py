"""Derivatives of a motion by machine code in reverse mode, and of its states with respect to their times."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.markers import entries_of, stopped
from jourdain_jax.calculus.reals import Indices, Scalar, real_type
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.loop.adjoint import flow_back, moved, rates_of_all
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.loop_function import Found, Start, known_of, others_of
from jourdain_jax.integrate.loop.rate_functions import check_derivatives
from jourdain_jax.integrate.vector_fields.field import Integrated


def cotangents(
    form: Form, method: Method, memory: int, asked: Indices, start: Start, found: Found, g: Found
) -> tuple[Array, tuple[Scalar, ...]]:
    """Return the cotangents of the initial state and of the known numbers with the indices `asked`, from a
    motion and its cotangents `g`.

    `memory`: limit in bytes for records of steps.
    """
    check_derivatives(form, 1)
    accepted, rejected, _, _, crossings, _, *passed = found.rest[2:9]
    tries = accepted + rejected
    if form.has_events:  # trial steps that locate an event are not counted; few events need as many as eight
        tries += 8 * (1 + crossings + sum(passed))
    ends = jnp.hstack([g.end[0], g.t[0], g.log[0]])
    back = flow_back(form, method, asked, memory)(start, g.y[0], ends, tries)
    return back[: form.y], entries_of(back[form.y :])


def mover(args: tuple, shared: tuple, form: Form) -> Callable[[Integrated, Array, Array], Integrated]:
    """Return a function of a state, its time t and a shift d, which shifts the state along its rates by d.
    The value of d is zero: it only carries derivatives. `shared`: as in `Begun`.
    """
    others, fixed, along_rates = others_of(args[2]), len(form.program.fixed), moved(rates_of_all(form))

    def moved_by(y, t, d):
        known, slopes = known_of(args), []
        for i in form.sampled:
            known[fixed + i], slope = jax.jvp(others[i], (t,), (jnp.ones_like(t),))
            slopes.append(slope)
        for i in form.switched:
            known[fixed + i] = others[i](t)
        z = jnp.concatenate([y.rows, jnp.stack([jnp.asarray(x, real_type()) for x in (t, *known, *slopes)])])
        plain = [own if x is None else x for own, x in zip(known, known_of(shared), strict=True)]
        return Integrated.of(along_rates(stopped((y.rows, t, plain, slopes)), z, d)[: form.y], form)

    return moved_by
