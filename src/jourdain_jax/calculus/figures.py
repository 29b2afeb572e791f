"""Matplotlib figures within HTML."""

import base64
import html
import io
from collections.abc import Callable
from functools import partial
from typing import Any

from jourdain_jax.calculus.lazy_imports import needed

pyplot = partial(needed, "matplotlib.pyplot", "a picture", "plot")
DATA, MODEL, QUIET = "#d1495b", "#1b4f72", "#888888"


def figure(draw: Callable[[Any], None], width: float, height: float, caption: str = "") -> str:
    """Return HTML of the matplotlib figure that `draw` fills, `width` by `height` pixels, or of the error
    message if matplotlib is missing.
    """
    try:
        # a pixel of a page is 1/96 inch
        drawn = needed("matplotlib.figure", "a figure", "plot").Figure(
            (width / 96, height / 96), dpi=96, layout="constrained"
        )
    except ImportError as missing:
        return f"<p>{html.escape(str(missing))}</p>"
    draw(drawn)
    for axes in drawn.axes:
        axes.tick_params(labelsize=8)
        for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
            text.set_fontsize(8)
    png = io.BytesIO()
    drawn.savefig(png, format="png")
    below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    data = base64.b64encode(png.getvalue()).decode()
    return (
        f'<figure><img alt="{html.escape(caption)}" width="{width:.0f}" height="{height:.0f}"'
        f' src="data:image/png;base64,{data}"/>{below}</figure>'
    )
