"""The result of a verification: comparisons, each with its size, its threshold and its culprit."""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.scene.printing import Printed

# Relative to the size of what is compared, by floating-point type.
THRESHOLDS: dict[str, dict[str, float]] = {
    "float64": {
        "inertia": 1e-10,
        "potentials": 1e-10,
        "derivatives": 1e-6,
        "reductions": 1e-10,
        "forms": 1e-10,
        "virtual power": 1e-10,
        "Newton": 1e-10,
        "energy": 1e-9,
        "jvp against vjp": 1e-11,
        "differences": 1e-6,
    },
    "float32": {
        "inertia": 1e-5,
        "potentials": 1e-4,
        "derivatives": 1e-2,
        "reductions": 1e-4,
        "forms": 1e-4,
        "virtual power": 1e-4,
        "Newton": 1e-4,
        "energy": 1e-4,
        "jvp against vjp": 1e-4,
        "differences": 2e-2,
    },
}
DIFFERENCE_STEP = {"float64": 1e-3, "float32": 2e-2}  # of the fourth-order central differences


class Check(eqx.Module):
    """One comparison: its relative size, what it may be, and what it is about."""

    name: str = eqx.field(static=True)
    value: float
    threshold: float
    culprit: str = eqx.field(static=True)  # body, load, row, form or reduction with the largest value
    note: str = eqx.field(static=True, default="")

    @property
    def passed(self) -> bool:
        """Whether the value is within its threshold."""
        return bool(self.value <= self.threshold)

    def as_dict(self) -> dict:
        """The check for machines; a value that is not finite is None."""
        value = float(self.value) if np.isfinite(self.value) else None
        return {"name": self.name, "value": value, "threshold": self.threshold, "passed": self.passed, "culprit": self.culprit, "note": self.note}


def check(name: str, values: dict, dtype, note: str = "") -> Check:
    """The check called `name` (a key of `THRESHOLDS`) from a number for every suspect; NaN counts as larger than any number."""
    threshold = THRESHOLDS[np.dtype(dtype).name][name]
    if not values:
        return Check(name, 0.0, threshold, "nothing", note)
    sizes = {suspect: float(value) for suspect, value in values.items()}
    culprit = max(sizes, key=lambda suspect: np.inf if np.isnan(sizes[suspect]) else sizes[suspect])
    return Check(name, sizes[culprit], threshold, culprit, note)


def beside(f: Callable, point, direction, u) -> tuple[list, float]:
    """Values of f at -2h, -h, h and 2h along a direction, and h; all points through the same program. `u`: the speeds, which h goes with."""
    h = DIFFERENCE_STEP[u.dtype.name] / (1 + float(np.max(np.abs(u), initial=0.0)))
    return [f(jax.tree.map(lambda x, d, k=k: x + k * h * d, point, direction)) for k in (-2, -1, 1, 2)], h


def central_difference(along: list, h: float):
    """Fourth-order central difference from the values at -2h, -h, h, 2h."""
    return (along[0] - 8 * along[1] + 8 * along[2] - along[3]) / (12 * h)


class Verification(Printed, eqx.Module):
    """All checks of one state; `print` shows them as a table."""

    scene: str = eqx.field(static=True)
    checks: tuple[Check, ...]
    not_applicable: tuple[str, ...] = eqx.field(static=True)  # reductions that do not apply at this state

    @property
    def certifies(self) -> bool:
        """Whether passing means agreement to round-off of double precision; single precision shows gross errors only."""
        return all(check.threshold <= THRESHOLDS["float64"][check.name] for check in self.checks)

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def largest(self, *names: str) -> float:
        """The largest value among the checks with these `names` (keys of `THRESHOLDS`); NaN where one is NaN, zero where there is none."""
        values = [check.value for check in self.checks if check.name in names]
        return float(np.max(values)) if values else 0.0

    def as_dict(self) -> dict:
        """The result for machines: the largest values by kind, and every check."""
        return {
            "max_disagreement": self.largest("reductions", "forms", "Newton"),
            "virtual_power": self.largest("virtual power"),
            "energy_balance": self.largest("energy", "potentials"),
            "gradient_error": self.largest("jvp against vjp", "differences", "derivatives"),
            "passed": self.passed,
            "certifies": self.certifies,
            "not_applicable": list(self.not_applicable),
            "checks": [check.as_dict() for check in self.checks],
        }

    def _text(self) -> str:
        lines = [f"Verification of {self.scene}: {'passed' if self.passed else 'FAILED'}"]
        for check in self.checks:
            verdict = "ok" if check.passed else f"FAILED, look at {check.culprit}"
            lines.append(f"  {check.name:<16} {check.value:9.1e}  (at most {check.threshold:.0e})  {verdict}" + (f"; {check.note}" if check.note else ""))
        if not self.certifies:
            lines.append("  single precision: gross errors show, but passing certifies nothing; verify in double precision (JAX_ENABLE_X64=1)")
        if self.not_applicable:
            lines.append("  not applicable at this state: " + ", ".join(self.not_applicable))
        return "\n".join(lines)
