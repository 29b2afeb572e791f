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
from atlas_cases import naive
from jourdain_jax.equations import GibbsAppell
from jourdain_jax.equations.reductions import Reduced, reduce

REDUCTIONS = ("privileged", "qr", "svd", "kkt", "udwadia-kalaba", "gibbs-appell")
INTEGRATORS: dict = {
    "Tsit5": diffrax.Tsit5,
    "Dopri8": diffrax.Dopri8,
    "Kvaerno5": diffrax.Kvaerno5,
    "Radau IIA": jj.RadauIIA,
}
EVEN_STEPS = {"implicit midpoint": jj.ImplicitMidpoint, "DLA": jj.DiscreteLagrangeDAlembert}  # of a `step`
EVEN_STEPS["discrete gradient"] = jj.DiscreteGradient
# rates; one program serves all
STABILISED = {"no projection": 0.0, "Baumgarte 5/s": 5.0, "Baumgarte 1e4/s": 1e4}


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
    pivot = jnp.asarray(found.pivot, found.udot.dtype)
    return Reduced(found.udot, found.constraint_force, pivot, jnp.asarray(found.applicable))


def reduction(scene, name):
    """The engine's reduction `name` for a scene."""
    if name is None:
        return None
    known = jj.reductions(scene)
    members = tuple(known[member] for member in REDUCTIONS)
    return OneOf(known["gibbs-appell"].independent, jnp.asarray(REDUCTIONS.index(name)), members)


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
    def even_steps(self):
        """Whether it takes steps of one length."""
        return self.name in EVEN_STEPS


def _by_reduction(name) -> Method:
    chosen = lambda scene: {"formulation": jj.Formulation("full", reduction(scene, name))}
    return Method(name, "reductions", chosen, reduction=name)


def _stabilised(name, rate) -> Method:
    terms = lambda scene: {"formulation": jj.Formulation("full", stabilisation=jj.Baumgarte(rate, rate))}
    return Method(name, "constraints", terms)


NAIVE = dict.fromkeys((*naive.ACCELERATIONS, *naive.REDUCED_STATE))
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
