"""Work-precision charts: error against time for four problems, this engine's methods and its peers, each at
its best settings.

    taskset -c 0 python bench/work_precision.py [--quick] [--json FILE] [--out DIR] [--only NAME ...]
    python bench/work_precision.py --redraw FILE --out DIR

Writes a list of records (see `work_precision_cases/record.py`), among them how every reference was obtained
({"reference", ...}); pictures (PNG and SVG). The main chart is `work_precision.png`. Times are wall time of
the fastest of some warm runs. Peers that are not installed are skipped with a message. `--quick`: disc and
sleigh, fewer methods, under two minutes.
"""

import os
from functools import partial

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"

from figures import HERE, figure, main
from work_precision_cases import (
    batches,
    measure,
    ours,
    peer_c,
    peer_diffrax,
    peer_exudyn,
    peer_heyoka,
    peer_mujoco,
    peer_sympy,
)
from work_precision_cases.draw import draw
from work_precision_cases.problems import PROBLEMS, QUICK

say = partial(print, flush=True)


def curves(name, quick):
    """The reference and single trajectories of a problem."""
    problem = PROBLEMS[name]
    truth = problem.truth
    found = {"reference": name, "how": truth.how, "against": truth.against, "uncertainty": truth.uncertainty}
    yield figure("uncertainty of the reference", name, truth.uncertainty) | found
    for methods in (
        ours.curves(problem, quick),
        peer_sympy.curves(problem, quick),
        peer_c.curves(problem),
        peer_heyoka.curves(problem),
        peer_diffrax.curves(problem),
        peer_exudyn.curves(problem, quick),
        peer_mujoco.curves(problem, quick),
    ):
        for curve in methods:
            yield from measure.points(problem, curve, say)[0]


def batched(name, quick):
    """Batches of a problem."""
    yield from batches.measured(PROBLEMS[name], quick, say)


if __name__ == "__main__":
    parts = {f"curves, {name}": partial(curves, name) for name in PROBLEMS}
    parts |= {f"batches, {name}": partial(batched, name) for name in batches.PROBLEMS}
    in_short = [part for part in parts if part.split(", ")[1] in QUICK]
    main(__doc__, parts, quick=in_short, out=HERE / "results", drawn=draw)
