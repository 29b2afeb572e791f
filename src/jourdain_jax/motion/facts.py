"""Findings of `build` for display: constraints, degrees of freedom, time dependence, conserved quantities."""

from dataclasses import dataclass

from jourdain_jax.scene.coordinates import Labels


@dataclass(frozen=True)
class Rows:
    """Constraints of the scene and their redundancy."""

    names: Labels
    rank: int  # at generic states
    redundant: Labels  # may be omitted together: the others have the same rank at every probed state
    may_set_in: Labels  # redundant at every probed state, but not provably everywhere
    rank_losses: Labels  # probed configurations of lower rank
    affine: bool  # linear or affine in the speeds
    homogeneous: bool  # satisfied at rest


@dataclass(frozen=True)
class Freedoms:
    """Independent speeds, and how well they determine the dependent ones."""

    privileged: Labels
    dependent: Labels
    chosen_by_user: bool
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes; 1 is best
    typical_pivot: float

    @property
    def count(self) -> int:
        """Return the number of degrees of freedom."""
        return len(self.privileged)


@dataclass(frozen=True)
class Dependence:
    """Explicit dependence on time, and quantities that change along the motion."""

    on_time: Labels  # constraints, poses, inertias, coordinate rates, loads, potential
    driven: bool  # bodies move while all speeds are zero
    varying_inertia: bool
    massless: bool  # some motion without inertia is prevented only by constraints


@dataclass(frozen=True)
class Conserved:
    """Conserved quantities of a motion."""

    energy: bool  # sum of kinetic and potential energy; then no work is integrated
    ignorable: Labels  # coordinates that do not affect accelerations; empty if there is no scalar program
    invariants: Labels  # as the scene states them
