"""A search for motions that are wrong and do not say so: generated scenes and uses against references that
share nothing with the engine.

    python bench/hunt.py [--quick] [--json FILE] [--cases N] [--seed S] [--jobs N]
    python bench/hunt.py --only NAME [--seed N]             # one family; with a seed, that case alone

Every case is drawn by a seed. Outcomes: right; flagged by its result code; flagged by `motion.warnings`;
refused with an error of the engine's own; wrong in silence; crashed with a raw error. Wrong and crashed ones
are printed with what repeats them alone. The JSON is a list of {"figure", "model", "value", "required",
"met"}; `--records FILE` writes every case. float32 runs in processes of its own: JAX chooses once.
"""

import argparse
import json
import sys
import time
from collections import Counter
from concurrent.futures import as_completed
from pathlib import Path

from floats import TYPES, prepare, processes

CASES, QUICK = 2500, 300  # in all


def run_family(name, seeds):
    """Records of one family's cases, in this process."""
    import jax
    from hunting.families import family

    found = [record.as_dict() for record in family(name).run(seeds)]
    jax.clear_caches()
    return found


def planned(arguments):
    """Family, floats and seeds of every piece of work, longest first."""
    prepare("float64")
    from hunting.families import FAMILIES

    chosen = [f for f in FAMILIES if not arguments.only or f.name in arguments.only]
    if arguments.only and arguments.seed is not None and arguments.cases is None:
        return [(f.name, arguments.dtype, [arguments.seed]) for f in chosen]
    whole = sum(f.cases for f in FAMILIES)
    share = (arguments.cases or (QUICK if arguments.quick else CASES)) / whole
    first, work = arguments.seed or 0, []
    for f in chosen:
        count = max(1, round(share * f.cases))
        seeds = range(first, first + count)
        narrow = seeds[4::5] if f.single and not arguments.quick else ()
        work.append((f.name, "float64", [seed for seed in seeds if seed not in narrow]))
        work += [(f.name, "float32", [*narrow])] if narrow else []
    return sorted(work, key=lambda w: -len(w[2]))


def run_all(work, jobs, report):
    """Records of all; each kind of floats has processes of its own. `report(records so far, new ones)` after
    every family.
    """
    from hunting.record import CRASHED, Record

    found = []
    for dtype in TYPES:
        with processes(dtype, jobs) as pool:
            waiting = {pool.submit(run_family, w[0], w[2]): w for w in work if w[1] == dtype}
            for done in as_completed(waiting):
                name, _, seeds = waiting[done]
                try:
                    new = done.result()
                except Exception as error:  # the process died, or the family itself is broken
                    said = f"{type(error).__name__}: {error}"
                    new = [Record(name, seed, dtype, "", CRASHED, None, said).as_dict() for seed in seeds]
                counts, seconds = Counter(r["outcome"] for r in new), sum(r["seconds"] for r in new)
                print(f"{name} ({dtype}): {dict(counts)}, {seconds:.0f} s", file=sys.stderr, flush=True)
                found += new
                report(found, new)
    return found


def main():
    """Search, print, write; exit code 1 where something is wrong or crashed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} cases, float64")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--records", type=Path, help="file for the records of all cases")
    parser.add_argument(
        "--cases", type=int, help=f"about how many cases all families together have (default: {CASES})"
    )
    parser.add_argument(
        "--seed", type=int, help="first seed (default 0); with --only and without --cases, the only one"
    )
    parser.add_argument("--only", nargs="*", metavar="NAME", help="only these families")
    parser.add_argument("--dtype", choices=TYPES, default="float64", help="of a case that is run alone")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    begin = time.perf_counter()
    work = planned(arguments)
    from hunting.table import as_markdown, figures, losses

    print(f"seeds from {arguments.seed or 0}; {sum(len(w[2]) for w in work)} cases", file=sys.stderr)

    def report(records, new):
        print("".join(f"{line}\n" for line in losses(new)), end="", flush=True)
        if arguments.records:
            arguments.records.write_text(json.dumps(records, indent=1) + "\n")

    records = run_all(work, arguments.jobs, report)
    wall = time.perf_counter() - begin
    if arguments.json:
        arguments.json.write_text(json.dumps(list(figures(records, wall)), indent=1) + "\n")
    print("\n".join(as_markdown(records)))
    print(f"{len(records)} cases in {wall:.0f} s")
    return int(any(r["outcome"] in ("wrong", "crashed") for r in records))


if __name__ == "__main__":
    sys.exit(main())
