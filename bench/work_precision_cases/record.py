"""What one measurement is: a flat record, the same keys for ours, peers and gradients."""

import platform
from importlib.metadata import PackageNotFoundError, version

KEYS = (
    "problem", "method", "kind", "setting", "setting_unit", "batch", "error", "seconds", "rhs_evaluations", "steps", "energy_drift", "slip", "note", "versions",
)  # fmt: skip
OURS, PEER = "ours", "peer"
KINDS = (OURS, PEER)
PACKAGES = ("jourdain-jax", "jax", "jaxlib", "diffrax", "numpy", "scipy", "sympy", "heyoka", "mujoco", "mujoco-mjx", "exudyn")


def versions(*names: str) -> dict[str, str]:
    """Versions of the packages that took part, Python's among them; of all that are installed, if none is named."""
    found = {"python": platform.python_version()}
    for name in names or PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def record(
    *,
    problem: str,
    method: str,
    kind: str,
    setting: float | None,
    setting_unit: str,
    batch: int,
    error: float | None,
    seconds: float | None,
    rhs_evaluations: float | None = None,
    steps: float | None = None,
    energy_drift: float | None = None,
    slip: float | None = None,
    note: str = "",
    versions: dict[str, str],
) -> dict:
    """One measurement.

    **Arguments:** `setting`, a tolerance (absolute and relative) or a step in s, as `setting_unit` says; `batch`, trajectories computed together;
    `error`, the largest over the final quantities compared, absolute in SI units, None where the run failed; `seconds`, wall time per trajectory,
    warm; `rhs_evaluations` and `steps` per trajectory, None where they are not counted; `energy_drift`, |E(end) - E(start)|, relative to |E(start)|,
    None where energy is not conserved; `slip`, the largest velocity that a rolling or blade row forbids, at the end, m/s.
    """
    if kind not in KINDS:
        raise ValueError(f"`kind` is {kind!r}, expected one of {KINDS}")
    entry = {
        "problem": problem, "method": method, "kind": kind, "setting": setting, "setting_unit": setting_unit, "batch": batch, "error": error,
        "seconds": seconds, "rhs_evaluations": rhs_evaluations, "steps": steps, "energy_drift": energy_drift, "slip": slip, "note": note, "versions": versions,
    }  # fmt: skip
    return {key: None if isinstance(value, float) and value != value else value for key, value in entry.items()}
