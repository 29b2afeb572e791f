"""Commands about bicycles: `bicycle FILE...` and `demo`."""

import json
import os
import re
import sys
from pathlib import Path

from jourdain_jax.bicycle.job import Refused, Study, run, table, write_results
from jourdain_jax.bicycle.parameter_files import shipped_bicycles, shipped_measurements
from jourdain_jax.views.bicycle_figures import animate_ride, draw_eigenvalues, draw_rides

DEMO = "Rigid"  # a measured bicycle with all standard errors and a stable speed range


def add(verbs) -> None:
    """Add the verbs to the parser."""
    job = verbs.add_parser(
        "bicycle", help="stability speeds of measured bicycles with uncertainties, and simulated rides"
    )
    job.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help=(
            "parameter files (NAME = VALUE+/-SIGMA), raw measurements "
            "(*Measured.txt), or names of shipped bicycles"
        ),
    )
    _options(job, "bicycle-results")
    job.set_defaults(run=_job)

    demo = verbs.add_parser("demo", help=f"run `bicycle` for a shipped bicycle ({DEMO})")
    _options(demo, "demo-results")
    demo.set_defaults(run=_job, files=[str(shipped_bicycles()[DEMO])])


def _options(parser, folder: str) -> None:
    parser.add_argument("--out", default=folder, help=f"folder for tables and figures (default: {folder})")
    parser.add_argument(
        "--samples", type=int, default=2000, help="number of Monte Carlo samples (default 2000)"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed of the Monte Carlo (default 0)")
    parser.add_argument("--no-figures", action="store_true", help="numbers only")
    parser.add_argument("--json", action="store_true", help="print result.json instead of the table")


def _job(options) -> bool:
    if options.samples < 1:
        raise ValueError(f"--samples is {options.samples}, expected at least 1")
    shipped = shipped_bicycles() | {path.stem: path for path in shipped_measurements().values()}
    paths = [name if os.path.exists(name) else shipped.get(name, name) for name in options.files]
    out = Path(options.out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"cannot create the folder `{out}`: {error.strerror}; choose another with --out"
        ) from None
    studies = run(
        paths, samples=options.samples, seed=options.seed, progress=lambda text: print(text, file=sys.stderr)
    )
    write_results(studies, out / "result.json")
    written = [out / "result.json"]
    good = [one for one in studies if isinstance(one, Study)]
    if not options.no_figures:
        for one, prefix in zip(good, prefixes([one.bicycle.name for one in good]), strict=True):
            written += _figures(one, out, prefix)
    print(json.dumps([one.as_dict() for one in studies], indent=2) if options.json else table(studies))
    print("wrote " + ", ".join(str(path) for path in written), file=sys.stderr)
    return not any(isinstance(one, Refused) for one in studies)


def prefixes(names: list[str]) -> list[str]:
    """Return prefixes of figure files, numbered if bicycle names repeat; empty for one bicycle."""
    plain = [re.sub(r"[^\w.-]", "_", name) for name in names]
    if len(names) < 2:
        return [""] * len(names)
    return [
        f"{name}-{number}-" if (number := plain[: k + 1].count(name)) > 1 else f"{name}-"
        for k, name in enumerate(plain)
    ]


def _figures(study: Study, out: Path, prefix: str) -> list[Path]:
    """Draw `eigenvalues.png`, `ride.png` and `ride.gif`; return their paths."""
    written = []
    for name, draw in (
        ("eigenvalues.png", draw_eigenvalues),
        ("ride.png", draw_rides),
        ("ride.gif", animate_ride),
    ):
        path = out / f"{prefix}{name}"
        draw(study, path)
        written.append(path)
    return written
