"""Results of `verify`: checks, each with its value, threshold and culprit, and a table of them."""

from typing import Any

import equinox as eqx
import numpy as np

from jourdain_jax.calculus.reals import static
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.printing import Printed

# in double and in single precision, relative to the size of the compared quantities
THRESHOLDS = {
    "inertia": (1e-10, 1e-5),
    "potentials": (1e-10, 1e-4),
    "derivatives": (1e-6, 1e-2),
    "reductions": (1e-10, 1e-4),
    "forms": (1e-10, 1e-4),
    "virtual power": (1e-10, 1e-4),
    "Newton": (1e-10, 1e-4),
    "energy": (1e-9, 1e-4),
    "jvp against vjp": (1e-11, 1e-4),
    "differences": (1e-6, 2e-2),
}


class Check(eqx.Module):
    """One check: the relative difference found, its threshold and the culprit."""

    name: str = static()
    value: float
    threshold: float
    culprit: str = static()  # body, load, constraint, form or reduction with the largest value
    note: str = static(default="")

    @property
    def passed(self) -> bool:
        """Return whether the value is within its threshold."""
        return bool(self.value <= self.threshold)

    def as_dict(self) -> "dict[str, Any]":
        """Return the check as plain data; a value that is not finite is None."""
        value = float(self.value) if np.isfinite(self.value) else None
        return vars(self) | {"value": value, "passed": self.passed}


def check(name: str, values: dict, dtype, note: str = "") -> Check:
    """Return the check `name` (a key of `THRESHOLDS`) from one value per subject. `culprit` is the subject
    with the largest value; NaN counts as larger than any number.
    """
    threshold = THRESHOLDS[name][np.dtype(dtype).name == "float32"]
    if not values:
        return Check(name, 0.0, threshold, "nothing", note)
    sizes = {suspect: float(value) for suspect, value in values.items()}
    culprit = max(sizes, key=lambda suspect: np.inf if np.isnan(sizes[suspect]) else sizes[suspect])
    return Check(name, sizes[culprit], threshold, culprit, note)


class Verification(Printed, eqx.Module):
    """All checks at one state; `print` shows them as a table."""

    scene: str = static()
    checks: tuple[Check, ...]
    not_applicable: Labels = static()  # reductions that do not apply at this state
    mistakes: str = static(default="")  # the table of `jj.check`

    @property
    def certifies(self) -> bool:
        """Return whether passing proves agreement to round-off in double precision. In single precision, only
        gross errors are detected.
        """
        return all(check.threshold <= THRESHOLDS[check.name][0] for check in self.checks)

    @property
    def passed(self) -> bool:
        """Return whether every check passed."""
        return all(check.passed for check in self.checks)

    def largest(self, *names: str) -> float:
        """Return the largest value of the checks `names` (keys of `THRESHOLDS`); NaN if one is NaN, zero if
        there are none.
        """
        values = [check.value for check in self.checks if check.name in names]
        return float(np.max(values)) if values else 0.0

    def as_dict(self) -> "dict[str, Any]":
        """Return the result as plain data: the largest value of each kind, and all checks."""
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
            lines.append(
                f"  {check.name:<16} {check.value:9.1e}  (at most {check.threshold:.0e})  {verdict}"
                + (f"; {check.note}" if check.note else "")
            )
        if not self.certifies:
            lines.append(
                "  single precision: gross errors show, but passing certifies nothing; verify in "
                "double precision (JAX_ENABLE_X64=1)"
            )
        if self.not_applicable:
            lines.append("  not applicable at this state: " + ", ".join(self.not_applicable))
        return "\n".join([*lines, self.mistakes]).rstrip()
