"""Every malformed input of the tables is answered with the right kind of error, or code, and with words that
say what to do.
"""

import jaxtyping
import malformed_calls
import malformed_fits
import malformed_inputs
import malformed_studies
import pytest

TABLES = (malformed_inputs, malformed_fits, malformed_studies, malformed_calls)
CASES = {code: (table, case) for table in TABLES for code, case in table.TABLE.items()}


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the cases of each table are written with. Run-time type checks, which users do not have, would
    answer first: they are off.
    """
    folder = tmp_path_factory.mktemp("malformed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        made: dict = {table: {} for table in TABLES}
        for table in TABLES:
            exec(table.PRELUDE, made[table])
        yield made
    refused = {"lanes.npz", "b.npz", "run.mp4", "run.gif", "run.xyz", "lane-0.gif", "nowhere", "x"}
    assert refused.isdisjoint(path.name for path in folder.iterdir()), "a refused file was written"


def test_no_case_stands_in_two_tables():
    assert len(CASES) == sum(len(table.TABLE) for table in TABLES) > 400


@pytest.mark.parametrize("code", CASES)
def test_malformed_input_is_named_with_what_is_expected(code, names):
    table, case = CASES[code]
    kind, words = ("ValueError", case) if isinstance(case, str) else case
    try:
        answer = eval(code, names[table])
        kinds, text = (
            answer
            if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], str)
            else ("accepted", repr(answer)[:200])
        )
    except Exception as error:
        kinds, text = (
            "/".join(kind.__name__ for kind in type(error).__mro__),
            str(error),
        )  # a kind of ValueError is one
    assert all(part in text for part in words.split(" ... ")), text
    assert kind in kinds.split("/"), text
