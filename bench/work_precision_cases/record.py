"""What one measurement is: a flat record, the same keys for ours and peers."""

import platform
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version

from figures import figure

OURS, PEER = KINDS = ("ours", "peer")


def versions(*names):
    """Versions of the packages that took part and are installed, Python's among them."""
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


@dataclass(frozen=True, kw_only=True)
class Record:
    """One measurement."""

    problem: str
    method: str
    kind: str
    setting: float  # a tolerance (absolute and relative) or a step in s, as `setting_unit` says
    setting_unit: str
    batch: int  # trajectories computed together
    # the largest over the final quantities compared, absolute in SI units; None where the run failed
    error: float | None
    seconds: float  # wall time per trajectory, warm
    steps: float | None = None  # per trajectory; None where they are not counted
    note: str = ""
    versions: dict


KEYS = (*figure("", "", None), *(field.name for field in fields(Record)))


def record(**values):
    """A measurement as JSON holds it."""
    if values["kind"] not in KINDS:
        raise ValueError(f"`kind` is {values['kind']!r}, expected one of {KINDS}")
    found = {key: None if value != value else value for key, value in asdict(Record(**values)).items()}
    name = "error, {method}, {setting:g} {setting_unit}, {batch} at once".format(**found)
    return figure(name, found["problem"], found["error"]) | found
