"""Why a method fails, in one line: the reason of its case, for it or for its group, or else its usual one, as
`mechanisms.toml` has them.
"""

import tomllib
from pathlib import Path

from atlas_cases.case import Case
from atlas_cases.methods import Method
from atlas_cases.outcomes import FLAGGED, NOT_APPLICABLE, RIGHT, Outcome

USUAL: dict = {}
BY_CASE: dict[str, dict] = {}  # of a case, or of all cases of one number
for reason in tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))["reason"]:
    found = dict.fromkeys(reason["methods"], reason["why"])
    for case in reason.get("cases", ()):
        BY_CASE[case] = BY_CASE.get(case, {}) | found
    USUAL |= {} if "cases" in reason else found


def mechanism(case: Case, method: Method, outcome: Outcome):
    """One line: why it failed, and what it said itself."""
    if outcome.outcome == RIGHT:
        return ""
    if outcome.outcome == NOT_APPLICABLE:
        return outcome.flag
    if case.flag_is_right and outcome.outcome == FLAGGED:
        return f"{case.reason} [{outcome.flag}]"
    here = BY_CASE.get(case.name, BY_CASE.get(case.name.split()[0], {}))
    own = next((here[key] for key in (method.name, method.group) if key in here), USUAL[method.name])
    return f"{own} [{outcome.flag}]" if outcome.flag else own
