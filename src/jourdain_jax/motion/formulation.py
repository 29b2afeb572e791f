"""Which equations are integrated: the form of the state, how accelerations are found, and what keeps the state on its constraints."""

from dataclasses import replace
from typing import Literal

import equinox as eqx

from jourdain_jax.dynamics.accelerations import Baumgarte
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.reductions import Reduction
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.numbers import described

_STATES = ("auto", "minimal", "full")


class Formulation(eqx.Module):
    """Which equations `simulate` integrates. The default takes what serves the scene.

    - `state`: "minimal", coordinates q and privileged speeds y; "full", coordinates and all speeds u; "auto" (default), the minimal one where the
      privileged speeds are well conditioned over the scene's domain and the rows are linear or affine.
    - `reduction`: how accelerations are found, a name or an object as in `accelerations` (default: the scene's scalar program where there is one).
    - `stabilisation`: what keeps the state on rows that its form does not keep by itself, the start included: "projection" (default) puts it back after
      each step; `jj.Baumgarte(alpha, beta)` adds its terms to the rows, for comparison; None leaves it alone.

    ValueError for anything else.

    **Examples**

        rods = jj.models.DoublePendulumRods()
        dense = jj.Formulation("full", reduction="kkt")                # all speeds, multipliers from one linear system
        motion = jj.simulate(rods, t1=0.2, formulation=dense)
        print(motion.state_form, motion.reduction)
    """

    state: Literal["auto", "minimal", "full"] = eqx.field(static=True, default="auto")
    reduction: Reduction | GibbsAppell | str | None = None
    stabilisation: Baumgarte | Literal["projection"] | None = "projection"

    def __check_init__(self) -> None:
        if self.state not in _STATES:
            raise ValueError(f"unknown state form `{self.state}`; {nearest(str(self.state), _STATES)}")
        stabilisation = self.stabilisation
        if not (stabilisation is None or isinstance(stabilisation, Baumgarte) or (isinstance(stabilisation, str) and stabilisation == "projection")):
            raise ValueError(f'`stabilisation` is {described(stabilisation)}, expected "projection", `jj.Baumgarte(alpha, beta)` or None')

    @property
    def projects(self) -> bool:
        """Whether the state is put back onto the constraints after each step."""
        return isinstance(self.stabilisation, str)

    @property
    def baumgarte(self) -> Baumgarte | None:
        """The terms added to the rows; None where there are none."""
        return self.stabilisation if isinstance(self.stabilisation, Baumgarte) else None

    def with_state(self, state: Literal["auto", "minimal", "full"]) -> "Formulation":
        """This formulation with another form of the state."""
        return replace(self, state=state)


_DEFAULT = Formulation()


def as_formulation(formulation) -> Formulation:
    """The formulation, the default one for None; ValueError for anything else."""
    if formulation is None:
        return _DEFAULT
    if not isinstance(formulation, Formulation):
        raise ValueError(f"`formulation` is {described(formulation)}, expected `jj.Formulation(state, reduction, stabilisation)` or None")
    return formulation
