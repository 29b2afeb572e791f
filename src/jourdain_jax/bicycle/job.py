"""The study of measured bicycles: from parameter files to stability speeds with their uncertainty, and
simulated rides.

For each file, the nonlinear Whipple bicycle is built and linearised. A Monte Carlo with the measured standard
deviations gives 2.5 and 97.5 % limits of its weave, capsize and double-root speeds. Hands-free rides are
simulated below, inside and above the stable range.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.bicycle.measurements import benchmark_from_measurements, holds_readings
from jourdain_jax.bicycle.parameter_files import MeasuredBicycle, read_bicycle
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES
from jourdain_jax.bicycle.stability import (
    eigenvalues,
    interval,
    linear_matrices,
    sample_parameters,
    stability_speeds,
    upright_running,
)
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.integrate.result_codes import EVENT
from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.motion.rollout import Rollout, rollout

SPEEDS = ("weave_speed", "capsize_speed", "double_root_speed")
MAX_SPEED = 50.0  # physics, m/s; higher speeds are treated as nonexistent
CAVEAT = (
    "Limits are the 2.5 and 97.5 % quantiles over the samples that have the speed; `fraction` is the share "
    "of these samples.\nSigmas of parameter files count as independent, since these contain no covariance; "
    "raw measurements, `*Measured.txt`,\ncontain one. A missing sigma counts as zero. Speeds above "
    f"{MAX_SPEED:g} m/s count as none."
)


@dataclass(frozen=True)
class Refused:
    """The result for a file that describes an impossible bicycle, with the reason."""

    path: str
    error: str

    def as_dict(self) -> "dict[str, Any]":
        """Return one object of `result.json`."""
        return {"file": self.path, "bicycle": None, "error": self.error} | dict.fromkeys(SPEEDS)


@dataclass(frozen=True)
class Study:
    """Results for one bicycle."""

    path: str
    bicycle: MeasuredBicycle
    speeds: dict[str, dict | None]  # name -> value, low, high, fraction
    stable_fraction: float  # share of the samples with a stable range
    grid: np.ndarray  # forward speeds of the eigenvalues, m/s
    # (samples + 1, speeds, modes): first the measured bicycle; modes: castering, capsize, weave, weave
    eigenvalues: np.ndarray
    physical: np.ndarray  # whether each sample is a possible bicycle
    rides: dict[str, float]  # label -> speed (m/s) of each simulated ride
    lanes: Rollout  # the rides

    def as_dict(self) -> "dict[str, Any]":
        """Return one object of `result.json`."""
        lanes = [self.lanes.lane(i) for i in range(len(self.rides))]
        rides = [
            {
                "label": label,
                "speed": speed,
                "stopped": int(lane.result) == EVENT,
                "t_end": float(lane.t_end),
                "lean_at_end": float(lane.q_end[3]),
                "message": lane.message,
            }
            for lane, (label, speed) in zip(lanes, self.rides.items(), strict=True)
        ]
        return {
            "file": self.path,
            "bicycle": self.bicycle.name,
            "error": None,
            **self.speeds,
            "samples": len(self.physical),
            "refused_samples": int(np.sum(~self.physical)),
            "fraction_with_stable_range": self.stable_fraction,
            "without_sigma": list(self.bicycle.without_sigma),
            "warnings": list(self.bicycle.warnings),
            "rides": rides,
        }


def study(path: str | Path, *, samples: int = 2000, seed: int = 0) -> Study | Refused:
    """Return the study of one file; for a file that describes no bicycle, return `Refused`."""
    try:
        bicycle = benchmark_from_measurements(path) if holds_readings(Path(path)) else read_bicycle(path)
    except ValueError as error:
        return Refused(str(path), str(error))
    drawn = sample_parameters(bicycle, jax.random.key(seed), samples)
    nominal = jnp.array([bicycle.values[name] for name in PARAMETER_NAMES])
    physical = np.asarray(drawn.physical)
    # an impossible sample is replaced by the measured values and not counted
    values = jnp.vstack([nominal, jnp.where(drawn.physical[:, None], drawn.values, nominal)])
    found, matrices = _speeds(values)
    weave, capsize = float(found.weave_speed[0]), float(found.capsize_speed[0])
    grid = _speeds_to_draw(weave, capsize, float(found.double_root_speed[0]))
    rides = ride_speeds(weave, capsize, bool(found.stable_range_exists[0]))
    return Study(
        path=str(path),
        bicycle=bicycle,
        speeds={name: _interval(getattr(found, name), physical) for name in SPEEDS},
        stable_fraction=(
            float(np.mean(np.asarray(found.stable_range_exists)[1:][physical])) if physical.any() else 0.0
        ),
        grid=grid,
        eigenvalues=np.asarray(_modes(matrices, jnp.asarray(grid))),
        physical=physical,
        rides=rides,
        lanes=ride(bicycle.values, list(rides.values())),
    )


def ride_speeds(weave: float, capsize: float, stable: bool) -> dict[str, float]:
    """Return label -> speed (m/s): below, inside and above the stable range, or fixed speeds if there is
    none.
    """
    if not stable or not np.isfinite(weave):
        return {f"no stable range, {v:.1f} m/s": v for v in (3.0, 5.0, 8.0)}
    if not np.isfinite(capsize) or capsize <= weave:  # stable at all speeds above the weave speed
        return {
            "below the stable range": 0.75 * weave,
            "inside it, near its start": 1.2 * weave,
            "inside it, faster (it has no end)": 2.0 * weave,
        }
    return {
        "below the stable range": 0.75 * weave,
        "inside the stable range": (weave + capsize) / 2,
        "above the stable range": 1.3 * capsize,
    }


def ride(values: dict[str, float], speeds: list[float]) -> Rollout:
    """Simulate hands-free rides of the bicycle with these parameters: upright running with a kick in lean
    rate, until it falls.
    """
    bicycle = WhippleBicycle.from_values(values)
    kicked = jax.vmap(lambda speed: upright_running(bicycle, speed, 0.1))(jnp.asarray(speeds))
    return rollout(bicycle, kicked, ts=np.linspace(0.0, 6.0, 301), progress=False, work=False)


@compiled_quickly
@jax.vmap
def _speeds(row):
    matrices = linear_matrices(dict(zip(PARAMETER_NAMES, row, strict=True)))
    return stability_speeds(*matrices, max_speed=MAX_SPEED), matrices


_modes = jax.jit(jax.vmap(lambda matrices, grid: eigenvalues(*matrices, speeds=grid), (0, None)))


def _interval(values, physical) -> dict | None:
    """Return value, low, high and fraction of one speed; None if neither the bicycle nor a sample has it."""
    if np.isnan(values).all():
        return None
    limits = interval(values[1:], nominal=values[0], counted=jnp.asarray(physical))
    return {name: None if np.isnan(x) else float(x) for name, x in vars(limits).items()}


def _speeds_to_draw(weave: float, capsize: float, double_root: float) -> np.ndarray:
    """Return speeds for the plot: uniform ones beyond the known speeds, and denser ones near the double root,
    where two eigenvalues separate like a square root.
    """
    known = [v for v in (weave, capsize) if np.isfinite(v)]
    top = float(np.clip(1.6 * max(known, default=6.0), 8.0, 20.0))
    close = np.nan_to_num(double_root) + 0.1 * top * np.linspace(-1.0, 1.0, 20) ** 3
    return np.sort(np.concatenate([np.linspace(0.0, top, 81), np.clip(close, 0.0, top)]))


def run(
    paths: Sequence[str | Path],
    *,
    samples: int = 2000,
    seed: int = 0,
    progress: Callable[[str], Any] = lambda text: None,
) -> list[Study | Refused]:
    """Return the studies of all files, in order, with shared compiled programs."""
    studies = []
    for path in paths:
        progress(f"{path} ...")
        studies.append(study(path, samples=samples, seed=seed))
    return studies


def write_results(studies: Sequence[Study | Refused], path: str | Path) -> None:
    """Write `result.json`: a list, one object per file."""
    with open(path, "w", encoding="utf-8") as file:
        json.dump([one.as_dict() for one in studies], file, indent=2)


def table(studies: Sequence[Study | Refused]) -> str:
    """Return the printed table, with an explanation of the limits."""
    lines = [f"{'bicycle':<18}{'weave':>26}{'capsize':>26}{'double root':>26}   stable range"]
    lines.append(f"{'':<18}" + f"{'m/s   95 % limits':>26}" * 3)
    for one in studies:
        if isinstance(one, Refused):
            lines.append(f"refused: {one.error}")
            continue
        cells = "".join(f"{_cell(one.speeds[name]):>26}" for name in SPEEDS)
        lines.append(f"{one.bicycle.name:<18}{cells}   in {100 * one.stable_fraction:.1f} % of samples")
        lines += [f"{'':<18}{text}" for text in _notes(one)]
    return "\n".join([*lines, "", CAVEAT])


def _cell(speed: dict | None) -> str:
    if speed is None:
        return "none"
    value = "none" if speed["value"] is None else f"{speed['value']:.4f}"
    if speed["low"] is None:
        return value
    limits = f"[{speed['low']:.3f}, {speed['high']:.3f}]"
    return f"{value} {limits}" + ("" if speed["fraction"] == 1 else f" {100 * speed['fraction']:.1f}%")


def _notes(one: Study) -> list[str]:
    notes = [
        f"ride at {r['speed']:.2f} m/s, {r['label']}: {r['message']} at t = {r['t_end']:.2f} s"
        for r in one.as_dict()["rides"]
    ]
    if refused := int(np.sum(~one.physical)):
        notes.append(f"{refused} samples are impossible bicycles and do not count")
    if one.bicycle.covariance is not None:
        notes.append("parameters from raw measurements, with their covariance")
    if one.bicycle.without_sigma:
        notes.append("without a sigma: " + ", ".join(one.bicycle.without_sigma))
    return notes + [f"warning: {text}" for text in one.bicycle.warnings]
