"""Interactive 3D views of motions: a self-contained HTML page drawn by three.js."""

import base64
import html
import json
import zlib
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from jourdain_jax.calculus.files import FilePath, check_place, name_of, shortened
from jourdain_jax.calculus.reals import described
from jourdain_jax.motion.rollout import Rollout
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import check_names
from jourdain_jax.views.page_data import Display, page_data


class View:
    """A 3D view of motions as an HTML page, `html`. A notebook displays it; `save(path)` writes it to
    a file.
    """

    def __init__(self, page: str, title: str, height: int):
        self.html, self.title, self.height = page, title, height

    def save(self, path: FilePath) -> None:
        """Write the page to `path` (.html) as one file that needs no network. Raises ValueError for another
        suffix.
        """
        _check_suffix(path)
        with open(path, "w", encoding="utf-8") as file:
            file.write(self.html)

    def _repr_html_(self) -> str:
        page = html.escape(self.html, quote=True)
        return (
            f'<iframe srcdoc="{page}" title="{html.escape(self.title)}"'
            f' style="width:100%;height:{self.height}px;border:1px solid #ddd"></iframe>'
        )

    def __repr__(self) -> str:
        return (
            f"View of {self.title}, {len(self.html) / 1e6:.2f} MB of HTML; a notebook displays it,"
            " .save('view.html') writes it to a file"
        )


@of_known_numbers
def show(
    motion: "Trajectory | Rollout | Sequence[Trajectory]", path: FilePath | None = None, **how: Any
) -> View:
    """Show a 3D view of a `motion` to turn, zoom, play and scrub, in a notebook or any browser.

    - `motion`: from `jj.simulate`; or a list of motions, or a rollout (at most 12 samples, evenly spaced).
      Several motions are drawn over each other, all but the first translucent.
    - `path`: an .html file to write as well. `ride.html#t=2.5` opens at 2.5 s.
    - Keyword arguments `how`: `title` (default: the name of the scene); `height` in pixels in a notebook
      (480).
    - `play`: whether to play when opened.
    - `follow`: whether the view moves with the bodies (default: if they travel far). `view`: initial
      elevation and azimuth, in degrees (default: (22, -60)).
    - `paths`: (body, body-frame point in m) pairs to trace (default: contact points, or mass centres if there
      is no contact).
    - `forces`: whether to draw arrows for contact forces (default: True). `colours`: name of a body ->
      "#rrggbb".

    Bodies have the shapes of the scene's `visuals` (see `jj.Visual`), or shapes that follow from contacts and
    inertias. Returns a `View`. Raises ValueError for invalid arguments.

    **Examples**

        motion = jj.simulate(jj.models.TiltingDisc(), {"lean": 0.3, "spin_rate": -3.0}, t1=5.0)
        jj.show(motion, "disc.html")
    """
    if path is not None:
        _check_suffix(path)
    motions = _motions(motion)
    display = Display(
        **{"title": type(motions[0].scene).__name__}
        | {name: value for name, value in how.items() if value is not None}
    )
    names = list(dict.fromkeys(name for one in motions for name in one.motions().bodies))
    check_names(display.colours, names, "`colours` names `{}`, which is not a body")
    if np.shape(display.view) != (2,):
        raise ValueError(
            f"`view` is {display.view!r}, expected elevation and azimuth in degrees, such as (22, -60)"
        )
    description, numbers = page_data(motions, display)
    shown = View(_page(display.title, description, numbers.bytes()), display.title, display.height)
    if path is not None:
        shown.save(path)
    return shown


def _motions(given) -> list[Trajectory]:
    """Return the argument as a list of single motions."""
    if isinstance(given, Rollout):
        chosen = np.unique(np.linspace(0, len(given) - 1, min(12, len(given))).astype(int))
        lanes = [given.lane(int(k)) for k in chosen]
        return [lane for lane in lanes if bool(np.any(np.asarray(lane.valid)))] or lanes[:1]
    if isinstance(given, Trajectory) and given.q.ndim == 2:
        return [given]
    if isinstance(given, list | tuple) and given:
        return [one for several in given for one in _motions(several)]
    raise ValueError(
        f"`show` was given {described(given)}, expected a motion from `jj.simulate`, a "
        "rollout, or a list of these"
    )


def _page(title: str, description: dict, numbers: bytes) -> str:
    parts = {
        "TITLE": html.escape(title),
        "SCENE": json.dumps(description).replace("</", "<\\/"),
        "NUMBERS": _packed(numbers),
        "THREE": _packed(_file("three.bundle.js").encode()),
        "PLAYER": _file("player.js"),
    }
    page = _file("page.html")
    for name, text in parts.items():
        page = page.replace(f"@{name}@", text)
    return page


def _packed(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content)).decode()


def _file(name: str) -> str:
    return (resources.files("jourdain_jax") / "views" / "viewer" / name).read_text(encoding="utf-8")


def _check_suffix(path: FilePath) -> None:
    if not name_of(path).lower().endswith((".html", ".htm")):
        raise ValueError(
            f"cannot write `{shortened(path)}`: a 3D view is a .html file; for a .gif use "
            "`jj.animate`, for figures `jj.plot`"
        )
    check_place(path)
