"""Files of measured bicycle parameters, `name = value+/-sigma` per line, read into values, sigmas and
warnings.

The format is that of BicycleParameters (Moore, Hubbard & Kooijman): SI units, the names of Meijaard et al.
2007, `#` comments. YAML files, `name: value`, with or without a section `values`, are read as well. A missing
sigma counts as zero. The files contain no covariance, so errors are taken as independent.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, doubts, violations
from jourdain_jax.calculus import files
from jourdain_jax.calculus.files import read_text, shortened
from jourdain_jax.identification.data.estimate import Correlated, joint_normal
from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.scene.coordinates import Labels, check_name
from jourdain_jax.studies.design import Normal

_FORMAT = "`name = value` or `name = value+/-sigma`, for example `rF = 0.35+/-0.001`"
_REPEATED = {"IRzz": "IRxx", "IFzz": "IFxx"}  # a wheel is symmetric
_OUT_OF_PLANE = ("yB", "yH")  # zero for the symmetric Whipple bicycle


@dataclass(frozen=True)
class MeasuredBicycle:
    """One bicycle's measured parameters: `values` and standard deviations `sigmas`, by name, in SI units."""

    name: str
    values: dict[str, float]  # every name of PARAMETER_NAMES, in that order
    sigmas: dict[str, float]  # the same names; zero if the file gives none
    path: str
    without_sigma: Labels  # names without a sigma in the file
    ignored: Labels  # names in the file that the Whipple bicycle lacks
    warnings: Labels  # sentences on doubtful values, which are used unchanged
    # covariance in the order of `values`; None: unknown, errors are taken as independent
    covariance: Float[np.ndarray, "parameters parameters"] | None = None

    @property
    def with_independent_errors(self) -> "MeasuredBicycle":
        """Return the bicycle without the covariance of its parameters, whose errors are then independent."""
        return replace(self, covariance=None)

    @property
    def scene(self) -> WhippleBicycle:
        """Return the bicycle as a scene, with the measured values."""
        return WhippleBicycle(**self.values)

    @property
    def prior(self) -> dict[str, Normal]:
        """Return independent distributions of the measured parameters, for `jj.Study(bicycle.scene,
        vary=bicycle.prior)`. Parameters without a sigma are omitted.
        """
        return {name: Normal(self.values[name], sigma) for name, sigma in self.sigmas.items() if sigma > 0}

    @property
    def joint_prior(self) -> dict[str, Normal | Correlated]:
        """Return the joint prior of the measured parameters, with their covariance if known:
        `jj.fit(bicycle.scene, data, free=bicycle.joint_prior)`.
        """
        if self.covariance is None:
            return dict(self.prior)
        known = np.array([sigma > 0 for sigma in self.sigmas.values()])
        return dict(
            joint_normal(
                {name: self.values[name] for name in self.prior}, self.covariance[np.ix_(known, known)]
            )
        )


def measured_bicycle(name: str) -> MeasuredBicycle:
    """Return one of the bicycles shipped with the package, by its name: `measured_bicycle("Browser")`.

    **Raises** ValueError for an unknown name, with the nearest known ones, and as in `read_bicycle`.
    """
    known = shipped_bicycles()
    check_name(name, known, f"there is no measured bicycle `{name}`")
    return read_bicycle(known[name])


def shipped_bicycles() -> dict[str, Path]:
    """Return the parameter files shipped with the package, name -> path. `Tms` describes an impossible
    bicycle.
    """
    return _shipped("Benchmark")


def shipped_measurements() -> dict[str, Path]:
    """Return the files of raw measurements shipped with the package, name -> path, for
    `benchmark_from_measurements`.

    The readings of `Silver` belong to parts of another bicycle. `Gyro`, `Rigidcl` and `Stratos` have no
    published parameters.
    """
    return _shipped("Measured")


def _shipped(ending: str) -> dict[str, Path]:
    folder = Path(str(resources.files("jourdain_jax") / "bicycle" / "data"))
    return {
        path.stem.removesuffix(ending) or path.stem: path for path in sorted(folder.glob(f"*{ending}.txt"))
    }


def read_bicycle(path: str | Path) -> MeasuredBicycle:
    """Return the bicycle of one parameter file, read as YAML or as text, depending on the suffix of `path`.

        bicycle = read_bicycle(shipped_bicycles()["Browser"])
        bicycle.values["c"], bicycle.sigmas["c"]  # trail and its standard deviation, m

    **Raises** ValueError, with file, line and parameter, for an unreadable file, a malformed line, a value
    that is not a finite number, a negative sigma, unknown, missing or repeated names, and an impossible
    bicycle (radii, masses, wheelbase and gravity must be positive, moments of inertia not negative).
    """
    path = Path(files.name_of(path))
    text = read_lines(path)
    lines = _yaml_lines(text, path) if path.suffix.lower() in (".yml", ".yaml") else text_lines(text)
    values: dict[str, float] = {}
    sigmas: dict[str, float] = {}
    for where, name, right in entries(path, lines, _FORMAT, "Keep one of the two lines."):
        _check_known(name, where)
        values[name], sigma = with_sigma(right, name, where, "value")
        if sigma is not None:
            sigmas[name] = sigma

    missing = [name for name in PARAMETER_NAMES if name not in values]
    if missing:
        raise ValueError(
            f"{path}: missing {listed(missing)}; a bicycle needs all of {' '.join(PARAMETER_NAMES)}. Add a "
            f"line {_FORMAT} for each."
        )
    known = {name: values[name] for name in PARAMETER_NAMES}
    broken = [sentence for sentence, is_broken in violations(known).items() if is_broken]
    if broken:
        got = ", ".join(
            f"{name} = {known[name]:g}" for name in PARAMETER_NAMES if any(f"`{name}`" in s for s in broken)
        )
        raise ValueError(
            f"{path}: degenerate bicycle: {'; '.join(broken)}; got {got}. The nonlinear model rolls on real "
            "wheels: give their true radii, masses and moments of inertia (SI units, radians), or omit this "
            "bicycle."
        )
    return MeasuredBicycle(
        name=path.stem.removesuffix("Benchmark") or path.stem,
        values=known,
        sigmas={name: sigmas.get(name, 0.0) for name in PARAMETER_NAMES},
        path=str(path),
        without_sigma=tuple(name for name in PARAMETER_NAMES if name not in sigmas),
        ignored=tuple(name for name in values if name not in known),
        warnings=doubts(known) + _ignored_but_telling(values),
    )


def read_lines(path: Path) -> str:
    """Return the text of a file of parameters or readings. Raises ValueError if it is empty."""
    text = read_text(path, 1_000_000, f"a bicycle parameter file with lines {_FORMAT}")
    if not text.strip():
        raise ValueError(f"{path}: the file is empty. Expected lines {_FORMAT}.")
    return text


def text_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and content, without comments, of the lines that contain a parameter."""
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.partition("#")[0].strip()
        if content:
            yield number, content


def _yaml_lines(text: str, path: Path) -> Iterator[tuple[int, str]]:
    """Yield line numbers and contents of a YAML file, in the format of a text file: of the section `values`,
    or of the whole file if there is no such section.
    """
    lines = [
        (number, line.partition("#")[0].rstrip()) for number, line in enumerate(text.splitlines(), start=1)
    ]
    has_section = any(line.partition(":")[0] == "values" for _, line in lines)
    inside = not has_section
    for number, line in lines:
        name, _, value = (part.strip() for part in line.partition(":"))
        is_indented = line[:1].isspace()
        if not line.strip() or name in ("---", "..."):
            continue
        if has_section and not is_indented:
            inside = name == "values"
            if name == "parameterization" and value.strip("\"'") not in ("benchmark", "Meijaard2007"):
                raise ValueError(
                    f"{path}, line {number}: parameterization `{shortened(value)}`, expected the "
                    f"benchmark's: {' '.join(PARAMETER_NAMES)}"
                )
        elif inside and not value:
            raise ValueError(
                f"{path}, line {number}: got `{shortened(line.strip())}`, expected `name: "
                "value`, for example `rF: 0.35`"
            )
        elif inside:
            yield number, f"{name} = {value}"


def entries(
    path: Path, lines: Iterable[tuple[int, str]], form: str, again: str
) -> Iterator[tuple[str, str, str]]:
    """Yield the location, the name and the text after `=` of each line. Raises ValueError for a line without
    the `form` and for a repeated name.
    """
    given: dict[str, int] = {}
    for number, line in lines:
        where = f"{path}, line {number}"
        name, _, right = (part.strip() for part in line.partition("="))
        if not name or not right:
            raise ValueError(f"{where}: got `{shortened(line)}`, expected {form}")
        if name in given:
            raise ValueError(f"{where}: `{name}` was already given in line {given[name]}. {again}")
        given[name] = number
        yield where, name, right


def with_sigma(text: str, name: str, where: str, what: str) -> tuple[float, float | None]:
    """Return the finite number in `text` and its sigma (None if not given). `name` and `what` ("value" or
    "reading") appear in error messages.
    """
    parts = text.replace("±", "+/-").split("+/-", 1)
    advice = f"; form: {_FORMAT}. Measure it, or omit this bicycle."
    value, *rest = (
        files.number(part, f"{where}: {kind} of `{name}`", advice=advice)
        for part, kind in zip(parts, (what, "sigma"), strict=False)
    )
    sigma = rest[0] if rest else None
    if sigma is not None and sigma < 0:
        raise ValueError(
            f"{where}: sigma of `{name}` is {sigma:g}, expected a standard deviation >= 0. Give "
            "its magnitude, or omit `+/-` if it is unknown."
        )
    return value, sigma


def _check_known(name: str, where: str) -> None:
    # G and S are parts of H, and v is a speed
    if not re.fullmatch(r"v|I[RF]zz|y[BH]|m[GS]|[xyz][GS]|I[GS](xx|yy|zz|xz)", name):
        check_name(name, PARAMETER_NAMES, f"{where}: unknown parameter `{shortened(name)}`")


def _ignored_but_telling(values: dict[str, float]) -> Labels:
    """Return warnings for ignored values that contradict the symmetry of the model."""
    found = [
        f"`{name}` = {values[name]:g} is ignored: the Whipple bicycle is symmetric about its plane"
        for name in _OUT_OF_PLANE
        if values.get(name, 0.0) != 0.0
    ]
    for name, twin in _REPEATED.items():
        if values.get(name, values[twin]) != values[twin]:
            found.append(
                f"`{name}` = {values[name]:g} is ignored: a wheel is symmetric, so `{twin}` is used instead"
            )
    return tuple(found)


def listed(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)
