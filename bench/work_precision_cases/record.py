"""What one measurement is: a flat record, the same keys for ours and peers."""

import platform
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version

OURS, PEER = "ours", "peer"
KINDS = (OURS, PEER)


def versions(*names: str) -> dict[str, str]:
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
    error: (
        float | None
    )  # the largest over the final quantities compared, absolute in SI units; None where the run failed
    seconds: float  # wall time per trajectory, warm
    steps: float | None = None  # per trajectory; None where they are not counted
    note: str = ""
    versions: dict[str, str]


FIGURE = ("figure", "model", "value", "required", "met")  # as in the other scripts: error, nothing required
KEYS = (*FIGURE, *(field.name for field in fields(Record)))


def record(**values) -> dict:
    """A measurement as JSON holds it."""
    if values["kind"] not in KINDS:
        raise ValueError(f"`kind` is {values['kind']!r}, expected one of {KINDS}")
    found = {
        key: None if isinstance(value, float) and value != value else value
        for key, value in asdict(Record(**values)).items()
    }
    name = "error, {method}, {setting:g} {setting_unit}, {batch} at once".format(**found)
    return dict(zip(FIGURE, (name, found["problem"], found["error"], None, True), strict=True)) | found
