"""Writes the pages of the gallery: one for every scene of `docs/gallery/scenes` and every model of `jj.models.MODELS`, and their index.

    python docs/make_gallery.py [--out DIR] [NAME ...]

A page shows a picture, the lines that draw it (they are what this script runs), what to look at, and the source. Pages are MyST Markdown for Sphinx with
sphinx-design; nothing is fetched. Without names all pages are written, with names those alone and an index of them. About 2 minutes on one core.
"""

import argparse
import contextlib
import importlib
import inspect
import os
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import jourdain_jax as jj

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "docs" / "gallery" / "scenes"
PAGES = ROOT / "docs" / "gallery" / "pages"


@dataclass(frozen=True)
class Picture:
    """How a motion is drawn, as pieces of the code on its page, and what to look at (scenes say the latter themselves, as `LOOK`)."""

    look: str = ""
    title: str = ""
    view: str = '"space"'
    at: str = "3"
    paths: str = ""
    start: str = "**scene.example"
    span: str = "scene.example_span"
    inputs: str = ""
    arguments: str = ""  # of the scene


SCENE_PICTURES = {
    "robot_with_trailer": Picture(title="Robot with a trailer", view='"above"', paths='[("hull", (0, 0, 0)), ("trailer", (0, 0, 0))]', span="6.0", at="(0.0, 2.0, 4.0, 6.0)"),
    "car_with_trailers": Picture(
        title="Car with Ackermann steering and trailers",
        view='"above"',
        at="(0.0, 4.0, 8.0)",
        paths='[("car", (-1.3, 0, 0)), ("trailer 2", (0, 0, 0))]',
    ),
    "tricycle": Picture(title="Tricycle", at="(0.0, 2.2)", span="2.2", paths='[("front", (0, 0, 0)), ("left", (0, 0, 0)), ("right", (0, 0, 0))]'),
    "kick_scooter": Picture(title="Kick scooter", at="(0.0, 0.8, 1.6)", inputs='{"push": lambda t: 120.0 * jnp.exp(-(((t - 0.3) / 0.15) ** 2))}'),
    "unicycle": Picture(title="Unicycle with a rider", at="5", span="2.0", paths='[("rider", (0, 0, 0))]'),
    "ball_on_plate": Picture(
        title="Ball on a plate",
        at="(1.1,)",
        view="(38, -60)",
        paths='[("ball", (0, 0, 0))]',
        inputs='{"roll_torque": lambda t: 0.3 * jnp.cos(6.0 * t), "pitch_torque": lambda t: 0.3 * jnp.sin(6.0 * t)}',
    ),
    "spherical_robot": Picture(title="Spherical robot driven by a pendulum", at="4", paths='[("shell", (0, 0, 0))]', inputs='{"drive": 0.05}'),
    "roller_racer": Picture(title="Roller racer", view='"above"', start="handlebar=0.0", at="(0.0, 3.0, 6.0)", inputs='{"swing": lambda t: 3.0 * jnp.cos(4.0 * t)}'),
    "two_wheeled_pendulum": Picture(
        title="Two-wheeled inverted pendulum",
        at="(0.0, 2.0, 4.0)",
        span="4.0",
        start="pitch=0.0",
        inputs='{"speed": 1.0, "turn": lambda t: 0.8 * jnp.sin(1.5 * t)}',
    ),
    "satellite": Picture(
        title="Satellite with reaction wheels",
        at="(3.0,)",
        view="(24, -50)",
        start="",
        span="3.0",
        paths='[("bus", (0.3, 0.25, 0.2))]',
        inputs='{"torque_x": lambda t: 1.0 * (1.5 - t), "torque_y": 0.4, "torque_z": lambda t: 0.5 * jnp.sin(t)}',
    ),
}
AXLE = Picture("The wheels turn at different rates: it drifts across the slope in a cycloid and never runs away.", view='"above"', at="5")
MODEL_PICTURES = {
    "two-wheel-axle-free": AXLE,
    "two-wheel-axle-coordinates": AXLE,
    "two-wheel-axle-quasi": AXLE,
    "two-wheel-axle-redundant": AXLE,
    "skate": Picture("Set turning, it drifts across the slope (x points downhill) and comes back up: a cycloid. It gains no height in the mean.", view='"above"', at="9"),
    "chaplygin-sleigh": Picture("It starts backwards, turns over in a cusp, and runs off straight with the blade behind.", view='"above"', at="6"),
    "vertical-disc": Picture("Both rates stay what they are: the path is a circle.", at="4", span="3.0"),
    "tilting-disc": Picture("The path of the contact turns in loops while lean and yaw swing about a steady motion.", at="4", span="3.0"),
    "tilting-disc-quaternion": Picture("The same disc in a quaternion, which also serves where it lies flat.", at="4", span="3.0"),
    "rosenberg-particle": Picture("The row dy = z dx bends the path; the energy stays what it was.", at="1"),
    "heisenberg-particle": Picture("z grows by the area that the path sweeps: a circle in x, y climbs like a screw.", at="1"),
    "ball-on-turntable": Picture("On a turning table the ball goes round in a circle, like a charge in a magnetic field, 2/7 as fast as the table.", at="3"),
    "suslov": Picture("It turns ever more about one axis although nothing drives it, and never returns.", at="(3.0,)", span="3.0", paths='[("body", (1.0, 0.0, 0.0))]'),
    "snakeboard": Picture("The wheels steer past the place where both rows are parallel; the motion passes through.", view='"above"', at="6", span="3.0"),
    "rattleback": Picture("Spun the wrong way, it rattles, stops and turns back.", at="(0.05,)", span="0.5", view="(30, -60)", paths='[("stone", (0.2, 0, 0))]'),
    "whipple-bicycle": Picture("At 4.5 m/s it catches itself: lean turns the handlebar into the fall.", at="(0.0, 0.9)", span="0.9", paths='[("rear wheel", (0, 0, 0)), ("front wheel", (0, 0, 0))]'),
    "double-pendulum-rods": Picture("Two rods of fixed length as geometric rows; compare the same motion in angles.", view='"side"', at="4", span="1.5", paths='[("second", (0, 0, 0))]'),
    "double-pendulum-angles": Picture("The same pendulum in angles: no row is left.", view='"side"', at="4", span="1.5", paths='[("second", (0, 0, 0))]'),
    "free-rigid-body": Picture("The end of an axis runs along a curve that never closes: Euler's equations.", at="(8.0,)", span="8.0", paths='[("body", (1.0, 0.0, 0.0))]'),
    "spring-and-rod": Picture("A rod keeps two particles apart while a spring pulls.", view='"side"', at="3", paths='[("first", (0, 0, 0)), ("second", (0, 0, 0))]'),
    "isokinetic-particle": Picture("A row that is quadratic in the speeds keeps the speed: the path bends down along a closed form.", view='"side"', at="5"),
    "trailer-chain": Picture("The trailers follow the car on smaller and smaller circles.", view='"above"', at="(0.0, 2.5, 5.0)", paths='[("car", (0, 0, 0)), ("trailer 3", (0, 0, 0))]'),
    "pendulum-chain": Picture("A chain of particles swings from rest; only rods hold it.", view='"side"', at="4", span="1.0", paths='[("particle 1", (0, 0, 0))]'),
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
        return self.picture.title or self.name.replace("-", " ").capitalize()


def entries() -> dict[str, Entry]:
    """Every page of the gallery by name: the scenes of this folder first, then the models."""
    if str(SCENES.parent) not in sys.path:
        sys.path.insert(0, str(SCENES.parent))
    found = {}
    for path in sorted(SCENES.glob("*.py")):
        module = importlib.import_module(f"scenes.{path.stem}")
        kind = next(k for k in vars(module).values() if isinstance(k, type) and issubclass(k, jj.Scene) and k.__module__ == module.__name__)
        name, picture = path.stem.replace("_", "-"), SCENE_PICTURES.get(path.stem, Picture())
        found[name] = Entry(name, kind, path, f"from scenes.{path.stem} import {kind.__name__}\n", f"{kind.__name__}({picture.arguments})", picture, module.LOOK)
    for name, kind in jj.models.MODELS.items():
        picture = MODEL_PICTURES.get(name, Picture(look=f"How {name.replace('-', ' ')} moves from its example start."))
        source = Path(inspect.getfile(kind)).resolve()
        found[name] = Entry(name, kind, source, "", f"jj.models.{kind.__name__}({picture.arguments})", picture, picture.look)
    return found


def code_of(entry: Entry) -> str:
    """The lines that draw the picture of a page, `NAME.png` in the working folder."""
    p = entry.picture
    inputs = f", inputs={p.inputs}" if p.inputs else ""
    start = f"jj.start(scene, {p.start})" if p.start else "jj.start(scene)"
    paths = f", paths={p.paths}" if p.paths else ""
    lines = [
        "import jax.numpy as jnp\n\n" if "jnp." in inputs else "",
        "import jourdain_jax as jj\nfrom jourdain_jax.plotting.still import draw_still\n",
        entry.import_line,
        f"\nscene = {entry.made}\nmotion = jj.simulate(scene, {start}, t1={p.span}{inputs})\n",
        f'draw_still(motion, "{entry.name}.png", view={p.view}, at={p.at}{paths})',
    ]
    return "".join(lines)


def prose_of(docstring: str) -> str:
    """A docstring as Markdown: what is indented becomes a block of its own, stars and underscores stay what they are."""
    blocks = []
    for block in re.split(r"\n\s*\n", inspect.cleandoc(docstring)):
        if block.startswith("    "):
            blocks.append(f"```text\n{inspect.cleandoc(block)}\n```")
        else:
            parts = re.split(r"(`[^`]*`)", block)
            blocks.append("".join(part if part.startswith("`") else re.sub(r"([*_<$~\[\]])", r"\\\1", part) for part in parts))
    return "\n\n".join(blocks)


def page_of(entry: Entry, out: Path) -> str:
    """The text of a page."""
    link = Path(os.path.relpath(entry.source, out)).as_posix()
    shown = entry.source.relative_to(ROOT).as_posix()
    where = " in the folder `docs/gallery`" if entry.import_line else ""
    included = f"\n## The scene\n\n```{{literalinclude}} {link}\n:language: python\n```\n" if entry.import_line else ""
    module = inspect.getdoc(sys.modules[entry.kind.__module__]) or ""
    return f"""# {entry.title}

{prose_of(module)}

![{entry.title}: the motion, earlier times paler]({entry.name}.png)

**What to look at.** {entry.look}

## The lines that draw it

Run{where}:

```python
{code_of(entry)}
```
{included}
Source: [{shown}]({link})
"""


def index_of(chosen: list[Entry]) -> str:
    """Thumbnails of the chosen pages, and their table of contents."""
    cards = "\n".join(
        f":::{{grid-item-card}} {entry.title}\n:img-top: {entry.name}.png\n:link: {entry.name}\n:link-type: doc\n:::\n" for entry in chosen
    )
    pages = "\n".join(entry.name for entry in chosen)
    return f"""# Gallery

Each page has a picture, the lines that draw it, what to look at, and the source. Earlier times are drawn paler; lengths are in metres.

::::{{grid}} 1 2 3 3
:gutter: 2

{cards}
::::

```{{toctree}}
:hidden:
:maxdepth: 1

{pages}
```
"""


def write(entry: Entry, out: Path) -> Path:
    """Run the lines of a page in the folder `out`, and write the page beside its picture."""
    with contextlib.chdir(out):
        exec(compile(code_of(entry), f"{entry.name}.md", "exec"), {})
    page = out / f"{entry.name}.md"
    page.write_text(page_of(entry, out))
    return page


def main(arguments: list[str] | None = None) -> None:
    """Write the pages that are asked for; exits with a message where a name is unknown."""
    parser = argparse.ArgumentParser(description="Write the pages of the gallery.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="pages (default: all)")
    parser.add_argument("--out", type=Path, default=PAGES, metavar="DIR", help="folder to write to (default: docs/gallery/pages)")
    asked = parser.parse_args(arguments)
    os.environ.setdefault("MPLBACKEND", "Agg")
    known = entries()
    names = [name.replace("_", "-") for name in asked.names] or list(known)
    for name in names:
        if name not in known:
            parser.error(f"no page `{name}`, expected some of: {', '.join(known)}")
    out = asked.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    for name in names:
        began = time.perf_counter(), time.process_time()
        write(known[name], out)
        print(f"{name}: {time.perf_counter() - began[0]:.1f} s, {time.process_time() - began[1]:.1f} s of processor time", flush=True)
    (out / "index.md").write_text(index_of([known[name] for name in names]))


if __name__ == "__main__":
    main()
