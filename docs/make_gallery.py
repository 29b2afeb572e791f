"""Writes the pages of the gallery: one for every scene of `docs/gallery/scenes` and every model of
`jj.models.MODELS`, and their index.

    python docs/make_gallery.py [--out DIR] [--processes N] [NAME ...]

A page shows a picture, the lines that draw it (they are what this script runs), what to look at, and the
source. Pages are MyST Markdown for Sphinx with sphinx-design; nothing is fetched.
Without names all pages are written (about 80 s by two processes), with names those alone; the index lists all
pages of the folder.
"""

import argparse
import contextlib
import importlib
import inspect
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

# a page runs once: less effort on machine code saves a third of the time
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import jourdain_jax as jj

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "docs" / "gallery" / "scenes"
PAGES = ROOT / "docs" / "gallery" / "pages"
WIDTH = 112  # columns of code on a page
VIEWS = "extra/views"  # folder of the 3D views; Sphinx copies `extra` to the top of the site
VEHICLES, ROBOTS, TEXTBOOK, LINKAGES = GROUPS = ("Vehicles", "Robots", "Toys and textbook", "Linkages")


@dataclass(frozen=True)
class Picture:
    """How a motion is drawn, as pieces of the code on its page, and what to look at (scenes say the latter
    themselves, as `LOOK`).
    """

    look: str = ""
    title: str = ""
    view: str = '"space"'
    at: str = "3"
    paths: str = ""
    start: str = "**scene.example"
    span: str = "scene.example_span"
    inputs: str = ""
    group: str = TEXTBOOK  # on the index


SCENE_PICTURES = {
    "coin": Picture(
        title="Dropped coin", at="(0.0, 0.15, 0.4, 0.6)", span="0.6", paths='[("coin", (0.0, 0.0, 0.0))]'
    ),
    "robot_with_trailer": Picture(
        title="Robot with a trailer",
        view='"above"',
        start="left_rate=4.0, right_rate=6.0",
        span="6.0",
        paths='[("hull", (0, 0, 0)), ("trailer", (0, 0, 0))]',
        group=ROBOTS,
    ),
    "car_with_trailers": Picture(
        title="Car with Ackermann steering and trailers",
        view='"above"',
        paths='[("car", (-1.3, 0, 0)), ("trailer 2", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "tricycle": Picture(
        title="Tricycle",
        at="2",
        span="2.2",
        paths='[("front", (0, 0, 0)), ("left", (0, 0, 0)), ("right", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "kick_scooter": Picture(
        title="Kick scooter",
        view="(18, -60)",
        at="2",
        span="0.8",
        paths='[("rear frame", (0, 0, 0))]',
        inputs='{"push": lambda t: 150.0 * jnp.exp(-(((t - 0.3) / 0.1) ** 2))}',
        group=VEHICLES,
    ),
    "unicycle": Picture(
        title="Unicycle with a rider",
        at="4",
        span="1.6",
        paths='[("rider", (0, 0, 0)), ("wheel", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "ball_on_plate": Picture(
        title="Ball on a plate",
        at="1",
        view="(38, -60)",
        paths='[("ball", (0, 0, 0))]',
        inputs=(
            '{"wanted_x": lambda t: 0.12 * jnp.cos(1.5 * t), "wanted_y": lambda t: 0.12 * jnp.sin(1.5 * t)}'
        ),
        group=ROBOTS,
    ),
    "spherical_robot": Picture(
        title="Spherical robot driven by a pendulum",
        at="3",
        span="1.2",
        paths='[("shell", (0, 0, 0))]',
        inputs='{"drive": 0.2}',
        group=ROBOTS,
    ),
    "roller_racer": Picture(
        title="Roller racer",
        view='"above"',
        start="",
        span="6.0",
        paths='[("seat", (0, 0, 0))]',
        inputs='{"wanted": lambda t: 0.7 * jnp.sin(5.0 * t)}',
        group=VEHICLES,
    ),
    "two_wheeled_pendulum": Picture(
        title="Two-wheeled inverted pendulum",
        span="4.0",
        start="pitch=0.0",
        inputs='{"speed": 1.0, "turn": lambda t: 0.5 * jnp.sin(2.0 * t)}',
        group=ROBOTS,
    ),
    "satellite": Picture(
        title="Satellite with reaction wheels",
        at="1",
        view="(24, 40)",
        start="",
        span="2.0",
        paths='[("bus", (0.3, 0.25, 0.2))]',
        inputs=(
            '{"torque_x": lambda t: 1.0 * (t - 1.0), "torque_y": 0.3, "torque_z": lambda t: 0.5 * jnp.sin(t)}'
        ),
        group=ROBOTS,
    ),
}
AXLE = Picture(
    "All methods of the paper agree: the heading changes at a constant rate, and the axle drifts across the"
    " slope (x points downhill) instead of running down.",
    view='"above"',
    at="4",
    span="5.0",
    paths='[("wheel1", (0, 0, 0)), ("wheel2", (0, 0, 0))]',
)
BOTH = '[("first", (0, 0, 0)), ("second", (0, 0, 0))]'
MODEL_PICTURES = {
    "two-wheel-axle-free": AXLE,
    "two-wheel-axle-coordinates": AXLE,
    "two-wheel-axle-quasi": AXLE,
    "two-wheel-axle-redundant": AXLE,
    "skate": Picture(
        "A turning skate drifts across the slope (x points downhill) along a cycloid.",
        view='"above"',
        at="6",
        span="5.0",
    ),
    "chaplygin-sleigh": Picture(
        "It starts backwards, turns around, and ends up straight with the blade behind.",
        view='"above"',
        at="6",
    ),
    "vertical-disc": Picture(
        "Both rates are constant, and the path is a circle.",
        at="3",
        start="heading_rate=0.5, roll_rate=2.0",
        span="5.0",
    ),
    "tilting-disc": Picture(
        "The disc rolls along loops while lean and turn rate oscillate about a steady motion.",
        at="(0.0, 0.9, 1.8)",
        span="2.4",
    ),
    "tilting-disc-quaternion": Picture(
        "The same disc with a quaternion, which has no singularity where the disc lies flat.",
        at="(0.0, 0.9, 1.8)",
        span="2.4",
    ),
    "rosenberg-particle": Picture(
        "The constraint alone bends the path: y grows at a constant rate, and x slows down away from y = 0.",
        at="4",
    ),
    "heisenberg-particle": Picture(
        "A velocity constraint need not bend a path: this one is straight. Vakonomic equations give a helix.",
        at="4",
        span="4.0",
    ),
    "ball-on-turntable": Picture(
        "On a turning table the ball moves in a circle, like a charge in a magnetic field, at 2/7 of the"
        " table's rate.",
        at="4",
    ),
    "suslov": Picture(
        "From any start, the motion ends in a steady rotation about the second axis.",
        at="(3.0,)",
        span="8.0",
        paths='[("body", (1.0, 0.0, 0.0))]',
    ),
    "snakeboard": Picture(
        "The motion continues through the steer angle at which both constraints are parallel.",
        view='"above"',
        at="(0.0, 0.8, 1.6)",
        span="1.6",
        start="steer=0.1, x_rate=1.0, rotor_rate=0.4, steer_rate=0.3",
        paths='[("board", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "rattleback": Picture(
        "Spun in the wrong direction, the stone rattles and finally reverses its spin.",
        at="(0.05,)",
        span="0.5",
        view="(30, -60)",
        paths='[("stone", (0.2, 0, 0))]',
    ),
    "whipple-bicycle": Picture(
        "At 4.5 m/s the bicycle is stable by itself: lean turns the handlebar into the fall.",
        at="2",
        span="0.6",
        paths='[("rear wheel", (0, 0, 0)), ("front wheel", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "double-pendulum-rods": Picture(
        "The rods are geometric constraints; compare the pendulum in angles.",
        view='"side"',
        span="1.2",
        paths=BOTH,
        group=LINKAGES,
    ),
    "double-pendulum-angles": Picture(
        "The same pendulum in angles, without constraints.",
        view='"side"',
        span="1.2",
        paths=BOTH,
        group=LINKAGES,
    ),
    "free-rigid-body": Picture(
        "The end of an axis moves along a curve that need not close.",
        at="(8.0,)",
        span="8.0",
        paths='[("body", (1.0, 0.0, 0.0))]',
    ),
    "spring-and-rod": Picture(
        "A rod keeps two particles apart; a spring pulls the first towards the origin.",
        view='"side"',
        span="1.5",
        paths=BOTH,
        group=LINKAGES,
    ),
    "isokinetic-particle": Picture(
        "A constraint quadratic in the velocity keeps the speed constant while the path bends down.",
        view='"side"',
        at="5",
        span="0.6",
    ),
    "trailer-chain": Picture(
        "Each trailer follows on a smaller circle than the body ahead of it.",
        view='"above"',
        paths='[("car", (0, 0, 0)), ("trailer 3", (0, 0, 0))]',
        group=VEHICLES,
    ),
    "pendulum-chain": Picture(
        "Only rods hold the particles; without damping the energy is conserved.",
        view='"side"',
        span="1.0",
        paths='[("particle 5", (0, 0, 0))]',
        group=LINKAGES,
    ),
}

TITLES = {  # of models, where the name in the registry is no title
    "two-wheel-axle-free": "Two wheels on an axle, as free bodies",
    "two-wheel-axle-coordinates": "Two wheels on an axle, in seven coordinates",
    "two-wheel-axle-quasi": "Two wheels on an axle, in quasi-velocities",
    "two-wheel-axle-redundant": "Two wheels on an axle, with redundant constraints",
    "tilting-disc-quaternion": "Tilting disc as a free body",
    "rosenberg-particle": "Rosenberg's particle",
    "heisenberg-particle": "Heisenberg's system",
    "ball-on-turntable": "Ball on a turntable",
    "suslov": "Suslov's problem",
    "whipple-bicycle": "Whipple's bicycle",
    "double-pendulum-rods": "Double pendulum with rods as constraints",
    "double-pendulum-angles": "Double pendulum in angles",
    "trailer-chain": "Chain of trailers",
    "pendulum-chain": "Chain of pendulums",
}


@dataclass(frozen=True)
class Entry:
    """One page: what its scene is called in code, where it is written, and how it is drawn."""

    name: str  # of the page
    kind: type[jj.Scene]
    source: Path
    import_line: str
    made: str
    picture: Picture
    look: str

    @property
    def title(self) -> str:
        return self.picture.title or TITLES.get(self.name) or self.name.replace("-", " ").capitalize()


def entries() -> dict[str, Entry]:
    """Every page of the gallery by name: the scenes of this folder first, then the models."""
    if str(SCENES.parent) not in sys.path:
        sys.path.insert(0, str(SCENES.parent))
    found = {}
    for path in sorted(SCENES.glob("*.py")):
        module = importlib.import_module(f"scenes.{path.stem}")
        kind = next(
            k
            for k in vars(module).values()
            if isinstance(k, type) and issubclass(k, jj.Scene) and k.__module__ == module.__name__
        )
        name, picture = path.stem.replace("_", "-"), SCENE_PICTURES.get(path.stem, Picture())
        found[name] = Entry(
            name,
            kind,
            path,
            f"from scenes.{path.stem} import {kind.__name__}\n",
            f"{kind.__name__}()",
            picture,
            module.LOOK,
        )
    for name, kind in jj.models.MODELS.items():
        picture = MODEL_PICTURES.get(
            name, Picture(look=f"How {name.replace('-', ' ')} moves from its example start.")
        )
        source = ROOT / f"src/{kind.__module__.replace('.', '/')}.py"
        found[name] = Entry(name, kind, source, "", f"jj.models.{kind.__name__}()", picture, picture.look)
    return found


def code_of(entry: Entry) -> str:
    """The lines that draw the picture of a page, `NAME.png` in the working folder."""
    p = entry.picture
    inputs = f", inputs={p.inputs}" if p.inputs else ""
    start = f"jj.start(scene, {p.start})" if p.start else "jj.start(scene)"
    more = "".join(f",\n    {name}={value}" for name, value in (("paths", p.paths),) if value)
    call = f"motion = jj.simulate(scene, {start}, t1={p.span}{inputs})"
    if len(call) > WIDTH:
        call = f"motion = jj.simulate(\n    scene,\n    {start},\n    t1={p.span},\n   {inputs[1:]},\n)"
    lines = [
        "import jax.numpy as jnp\n\n" if "jnp." in inputs else "",
        "import jourdain_jax as jj\n",
        entry.import_line,
        f"\nscene = {entry.made}\n{call}\n",
        f'jj.animate(\n    motion,\n    "{entry.name}.png",\n    view={p.view},\n    at={p.at}{more},\n)',
    ]
    return "".join(lines)


def prose_of(docstring: str) -> str:
    """A docstring as Markdown: what is indented becomes a block of its own, stars and underscores stay what
    they are.
    """
    blocks = []
    for block in re.split(r"\n\s*\n", inspect.cleandoc(docstring)):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:
            parts = re.split(r"(`[^`]*`)", block)
            blocks.append(
                "".join(
                    part if part.startswith("`") else re.sub(r"([*_<$~\[\]])", r"\\\1", part)
                    for part in parts
                )
            )
    return "\n\n".join(blocks)


def page_of(entry: Entry, out: Path) -> str:
    """The text of a page."""
    link = Path(os.path.relpath(entry.source, out)).as_posix()
    shown = entry.source.relative_to(ROOT).as_posix()
    where = " in the folder `docs/gallery`" if entry.import_line else ""
    included = (
        f"\n## The scene\n\n```{{literalinclude}} {link}\n:language: python\n```\n"
        if entry.import_line
        else ""
    )
    told = "\n\n".join(filter(None, map(inspect.getdoc, (inspect.getmodule(entry.kind), entry.kind))))
    return f"""# {entry.title}

{prose_of(told)}

![{entry.title}: the motion, earlier times paler]({entry.name}.png)

**What to look at.** {entry.look}

```{{raw}} html
<iframe src="../../views/{entry.name}.html" title="{entry.title} in 3D" loading="lazy"
  style="width: 100%; height: 26em; border: 0"></iframe>
```

## The lines that draw it

Run{where}:

```python
{code_of(entry)}
```
{included}
Source: [{shown}]({link})
"""


def caption_of(entry: Entry) -> str:
    """What the scene is, in one line: the first sentence of the docstring of its class, or of its file where
    that has one scene.
    """
    told = inspect.getdoc(inspect.getmodule(entry.kind) if entry.source.parent == SCENES else entry.kind)
    return re.split(r"(?<=[.;])\s", " ".join(told.split("\n\n")[0].split()))[0].rstrip(".:;")


def index_of(chosen: list[Entry]) -> str:
    """Thumbnails of the chosen pages by group, and their table of contents."""
    sections = ""
    for group in GROUPS:
        cards = "\n".join(
            f":::{{grid-item-card}} {entry.title}\n:img-top: {entry.name}.png\n:link: {entry.name}\n"
            f":link-type: doc\n\n{caption_of(entry)}\n:::\n"
            for entry in chosen
            if entry.picture.group == group
        )
        if cards:
            sections += f"\n## {group}\n\n::::{{grid}} 1 2 3 3\n:gutter: 2\n\n{cards}\n::::\n"
    pages = "\n".join(entry.name for entry in chosen)
    return f"""# Gallery

Each page has a picture, a 3D view, the lines that draw the picture, and the source of the scene.
Earlier times are drawn paler; lengths are in metres.
A ball in a bowl, a robot with driven wheels and a disc on a hill stand, with their code, among the
[rolling contacts](../../contacts.md).
{sections}
```{{toctree}}
:hidden:
:maxdepth: 1

{pages}
```
"""


def write(entry: Entry, out: Path) -> Path:
    """Run the lines of a page in the folder `out`, and write the page beside its picture."""
    with contextlib.chdir(out):
        drawn: dict = {}
        exec(compile(code_of(entry), f"{entry.name}.md", "exec"), drawn)
        jj.show(drawn["motion"], f"{VIEWS}/{entry.name}.html", title=entry.title, forces=False)
    page = out / f"{entry.name}.md"
    page.write_text(page_of(entry, out))
    return page


def write_named(name: str, out: Path) -> str:
    """Write the page of this name; how long that took, as a line of text."""
    began = time.perf_counter(), time.process_time()
    write(entries()[name], out)
    return (
        f"{name}: {time.perf_counter() - began[0]:.1f} s, {time.process_time() - began[1]:.1f} s of processor"
        " time"
    )


def main(arguments: list[str] | None = None) -> None:
    """Write the pages that are asked for; exits with a message where a name is unknown."""
    parser = argparse.ArgumentParser(description="Write the pages of the gallery.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="pages (default: all)")
    parser.add_argument(
        "--out",
        type=Path,
        default=PAGES,
        metavar="DIR",
        help="folder to write to (default: docs/gallery/pages)",
    )
    parser.add_argument(
        "--processes",
        type=int,
        default=min(4, os.cpu_count() or 1),
        metavar="N",
        help="how many write at once (default: one per core, at most 4)",
    )
    asked = parser.parse_args(arguments)
    os.environ.setdefault("MPLBACKEND", "Agg")
    known = entries()
    names = [name.replace("_", "-") for name in asked.names] or list(known)
    for name in names:
        if name not in known:
            parser.error(f"no page `{name}`, expected some of: {', '.join(known)}")
    out = asked.out.resolve()
    (out / VIEWS).mkdir(parents=True, exist_ok=True)
    processes = min(asked.processes, len(names))
    if processes > 1:
        with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
            for line in pool.map(write_named, names, repeat(out)):
                print(line, flush=True)
    else:
        for name in names:
            print(write_named(name, out), flush=True)
    there = [entry for name, entry in known.items() if (out / f"{name}.md").exists()]
    (out / "index.md").write_text(index_of(there))


if __name__ == "__main__":
    main()
