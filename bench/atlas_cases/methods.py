"""The methods of the atlas: the engine as it comes, its reductions and options, integrators, adjoints, and
naive methods.

To add an integrator, append a line to `INTEGRATORS`; it is then run in every case with a motion. Naive
methods live in `naive.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

import jourdain_jax as jj
from jourdain_jax.equations import GibbsAppell
from jourdain_jax.equations.reductions import Reduced, reduce

REDUCTIONS = ("privileged", "qr", "svd", "kkt", "udwadia-kalaba", "gibbs-appell")
INTEGRATORS: dict[str, Callable] = {
    "Tsit5": diffrax.Tsit5,
    "Dopri8": diffrax.Dopri8,
    "Kvaerno5": diffrax.Kvaerno5,
    "Radau IIA": jj.RadauIIA,
}
EVEN_STEPS = {
    "implicit midpoint": jj.ImplicitMidpoint,
    "DLA": jj.DiscreteLagrangeDAlembert,
    "discrete gradient": jj.DiscreteGradient,
}  # of a `step`
STABILISED = {
    "no projection": 0.0,
    "Baumgarte 5/s": 5.0,
    "Baumgarte 1e4/s": 1e4,
}  # rates; one program serves all


class OneOf(GibbsAppell):
    """The reduction with number `index` out of several: they share one compiled program.

    A kind of `GibbsAppell` because that reduction alone is handed everything: the scene, and equations and
    rows in raw units.
    """

    index: Int[Array, ""]
    members: tuple

    def accelerations(self, scene, t, q, u, equations, rows):
        """By the chosen member."""

        def by(member):
            if isinstance(member, GibbsAppell):
                return lambda e, r: _uniform(member.accelerations(scene, t, q, u, e, r))
            return lambda e, r: _uniform(reduce(member, e, r))

        return jax.lax.switch(self.index, [by(member) for member in self.members], equations, rows)


def _uniform(found: Reduced) -> Reduced:
    return Reduced(
        found.udot,
        found.constraint_force,
        jnp.asarray(found.pivot, found.udot.dtype),
        jnp.asarray(found.applicable),
    )


def reduction(scene, name: str | None):
    """The engine's reduction `name` for a scene."""
    if name is None:
        return None
    known = jj.reductions(scene)
    return OneOf(
        known["gibbs-appell"].independent,
        jnp.asarray(REDUCTIONS.index(name)),
        tuple(known[member] for member in REDUCTIONS),
    )


@dataclass(frozen=True)
class Method:
    """One row of columns of the atlas: how the engine is asked, or which naive method is run."""

    name: str
    group: str
    options: Callable = field(default=lambda scene: {})  # scene -> options of `simulate`
    reduction: str | None = None  # of `accelerations` and of `simulate`
    naive: str | None = None
    batch: bool = False  # by `rollout`
    elsewhere: bool = False  # by another engine

    @property
    def even_steps(self) -> bool:
        """Whether it takes steps of one length."""
        return self.name in EVEN_STEPS


def _by_reduction(name: str) -> Method:
    return Method(
        name,
        "reductions",
        lambda scene: {"formulation": jj.Formulation("full", reduction(scene, name))},
        reduction=name,
    )


def _stabilised(name: str, rate: float) -> Method:
    terms = lambda scene: {"formulation": jj.Formulation("full", stabilisation=jj.Baumgarte(rate, rate))}
    return Method(name, "constraints", terms)


NAIVE = (
    "fixed partition",
    "Schur, Cholesky",
    "KKT, LU",
    "pinv, 1e-10",
    "ridge 1e-6",
    "raw SVD basis",
    "raw QR basis",
    "speeds in SVD basis",
    "speeds in QR basis",
)
METHODS: tuple[Method, ...] = (
    Method("default", "engine"),
    Method("rollout", "engine", batch=True),
    *(_by_reduction(name) for name in REDUCTIONS),
    *(_stabilised(name, rate) for name, rate in STABILISED.items()),
    *(
        Method(name, "integrators", lambda scene, make=make: {"solver": make(), "work": False})
        for name, make in INTEGRATORS.items()
    ),
    *(Method(name, "integrators") for name in EVEN_STEPS),
    Method("forward mode", "adjoints"),
    *(Method(name, "naive", naive=name) for name in NAIVE),
    Method("MuJoCo", "elsewhere", elsewhere=True),
)
GROUPS = tuple(dict.fromkeys(method.group for method in METHODS))
