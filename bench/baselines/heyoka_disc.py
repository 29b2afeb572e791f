"""The hand-derived equations of the tilting disc for heyoka. Needs `pip install heyoka` (extra `bench`)."""

from . import dense
from .hand_derived import HAND_DERIVED, tilting_disc
from .heyoka_lowered import MISSING, heyoka


def system():
    """The hand-derived equations as heyoka takes them."""
    if heyoka is None:
        raise ImportError(MISSING)
    known = HAND_DERIVED["tilting-disc"]
    y = heyoka.make_vars(*known.coordinates, *known.speeds)
    qdot, vdot = tilting_disc(dense.DISC_PARAMETERS, heyoka.time, tuple(y[:5]), tuple(y[5:]), xp=heyoka)
    return list(zip(y, (*qdot, *vdot), strict=True))
