"""Files of raw measurements of a bicycle, `name = reading+/-sigma, reading+/-sigma, ...` per line: lengths,
masses, angles and periods of its parts.

Format of BicycleParameters (Moore, Hubbard & Kooijman), files `*Measured.txt`. n readings of one quantity are
replaced by their mean, with the standard deviation sqrt(sum sigma^2) / n. A name consists of quantity, part
and number: `TtB2` is the twisting period of the rear frame B in its second hanging.

| name | reading | unit |
|---|---|---|
| `dR nR`, `dF nF` | distance rolled by a wheel; number of turns | m |
| `w gamma f` | wheelbase, slope of the steer axis, fork offset | m, deg |
| or `h1`...`h5`, `d1`...`d4`, `d` | heights and diameters on a level table | m |
| `mR mF mB mH` | masses of wheels, rear frame, fork with handlebar | kg |
| or `mG mS` for `mH` | masses of handlebar G and fork S | kg |
| `lR TcR1`, `lF TcF1` | wheel swung: from axle to its middle, period | m, s |
| `TcB1`, `TcH1` | frame and fork swung, hung by the middle of their wheel: period | s |
| `TtR1`, `TtF1` | wheel twisted on an upright rod, about a diameter: period | s |
| `alphaB1 aB1 TtB1`, ... | twisted: slope of the steer axis, offset of the rod, period | deg, m, s |
| `mP lP dP TtP1` | a steel bar of known inertia, which calibrates the rod | kg, m, s |
| `h6 h7 d5 d6 l` | suspension point of handlebar G relative to the front axle; only with G and S | m |
| `g` | gravity | m/s^2 |

The offset of the rod is measured from the middle of the wheel. Each part needs three or more hangings.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

from jourdain_jax.bicycle.parameter_files import entries, listed, read_lines, text_lines, with_sigma
from jourdain_jax.calculus.files import name_of
from jourdain_jax.calculus.reals import Indices
from jourdain_jax.scene.coordinates import Labels

_FORM = (
    "`name = reading+/-sigma`, or several readings with commas between, for example `TcB1 = 1.7173+/-0.0001`"
)
_FRAME, _TABLE = ("w", "gamma", "f"), ("h1", "h2", "h3", "h4", "h5", "d1", "d2", "d3", "d4", "d")
_WHOLE_FORK, _SPLIT_FORK = ("mH", "TcH1"), ("mG", "mS", "h6", "h7", "d5", "d6", "l", "TcG1", "TcS1")
_ALWAYS = "g dR nR dF nF mR mF mB lR lF TcR1 TcF1 TtR1 TtF1 mP lP dP TtP1 TcB1"


@dataclass(frozen=True)
class Readings:
    """The readings of one bicycle as means with standard deviations; `hangings`: numbers of the hangings of
    each part, such as B: (1, 2, 3).
    """

    path: str
    means: dict[str, float]
    sigmas: dict[str, float]
    hangings: dict[str, Indices]
    without_sigma: Labels
    unused: Labels

    @property
    def by_table(self) -> bool:
        """Return whether wheelbase and fork offset follow from heights and diameters on a table."""
        return "w" not in self.means


def holds_readings(path: Path) -> bool:
    """Return whether the name of a file is that of a file of raw measurements."""
    return path.name.endswith("Measured.txt")


def read_readings(path: str | Path) -> Readings:
    """Return the readings of one file of raw measurements.

    **Raises** ValueError, with file, line and quantity, for an unreadable file, a malformed line, a repeated
    quantity, a negative sigma, or missing readings.
    """
    path = Path(name_of(path))
    means: dict[str, float] = {}
    sigmas: dict[str, float | None] = {}
    for where, name, right in entries(
        path, text_lines(read_lines(path)), _FORM, "Write several readings in one line, with commas between."
    ):
        means[name], sigmas[name] = _mean(
            [with_sigma(one, name, where, "reading") for one in right.split(",")]
        )
    split = "mS" in means or "mG" in means
    needed = [
        *_ALWAYS.split(),
        *(_SPLIT_FORK if split else _WHOLE_FORK),
        *(_FRAME if "w" in means else _TABLE),
    ]
    hangings = {part: _hangings(means, part) for part in ("BGS" if split else "BH")}
    missing = [name for name in needed if name not in means]
    for part, found in hangings.items():  # three unknowns in the plane of symmetry need three hangings
        missing += [f"{what}{part}{k + 1}" for k in range(len(found), 3) for what in ("alpha", "a", "Tt")]
    if missing:
        raise ValueError(
            f"{path}: missing {listed(missing)}, which the parameters of a bicycle need. Measure each one, "
            f"and add a line {_FORM}."
        )
    used = {
        *needed,
        *(
            f"{what}{part}{k}"
            for part, found in hangings.items()
            for k in found
            for what in ("alpha", "a", "Tt")
        ),
    }
    return Readings(
        path=str(path),
        means={name: means[name] for name in sorted(used)},
        sigmas={name: sigmas[name] or 0.0 for name in sorted(used)},
        hangings=hangings,
        without_sigma=tuple(
            name
            for name, sigma in sigmas.items()
            if sigma is None and name in used and not name.startswith("n")
        ),
        unused=tuple(name for name in means if name not in used),
    )


def _hangings(means: dict[str, float], part: str) -> Indices:
    """Return the numbers of the hangings of a part that have all three readings."""
    numbers = sorted(int(name[len(f"Tt{part}") :]) for name in means if re.fullmatch(rf"Tt{part}\d+", name))
    return tuple(k for k in numbers if f"alpha{part}{k}" in means and f"a{part}{k}" in means)


def _mean(readings: list[tuple[float, float | None]]) -> tuple[float, float | None]:
    """Return the mean of the readings in a line, and its standard deviation; None if no reading has one."""
    squares = [sigma**2 for _, sigma in readings if sigma is not None]
    return math.fsum(value for value, _ in readings) / len(readings), (
        math.sqrt(math.fsum(squares)) / len(readings) if squares else None
    )
