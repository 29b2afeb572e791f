"""What cases of malformed input are answered with: kinds of errors, or codes, and words."""

import json
import sys


def answers(tables: list) -> dict:
    """The answer to every case of tables, each a prelude and codes to be evaluated after it: the kinds of an error or a code, and a text."""
    found = {}
    for prelude, codes in tables:
        names: dict = {}
        exec(prelude, names)
        for code in codes:
            try:
                answer = eval(code, names)
                found[code] = answer if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], str) else ("accepted", repr(answer)[:200])
            except Exception as error:
                found[code] = ("/".join(kind.__name__ for kind in type(error).__mro__), str(error))  # a kind of ValueError is one
    return found


if __name__ == "__main__":
    from jourdain_jax.native import host

    host.EFFORT = 0  # of LLVM, as in the other tests
    print("ANSWERS", json.dumps(answers(json.load(sys.stdin))))
