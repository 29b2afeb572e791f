"""Command `sweep`: run, inspect, resume and export a study described by a file.

model = "tilting-disc"                       # a name of `jourdain-jax models`
t1 = 2.0                                     # s
samples = 1000
sampler = "sobol"                            # optional

[set]                                        # parameters shared by all samples
mass = 1.0
[vary]                                       # normal, uniform, log-normal, log-uniform, levels, table
radius = { normal = [0.5, 0.01] }
[start]                                      # same for coordinates and speeds, or numbers
lean = { uniform = [-0.6, 0.6] }
spin_rate = -3.0
[outputs]                                    # end, largest, smallest, integral, event-time, ...; optional
"final lean" = { end = "lean", unit = "rad" }
fell = { happened = "fallen" }
[options]                                    # of `jj.rollout`
rtol = 1e-6
[correlation]
"radius lean" = 0.5

`seed`, `save`, `keep_every`, and the tables `set`, `options` and `correlation` are optional. A further
output is `largest-magnitude`.
"""

import json
import re
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

from jourdain_jax.calculus.files import check_depth, parsed, read_text, whole_number
from jourdain_jax.calculus.reals import described
from jourdain_jax.cli.model_verbs import plain
from jourdain_jax.models.registry import model
from jourdain_jax.motion.model import build
from jourdain_jax.motion.options import OPTION_NAMES, SPAN
from jourdain_jax.scene.coordinates import check_names, nearest
from jourdain_jax.studies.design import Levels, LogNormal, LogUniform, Normal, Uniform
from jourdain_jax.studies.outputs import (
    End,
    EventTime,
    Happened,
    Integral,
    Largest,
    LargestMagnitude,
    Smallest,
)
from jourdain_jax.studies.records import InUseError
from jourdain_jax.studies.result import LEVELS, StudyResult, load_study, merge_studies
from jourdain_jax.studies.study import REFUSED, Study

ACTIONS = ("status", "resume", "export", "merge")
VARYING: dict[str, Callable] = {
    "normal": Normal,
    "uniform": Uniform,
    "log-normal": LogNormal,
    "log-uniform": LogUniform,
}
OUTPUTS: dict[str, Callable] = {
    re.sub("(?<=.)(?=[A-Z])", "-", kind.__name__).lower(): kind
    for kind in (End, Largest, Smallest, LargestMagnitude, Integral, EventTime, Happened)
}
TABLES = ("set", "vary", "start", "outputs", "options", "correlation")
KEYS = ("model", "t1", "samples", "sampler", "seed", "save", "keep_every", "chunk", *TABLES)


def add(verbs) -> None:
    """Add the verb to the parser."""
    sweep = verbs.add_parser(
        "sweep", help="run a study described by a TOML file, or `sweep status|resume|export|merge FOLDER`"
    )
    sweep.add_argument(
        "words",
        nargs="+",
        metavar="FILE | ACTION FOLDER",
        help="TOML file, or one of " + ", ".join(ACTIONS) + ", followed by folders of studies",
    )
    sweep.add_argument(
        "--out", help="folder of the study (created or continued); for `export`, the .nc file to write"
    )
    sweep.add_argument("--workers", type=int, default=1, help="number of worker processes (default 1)")
    sweep.add_argument("--memory", help="total memory, such as 2GB")
    sweep.add_argument(
        "--shard",
        default="1/1",
        metavar="K/N",
        help="compute only the K-th of N shares; join them with `sweep merge`",
    )
    sweep.add_argument("--quiet", action="store_true", help="no bar")
    sweep.add_argument("--json", action="store_true", help="machine-readable")
    sweep.set_defaults(run=_sweep)


def _sweep(options) -> bool:
    action, *paths = options.words
    if action not in ACTIONS:
        if paths:
            raise ValueError(
                f"`{action}` is not an action of `sweep`; {nearest(action, ACTIONS)} To run a "
                "study: jourdain-jax sweep FILE.toml --out FOLDER"
            )
        # limit of the file size in bytes; tables may have one row per sample
        text = read_text(action, 100_000_000, f"a TOML file of a study, or one of {', '.join(ACTIONS)}")
        return _run(text, action, options.out or str(Path(action).with_suffix(".zarr")), options)
    if not paths or (action != "merge" and len(paths) > 1):
        raise ValueError(
            f"`sweep {action}` takes {'folders' if action == 'merge' else 'one folder'} of a study"
        )
    if action == "resume":
        text = load_study(paths[0]).store.study["command"]
        if not text:
            raise ValueError(f"`{paths[0]}` was started from Python; run that program again to continue")
        return _run(text, f"{paths[0]}/run/study.json", paths[0], options)
    found = merge_studies(paths[0], paths[1:]) if action == "merge" else load_study(paths[0])
    if action == "export":
        return _export(found, options)
    _show(found, options)
    return found.complete


def _run(text: str, source: str, out: str, options) -> bool:
    asked = parsed(tomllib.loads, text, source, "valid TOML")
    check_depth(
        asked, lambda x: x.values() if isinstance(x, dict) else x if isinstance(x, list) else (), source
    )
    study, how = described_study(asked, options.memory)
    try:
        asked_here = {
            "processes": options.workers,
            "shard": _shard(options.shard),
            "progress": not options.quiet,
        }
        found = study.run(out, command=text, **asked_here, **how)
    except KeyboardInterrupt as stopped:
        print(
            f"jourdain-jax: {stopped or 'interrupted'}; or: jourdain-jax sweep resume {out}", file=sys.stderr
        )
        return False
    except (RuntimeError, MemoryError) as error:
        if isinstance(error, InUseError):
            raise
        print(f"jourdain-jax: {error}", file=sys.stderr)
        return False
    _show(found, options)
    first, every = asked_here["shard"]
    return not found.failed.size and not {*range(first - 1, found.store.chunks, every)}.difference(
        found.store.receipts()
    )


def described_study(asked: Mapping, memory: str | None = None) -> tuple[Study, dict]:
    """Return the study described by a file, and the arguments of its `run`. `memory` bounds the memory of the
    study.
    """
    check_names(asked, KEYS, "the file has an entry `{}`")
    for key in asked:
        if key in TABLES and not isinstance(asked[key], Mapping):
            raise ValueError(
                f"`{key}` is {described(asked[key])}, expected a table: a line [{key}] with entries below it"
            )
    known_options = [name for name in (*SPAN, *OPTION_NAMES) if name not in REFUSED and name not in asked]
    check_names(asked.get("options", {}), known_options, "`{}` is not an entry of [options]")
    if "model" not in asked:
        raise ValueError("the file has no `model`; write, for example, model = 'tilting-disc'")
    scene = model(asked["model"], **asked.get("set", {}))
    vary = {name: _varying(name, how) for name, how in asked.get("vary", {}).items()}
    start = asked.get("start") and {
        name: _varying(name, how) if isinstance(how, Mapping) else how for name, how in asked["start"].items()
    }
    correlation = {tuple(pair.split()): value for pair, value in asked.get("correlation", {}).items()}
    known = {name: asked[name] for name in ("sampler", "samples", "seed") if name in asked}
    outputs = asked.get("outputs") and {name: _output(name, how) for name, how in asked["outputs"].items()}
    how = {name: asked[name] for name in ("t1", "save", "keep_every", "chunk") if name in asked} | asked.get(
        "options", {}
    )
    scene = scene if memory is None else build(scene, memory=memory)
    return Study(scene, vary=vary, start=start, correlation=correlation or None, **known), how | {
        "outputs": outputs
    }


def _varying(name: str, how):
    kinds = (*VARYING, "levels", "table")
    if not isinstance(how, Mapping) or len(how) != 1:
        raise ValueError(
            f"the distribution of `{name}` is {described(how)}; write, for example, "
            f"{name} = {{ normal = [1.0, 0.1] }}"
        )
    ((kind, numbers),) = how.items()
    if kind not in kinds or not isinstance(numbers, list):
        raise ValueError(
            f"`{name}` has the distribution {kind} = {numbers}, expected a distribution and its numbers, "
            f"as in normal = [1.0, 0.1]; {nearest(kind, kinds)}"
        )
    if kind not in VARYING:
        return Levels(numbers) if kind == "levels" else numbers
    if len(numbers) != 2:
        raise ValueError(f"`{name}`: `{kind}` has {len(numbers)} numbers, expected 2")
    return VARYING[kind](*numbers)


def _output(name: str, how):
    stated = dict(how) if isinstance(how, Mapping) else {}
    unit = stated.pop("unit", "")
    if len(stated) != 1 or (kind := OUTPUTS.get(*stated)) is None:
        raise ValueError(
            f"output `{name}` is {described(how)}; write, for example, {{ end = 'lean', unit = "
            f"'rad' }}; {nearest(str([*stated][:1]), OUTPUTS)}"
        )
    return kind(*stated.values(), *(() if kind in (EventTime, Happened) else (unit,)))


def _shard(text: str) -> tuple[int, int]:
    k, slash, n = text.partition("/")
    if not slash:
        raise ValueError(f"--shard is `{text}`, expected K/N, such as 1/4")
    count = whole_number(n, "N of --shard K/N", 2**24)
    return whole_number(k, "K of --shard K/N", count), count


def _export(found: StudyResult, options) -> bool:
    out = options.out or str(found.store.path.with_suffix(".nc"))
    if Path(out).suffix != ".nc":
        raise ValueError(f"cannot export to `{out}`: the name must end in .nc")
    found.to_netcdf(out)
    print(f"wrote {out}")
    return True


def _show(found: StudyResult, options) -> None:
    if not options.json:
        print(found)
        return
    outputs = {
        name: {
            "lanes": found.statistics.lanes[i, i],
            "mean": found.mean(name),
            "deviation": found.deviation(name),
            "quantiles": {str(level): found.quantile(name, level) for level in LEVELS},
        }
        for i, name in enumerate(found.outputs if found.counts else ())
    }
    about = {
        "folder": str(found.store.path),
        "lanes": len(found),
        "complete": found.complete,
        "counts": found.counts,
        "failed": found.failed,
    }
    print(json.dumps(plain(about | {"outputs": outputs}), indent=2))
