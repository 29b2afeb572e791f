"""Parameters of a bicycle from raw measurements of its parts, with their covariance.

    y: readings with standard deviations s;   theta(y): parameters
    covariance of theta = J diag(s^2) J',     J = d theta / d y

    swung on a level axle      (I + m l^2) angle'' + m g l sin angle = 0
                               T = 2 pi sqrt((I + m l^2) / (m g l))
    twisted on upright rod     (n . I n) twist'' + k twist = 0
                               T = 2 pi sqrt((n . I n) / k)

m, I: mass and inertia of the part; l: distance of its mass centre from the axle; T: period; k: stiffness of
the rod; n: direction of the rod in axes of the part. The mass centre of a hung part lies below the rod. If
there are more hangings or plumb lines than unknowns, they are fitted by least squares. Readings are
independent, but parameters that depend on the same readings are correlated: all inertias depend on the
stiffness of the rod, and the inertia about y on the mass centre. Source: J. D. G. Kooijman, M.Sc. thesis,
Delft (2006), chapter 3; J. K. Moore, Human control of a bicycle, Ph.D. thesis, Davis (2012), chapter 4.

`read_readings` reads a file of raw measurements with one quantity per line, `name = reading+/-sigma,
reading+/-sigma, ...`, in the format of BicycleParameters (Moore, Hubbard & Kooijman;
`*Measured.txt`). n readings of one quantity are
replaced by their mean, with the standard deviation `sqrt(sum sigma^2) / n`. A name consists of quantity, part
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
import os
import re
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.bicycle.parameter_files import (
    MeasuredBicycle,
    entries,
    listed,
    read_lines,
    shipped_measurements,
    text_lines,
    with_sigma,
)
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, doubts, violations
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.files import name_of
from jourdain_jax.calculus.reals import Indices, PerRow, Scalar, real_type
from jourdain_jax.scene.coordinates import Labels, Sentences, check_name

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
    """Return whether a file name denotes raw measurements."""
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


PerHanging = Float[Array, "hangings"]
Values = dict[str, Scalar]


def benchmark_from_measurements(path: str | Path) -> MeasuredBicycle:
    """Return the 26 parameters of a bicycle with their covariance, from periods, hang angles and lengths of
    its parts.

        bicycle = benchmark_from_measurements("Browser")  # shipped; or the path of a file
        bicycle.values["IBxx"], bicycle.covariance        # kg m^2; in the order of the names in `values`

    Derivatives of the parameters with respect to the readings are exact; covariances are of first order in
    the sigmas of the readings (see the module docstring). A mass centre is the point with the least sum of
    squared distances from its plumb lines. (The published values are means over the intersections of all
    pairs of lines, where nearly parallel lines have the same weight.)

    **Arguments:** `path`, the path of a file of readings (format: see the top of this file), or the name of
    a shipped one (`shipped_measurements`). **Returns:** a `MeasuredBicycle`, with a warning for plumb lines
    that miss the mass centre by more than their sigmas allow. **Raises** ValueError for an unreadable or
    incomplete file, an unknown name, and readings that no bicycle can have.
    """
    if isinstance(path, str) and not os.path.exists(path) and not Path(path).suffix:
        known = shipped_measurements()
        check_name(path, known, f"there are no measurements of a bicycle `{path}`, and no such file")
        path = known[path]
    readings = read_readings(path)
    means = {name: jnp.asarray(value, real_type()) for name, value in readings.means.items()}
    found, slopes = _with_slopes(means, tuple(readings.hangings.items()), readings.by_table)
    sigmas = np.array([readings.sigmas[name] for name in readings.means])
    jacobian = np.array([slopes[name] for name in (*PARAMETER_NAMES, *_misses(readings))]) * sigmas
    values = {name: float(found[name]) for name in PARAMETER_NAMES}
    if broken := [sentence for sentence, is_broken in violations(values).items() if is_broken]:
        raise ValueError(
            f"{readings.path}: no bicycle has these readings: {'; '.join(broken)}. Look for a reading in "
            "another unit, or of another part."
        )
    parameters, misses = np.split(jacobian, [len(PARAMETER_NAMES)])
    covariance = parameters @ parameters.T
    return MeasuredBicycle(
        name=Path(readings.path).stem,
        values=values,
        sigmas=dict(zip(PARAMETER_NAMES, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        path=readings.path,
        without_sigma=readings.without_sigma,
        ignored=readings.unused,
        warnings=doubts(values) + _missing_lines(readings, found, misses),
        covariance=covariance,
    )


def _misses(readings: Readings) -> Labels:
    return tuple(f"miss {part}{k}" for part, numbers in readings.hangings.items() for k in numbers)


def _missing_lines(readings: Readings, found: Values, misses: np.ndarray) -> Sentences:
    """Return one sentence for each part whose plumb lines do not meet within their sigmas."""
    names, warnings = _misses(readings), []
    for part in readings.hangings:
        here = [i for i, name in enumerate(names) if name.startswith(f"miss {part}")]
        distance = [abs(float(found[names[i]])) for i in here]
        sigma = np.sqrt(np.sum(misses[here] ** 2, axis=1))
        exact = np.where(np.array(distance) > 1e-12, np.inf, 0.0)  # ratios if the sigmas are zero
        ratio = np.divide(distance, sigma, out=exact, where=sigma > 0)
        worst = int(np.argmax(ratio))
        if ratio[worst] > 3:  # lines may miss a mass centre by three standard deviations
            warnings.append(
                f"upright lines through the hung part {part} miss its mass centre by up to "
                f"{1e3 * max(distance):.1f} mm, {ratio[worst]:.0f} sigmas: these sigmas are too small, or a "
                "reading is wrong"
            )
    return tuple(warnings)


@compiled_quickly
def _with_slopes(
    means: Values, hangings: tuple[tuple[str, Indices], ...], by_table: bool
) -> tuple[Values, dict[str, Float[Array, "readings"]]]:
    """Return parameters, distances of plumb lines, and the derivatives of both with respect to each reading,
    in the order of `means`.
    """
    # compiles in half the time of `jacfwd`
    found, slope = jax.linearize(lambda y: _parameters(y, dict(hangings), by_table), means)
    return found, jax.vmap(slope)(dict(zip(means, jnp.eye(len(means)), strict=True)))


def _parameters(y: Values, hangings: dict[str, Indices], by_table: bool) -> Values:
    """Return all parameters of the benchmark bicycle, and the distances of plumb lines from the mass centres
    ("miss B1").
    """
    found = {"g": y["g"]} | {f"r{wheel}": y[f"d{wheel}"] / (2 * jnp.pi * y[f"n{wheel}"]) for wheel in "RF"}
    found |= {f"m{part}": y[f"m{part}"] for part in ("R", "F", *hangings)}
    found |= _geometry(y, found, by_table)
    rear, front = jnp.stack([jnp.zeros(()), -found["rR"]]), jnp.stack([found["w"], -found["rF"]])
    hung_by, lengths = {"B": rear, "H": front, "S": front}, {wheel: y[f"l{wheel}"] for wheel in "RF"}
    if "G" in hangings:
        hung_by["G"] = front - _handlebar_to_axle(y, found["lam"])
    tilts = {}
    for part, numbers in hangings.items():
        # if the bicycle stands on the road, alpha is 90 degrees + lam
        tilts[part] = jnp.deg2rad(_column("alpha", part, numbers, y)) - found["lam"] - jnp.pi / 2
        r, misses = _mass_centre(tilts[part], _column("a", part, numbers, y))
        found |= {f"{axis}{part}": at for axis, at in zip("xz", hung_by[part] + r, strict=True)}
        found |= {f"miss {part}{k}": miss for k, miss in zip(numbers, misses, strict=True)}
        lengths[part] = jnp.sqrt(r @ r)
    found |= _moments_about_y(y, lengths) | _moments_in_plane(y, hangings, tilts)
    return found if "G" not in hangings else found | _of_whole_bicycle(found)


def _column(what: str, part: str, numbers: Indices, y: Values) -> PerHanging:
    return jnp.stack([y[f"{what}{part}{k}"] for k in numbers])


def _geometry(y: Values, known: Values, by_table: bool) -> Values:
    """Return wheelbase w, trail and tilt lam of the steer axis.

        w = (a + b) cos lam + d sin lam
        rR - rF = d cos lam - (a + b) sin lam = sqrt(d^2 + (a + b)^2) cos(lam + atan((a + b) / d))
        trail = (rF sin lam - b) / cos lam

    a, b: lengths of the rear frame and of the fork across the steer axis; d: distance of the wheel centres
    along it; rR, rF: radii of the wheels.
    """
    if not by_table:
        w, lam, b = y["w"], jnp.deg2rad(90 - y["gamma"]), y["f"]
    else:
        a = y["h1"] + y["h2"] - y["h3"] + (y["d1"] - y["d2"]) / 2
        b = y["h4"] - y["h5"] + (y["d4"] - y["d3"]) / 2
        d = jnp.sqrt((y["d"] + (y["d2"] + y["d3"]) / 2) ** 2 - (a - b) ** 2)
        lam = jnp.arccos((known["rR"] - known["rF"]) / jnp.hypot(d, a + b)) - jnp.arctan2(a + b, d)
        w = (a + b) * jnp.cos(lam) + d * jnp.sin(lam)
    return {"w": w, "lam": lam, "c": (known["rF"] * jnp.sin(lam) - b) / jnp.cos(lam)}


def _handlebar_to_axle(y: Values, lam: Scalar) -> Float[Array, "2"]:
    """Return the vector from the suspension point of the handlebar to the front axle, (x, z), m. Both were
    measured on a table, with the steer axis level.
    """
    across = y["h7"] - y["h6"] + (y["d5"] - y["d6"]) / 2
    along = jnp.sqrt((y["l"] - (y["d5"] + y["d6"]) / 2) ** 2 - across**2)
    return jnp.stack(
        [along * jnp.sin(lam) - across * jnp.cos(lam), along * jnp.cos(lam) + across * jnp.sin(lam)]
    )


def _mass_centre(tilts: PerHanging, beside: PerHanging) -> tuple[Float[Array, "2"], PerHanging]:
    """Return the vector (x, z) from the suspension point of a part to its mass centre, m, and the distances
    of the plumb lines from that centre.

        cos(tilt) x + sin(tilt) z = a

    a: the distance of the rod's vertical line from the suspension point.
    """
    across = jnp.stack([jnp.cos(tilts), jnp.sin(tilts)], axis=1)
    r = _least_squares(across, beside)
    return r, across @ r - beside


def _least_squares(rows: Float[Array, "rows columns"], values: PerRow) -> Float[Array, "columns"]:
    return jnp.linalg.solve(rows.T @ rows, rows.T @ values)


def _moments_about_y(y: Values, lengths: Values) -> Values:
    """Return Iyy of the parts, kg m^2, from the periods of their swings and the distances `lengths` of their
    mass centres from the axle.
    """
    return {
        f"I{p}yy": y[f"m{p}"] * l * (y["g"] * (y[f"Tc{p}1"] / (2 * jnp.pi)) ** 2 - l)
        for p, l in lengths.items()
    }


def _moments_in_plane(y: Values, hangings: dict[str, Indices], tilts: dict[str, Float[Array, "_"]]) -> Values:
    """Return Ixx, Izz, Ixz of the parts and Ixx of the wheels, kg m^2, from the periods of their twists, by
    least squares if a part has more than three periods.

    A bar of known inertia calibrates the rod. Wheels are fixed to it by their rims, parts along n = (-sin
    tilt, 0, cos tilt).
    """
    bar = y["mP"] * (3 * (y["dP"] / 2) ** 2 + y["lP"] ** 2) / 12
    along = lambda timed: bar * (timed / y["TtP1"]) ** 2
    found = {f"I{wheel}xx": along(y[f"Tt{wheel}1"]) for wheel in "RF"}
    for part, numbers in hangings.items():
        s, c = jnp.sin(tilts[part]), jnp.cos(tilts[part])
        moments = _least_squares(
            jnp.stack([s**2, c**2, -2 * s * c], axis=1), along(_column("Tt", part, numbers, y))
        )
        found |= {f"I{part}{axes}": moment for axes, moment in zip(("xx", "zz", "xz"), moments, strict=True)}
    return found


def _of_whole_bicycle(found: Values) -> Values:
    """Return the handlebar G and the fork S combined as one body H."""
    mass = found["mG"] + found["mS"]
    x, z = ((found["mG"] * found[f"{axis}G"] + found["mS"] * found[f"{axis}S"]) / mass for axis in "xz")
    moments = dict.fromkeys(("xx", "yy", "zz", "xz"), jnp.zeros(()))
    for part in "GS":
        m, dx, dz = found[f"m{part}"], found[f"x{part}"] - x, found[f"z{part}"] - z
        apart = {"xx": m * dz**2, "yy": m * (dx**2 + dz**2), "zz": m * dx**2, "xz": -m * dx * dz}
        moments = {axes: moments[axes] + found[f"I{part}{axes}"] + apart[axes] for axes in moments}
    return {"mH": mass, "xH": x, "zH": z} | {f"IH{axes}": moment for axes, moment in moments.items()}
