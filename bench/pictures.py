"""3D views: the size of a ride's page, what it would ask of a network, how long it takes to make, and the lines to it.

    taskset -c 1 python bench/pictures.py [--quick] [--json FILE]

`--json` writes a list of {"figure", "model", "value", "required", "met"}; `required` is null where nothing is asked for. Times are processor time, s: of a
first call in its process (compiled for the first time) and of a second one. `--quick`: the bicycle alone, otherwise all models.
"""

import argparse
import base64
import json
import re
import time
import zlib

import jourdain_jax as jj

LINES = """import jourdain_jax as jj
bicycle = jj.models.WhippleBicycle()
start = jj.start(bicycle, **bicycle.upright(4.6), lean_rate=0.3)
motion = jj.simulate(bicycle, start, t1=10.0)
view = jj.show(motion)
"""


def row(figure: str, model: str, value, required=None) -> dict:
    """One figure; `required` is the most that is allowed."""
    met = required is None or bool(value <= required)
    print(f"{model:28} {figure:44} {value:>10}  {'' if required is None else f'required <= {required}: ' + ('met' if met else 'NOT MET')}", flush=True)
    return {"figure": figure, "model": model, "value": value, "required": required, "met": met}


def requests_of(page: str) -> int:
    """Addresses that a browser would ask for: sources and links other than data, and calls of code that fetch."""
    viewer = zlib.decompress(base64.b64decode(re.search(r'id="three" type="text/plain">(.*?)<', page)[1])).decode()
    links = [link for link in re.findall(r'(?:src|href)="([^"]*)"', page) if not link.startswith("data:")]
    # one is the name of a format, no address
    named = [name for name in re.findall(r"https?://[^\"'` )]*", page + viewer) if name != "http://www.w3.org/1999/xhtml"]
    return len(links) + len(named) + len(re.findall(r"XMLHttpRequest|@import|\bimport\(", page + viewer))


def timed(function):
    """What it returns, and the processor time that it took, s."""
    began = time.process_time()
    found = function()
    return found, round(time.process_time() - began, 3)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", metavar="FILE")
    asked = parser.parse_args()
    names: dict = {}
    exec(compile(LINES, "lines", "exec"), names)
    rows = [row("lines to a ride and its 3D view", "whipple-bicycle", len(LINES.splitlines()), 8)]
    rows.append(row("size of the page of 10 s, MB", "whipple-bicycle", round(len(names["view"].html) / 1e6, 3), 1.0))
    rows.append(row("network requests", "whipple-bicycle", requests_of(names["view"].html), 0))
    _, again = timed(lambda: jj.show(names["motion"]))
    rows.append(row("a second view, s of processor time", "whipple-bicycle", again))
    for name in () if asked.quick else jj.models.MODELS:
        scene = jj.models.model(name)
        motion = jj.simulate(scene, jj.start(scene, **scene.example))
        view, first = timed(lambda motion=motion: jj.show(motion))
        rows.append(row("size of the page of its example, MB", name, round(len(view.html) / 1e6, 3), 1.0))
        rows.append(row("the first view, s of processor time", name, first))
    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
