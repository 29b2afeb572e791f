"""The findings of `build`, in words: constraints, freedoms, time dependence, conserved quantities."""

from dataclasses import dataclass

from jourdain_jax.scene.names import Labels


@dataclass(frozen=True)
class Rows:
    """Which rows hold the scene, and how far they are independent."""

    names: Labels
    rank: int  # at generic states
    redundant: Labels  # may be omitted together: the others keep the rank at every probed state
    may_set_in: Labels  # redundant at every probed state, but by no identity
    rank_losses: Labels  # probed configurations with fewer independent rows
    affine: bool  # linear or affine in the speeds
    homogeneous: bool  # they hold at rest


@dataclass(frozen=True)
class Freedoms:
    """Which speeds are independent, and how well they determine the others."""

    privileged: Labels
    dependent: Labels
    chosen_by_user: bool
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes; 1 is best
    typical_pivot: float

    @property
    def count(self) -> int:
        """Degrees of freedom."""
        return len(self.privileged)


@dataclass(frozen=True)
class Dependence:
    """Explicit dependence on time, and quantities that change along the motion."""

    on_time: Labels  # rows, poses, inertias, coordinate rates, loads, potential
    driven: bool  # bodies move while all speeds are zero
    varying_inertia: bool
    massless: bool  # nothing has inertia along some motion that the rows hold


@dataclass(frozen=True)
class Conserved:
    """Conserved quantities of a motion."""

    energy: bool  # kinetic and potential energy together, without integrated work
    ignorable: Labels  # coordinates that no acceleration depends on; empty where there is no scalar program
    invariants: Labels  # as the scene states them
