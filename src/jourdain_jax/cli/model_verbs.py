"""Commands about models: `models`, `report`, `verify`, `simulate`."""

import json
from collections.abc import Mapping

import numpy as np

from jourdain_jax.analysis.report import report
from jourdain_jax.analysis.verify import verify
from jourdain_jax.calculus.files import check_place, number
from jourdain_jax.equations.rows import names_of_events
from jourdain_jax.integrate.result_codes import EVENT, FALLBACKS, SUCCESS
from jourdain_jax.models.registry import MODELS, counts_of, known_model, model
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.start import start
from jourdain_jax.motion.trajectories.diagnostics import diagnose
from jourdain_jax.motion.trajectories.storage import save
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.coordinates import parameters_of
from jourdain_jax.scene.scene import Scene
from jourdain_jax.views.pictures import animate, check_suffix
from jourdain_jax.views.quantities import check_format, plot


def add(verbs) -> None:
    """Add the verbs to the parser."""
    listing = verbs.add_parser(
        "models", help="list the models, or describe one: parameters, coordinates, speeds, example start"
    )
    listing.add_argument("model", nargs="?", help="model to describe (default: list all)")
    listing.add_argument("--json", action="store_true", help="print JSON")
    listing.set_defaults(run=_models)

    about = verbs.add_parser(
        "report", help="degrees of freedom, constraints, integrability, cyclic coordinates"
    )
    _model_options(about)
    about.set_defaults(run=_report)

    checking = verbs.add_parser("verify", help="cross-check a model's equations")
    _model_options(checking)
    _start_options(checking)
    checking.set_defaults(run=_verify)

    running = verbs.add_parser("simulate", help="integrate a model's motion")
    _model_options(running)
    _start_options(running)
    running.add_argument("--t1", type=float, help="end time in s (default: the model's example)")
    running.add_argument("--samples", type=int, default=201, help="number of saved times (default 201)")
    running.add_argument("--rtol", type=float, default=1e-8, help="relative tolerance (default 1e-8)")
    running.add_argument("--atol", type=float, default=1e-8, help="absolute tolerance (default 1e-8)")
    running.add_argument("--out", help="write the trajectory to this file (.npz)")
    running.add_argument(
        "--plot", metavar="FILE", help="write a plot of all coordinates to this file (.png, .svg, .pdf)"
    )
    running.add_argument(
        "--animate", metavar="FILE", help="write an animation (.gif) or one picture (.png) to this file"
    )
    running.set_defaults(run=_simulate)


def _model_options(parser) -> None:
    parser.add_argument("model", help="model name, see `jourdain-jax models`")
    about = "parameters (see `jourdain-jax models MODEL`) and counts such as links=7"
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=about)
    parser.add_argument("--json", action="store_true", help="machine-readable")


def _start_options(parser) -> None:
    about = (
        "initial coordinates and speeds; others start at zero and are projected onto the constraints"
        " (default: the model's example)"
    )
    parser.add_argument("--start", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=about)


def _pairs(words: list[str], what: str) -> dict[str, float]:
    values = {}
    for word in words:
        name, _, text = word.partition("=")
        advice = f"; write NAME=VALUE with a number, for example {what} mass=2.5"
        values[name] = number(text, f"{what} `{word}`: the value", finite=False, advice=advice)
    return values


def _scene(options) -> Scene:
    values = _pairs(options.set, "--set")
    kind = known_model(options.model)
    for name in counts_of(kind):
        if name in values:
            if not values[name].is_integer():
                raise ValueError(
                    f"--set {name}={values[name]:g}: `{name}` of `{options.model}` is a "
                    "count, expected a whole number"
                )
            values[name] = int(values[name])
    return model(options.model, **values)


def _state(scene: Scene, options):
    return start(scene, **(_pairs(options.start, "--start") or scene.example))


def _models(options) -> bool:
    if options.model is not None:
        known_model(options.model)
    rows = [_model_row(name) for name in MODELS if options.model in (None, name)]
    if options.json:
        print(json.dumps(rows, indent=2))
    elif options.model is not None:
        print(_description(rows[0]))
    else:
        width = max(map(len, MODELS))
        print("\n".join(f"{row['name']:<{width}}  {row['about']}" for row in rows))
    return True


def _model_row(name: str) -> dict:
    scene = MODELS[name]()
    row = {
        "name": name,
        "about": (type(scene).__doc__ or "").strip().splitlines()[0],
        "coordinates": scene.coordinate_names.entries,
        "speeds": scene.speed_names.entries,
        "inputs": scene.inputs.entries,
        "parameters": {
            key: {"value": value, "unit": meta["unit"]} for key, value, meta in parameters_of(scene)
        },
        "counts": {key: {"value": getattr(scene, key)} for key in counts_of(type(scene))},
        "events": names_of_events(scene),
        **{key: getattr(scene, key) for key in ("domain", "example", "example_span", "conventions")},
    }
    return plain(row)


def _description(row: dict) -> str:
    """Return the printed description of a model."""
    values = {
        key: f"{key}={entry['value']:g} {entry['unit'] or ''}".strip()
        for key, entry in row["parameters"].items()
    }
    lines = {
        "parameters (--set)": ", ".join(
            [*values.values(), *(f"{key}={entry['value']}" for key, entry in row["counts"].items())]
        ),
        "coordinates (--start)": ", ".join(row["coordinates"]),
        "speeds (--start)": ", ".join(row["speeds"]),
        "inputs": ", ".join(row["inputs"]),
        "stop events": ", ".join(row["events"]),
        "example": (
            ", ".join(f"{key}={value:g}" for key, value in row["example"].items())
            + f"; {row['example_span']:g} s"
        ),
        "conventions": row["conventions"],
    }
    return "\n".join(
        [f"{row['name']}: {row['about']}", *(f"  {key:<22} {text}" for key, text in lines.items() if text)]
    )


def _report(options) -> bool:
    _show(report(_scene(options)), options)
    return True


def _verify(options) -> bool:
    scene = _scene(options)
    found = verify(scene, _state(scene, options))
    _show(found, options)
    return bool(found.passed)


def _show(found, options) -> None:
    print(json.dumps({"model": options.model, **found.as_dict()}, indent=2) if options.json else found)


def _simulate(options) -> bool:
    scene = _scene(options)
    t1 = scene.example_span if options.t1 is None else options.t1
    if options.samples < 2:
        raise ValueError(f"--samples is {options.samples}, expected at least 2")
    if not np.isfinite(t1) or t1 == 0:
        raise ValueError(f"--t1 is {t1:g}, expected a finite time in s other than zero")
    _check_files(options)
    trajectory = simulate(
        scene,
        _state(scene, options),
        ts=np.linspace(0.0, t1, options.samples),
        rtol=options.rtol,
        atol=options.atol,
    )
    if options.out:
        save(trajectory, options.out)
    if options.plot:
        plot(trajectory, *scene.coordinate_names, path=options.plot)
    if options.animate:
        animate(trajectory, options.animate)
    print(json.dumps(_motion_row(options.model, trajectory), indent=2) if options.json else trajectory)
    written = [path for path in (options.out, options.plot, options.animate) if path]
    if written and not options.json:
        print("wrote " + ", ".join(written))
    return int(trajectory.result) in (SUCCESS, EVENT)


def _check_files(options) -> None:
    """Check before the run that the output files can be written."""
    for check, path in (
        (check_place, options.out),
        (check_format, options.plot),
        (check_suffix, options.animate),
    ):
        if path:
            check(path)


def _motion_row(name: str, trajectory: Trajectory) -> dict:
    found, scene = diagnose(trajectory), trajectory.scene
    names = (*scene.coordinate_names, *scene.speed_names)
    # friction_needed: null where infinite
    of_contact = ("lowest_normal", "highest_normal", "friction_needed", "pulls", "determined")
    contacts = {
        key: {what: getattr(contact, what) for what in of_contact} for key, contact in found.contacts.items()
    }
    row = {
        "model": name,
        "result": trajectory.result,
        "message": trajectory.message,
        "t_end": trajectory.t_end,
        "warnings": trajectory.warnings,
        "fallback": FALLBACKS[int(trajectory.fallback)],
        "state": trajectory.state_form,
        "steps_accepted": trajectory.accepted,
        "steps_rejected": trajectory.rejected,
        **{key: getattr(found, key) for key in vars(found) if key not in ("energy_size", "contacts")},
        "start_moved": {"coordinates": trajectory.moved_q, "speeds": trajectory.moved_u},
        "contacts": contacts,
        "final": dict(zip(names, (*trajectory.q_end, *trajectory.u_end), strict=True)),
    }
    return {key: plain(value) for key, value in row.items()}


def plain(x):
    """Convert to JSON values; non-finite numbers become null."""
    if isinstance(x, Mapping):
        return {key: plain(value) for key, value in x.items()}
    if isinstance(x, tuple | list):
        return [plain(value) for value in x]
    found = x if isinstance(x, str) else np.asarray(x).tolist()
    return None if isinstance(found, float) and not np.isfinite(found) else found
