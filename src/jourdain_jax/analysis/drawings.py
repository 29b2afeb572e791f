"""Axes with round numbers, dots, lines and bars as SVG: what the pictures of a fit are made of. Nothing but NumPy is needed, nothing is loaded."""

import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Number = int | float
DATA, PALE, MODEL, QUIET, BAND = "#d1495b", "#e88d98", "#1b4f72", "#888", "#e6e6e6"
COLOURS = ("#1b4f72", "#d98c00", "#3c8d5a", "#8c4b8c", "#d1495b", "#5b6d7d")  # of several things side by side
_LEAST_SPAN = 1e-9  # of the numbers on an axis: less is round-off, and is drawn as one number


def span_of(*numbers) -> tuple[float, float]:
    """Least and largest of all finite numbers, widened by 4 % to either side; one number alone gets some room around it."""
    every = np.concatenate([np.ravel(np.asarray(x, float)) for x in numbers])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if every.size else (0.0, 1.0)
    if high - low <= _LEAST_SPAN * max(abs(low), abs(high)):
        room = 0.1 * max(abs(low), abs(high)) or 1.0
        return low - room, high + room
    return low - 0.04 * (high - low), high + 0.04 * (high - low)


def ticks(low: Number, high: Number, most: int) -> list[tuple[float, str]]:
    """Round numbers from low to high, at most `most` and one, with their texts."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    plain = decimals <= 4 and max(abs(low), abs(high)) < 1e5
    return [(k * step, f"{k * step:.{decimals}f}" if plain else f"{k * step:.10g}") for k in range(first, last + 1)]


def text(x: Number, y: Number, words: str, anchor: str = "start", kind: str = "") -> str:
    """A text at a place in pixels."""
    of_kind = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{of_kind}>{html.escape(words)}</text>'


def drawing(width: int, height: int, parts: Sequence[str], caption: str = "") -> str:
    """A figure of these parts, with a caption below."""
    below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
    return f'<figure><svg width="{width}" height="{height}" font-size="11" font-family="sans-serif" fill="currentColor">{"".join(parts)}</svg>{below}</figure>'


@dataclass(frozen=True)
class Axes:
    """A frame in pixels, and the numbers at its edges."""

    left: Number
    top: Number
    width: Number
    height: Number
    x: tuple[Number, Number]
    y: tuple[Number, Number]

    def right(self, x):
        """Pixels from the left."""
        return self.left + self.width * (np.asarray(x, float) - self.x[0]) / (self.x[1] - self.x[0])

    def down(self, y):
        """Pixels from above."""
        return self.top + self.height * (self.y[1] - np.asarray(y, float)) / (self.y[1] - self.y[0])

    def frame(self, x_label: str = "", y_label: str = "", x_ticks: Sequence | None = None, y_ticks: Sequence | None = None, numbers: bool = True) -> str:
        """Frame, round numbers and labels; `numbers`: whether they stand below, too."""
        bottom, parts = self.top + self.height, []
        for value, words in ticks(*self.y, max(2, int(self.height / 28))) if y_ticks is None else y_ticks:
            y = float(self.down(value))
            parts += [_rule(self.left, y, self.left + self.width, y, "#eee"), text(self.left - 4, y + 4, words, "end", "y")]
        for value, words in ticks(*self.x, max(2, int(self.width / 70))) if x_ticks is None else x_ticks:
            x = float(self.right(value))
            parts.append(_rule(x, bottom, x, bottom + 4, "#999"))
            parts += [text(x, bottom + 15, words, "middle", "x")] if numbers else []
        parts.append(f'<rect x="{self.left:.1f}" y="{self.top:.1f}" width="{self.width:.1f}" height="{self.height:.1f}" fill="none" stroke="#bbb"/>')
        parts += [text(self.left + self.width, bottom + 29, x_label, "end")] if x_label else []
        parts += [text(2, self.top - 6, y_label)] if y_label else []
        return "".join(parts)

    def dots(self, x, y, colour: str = DATA, kind: str = "dots", size: Number = 3.2) -> str:
        """Dots; what is not finite is left out."""
        at = "".join(f"M{a:.1f},{b:.1f}h0" for a, b in self._finite(x, y))
        return f'<path class="{kind}" d="{at}" stroke="{colour}" stroke-width="{size}" stroke-linecap="round" fill="none"/>' if at else ""

    def line(self, x, y, colour: str = MODEL, kind: str = "line", dashed: bool = False) -> str:
        """A line through what is finite."""
        at = " ".join(f"{a:.1f},{b:.1f}" for a, b in self._finite(x, y))
        dash = ' stroke-dasharray="4 3"' if dashed else ""
        return f'<polyline class="{kind}" points="{at}" fill="none" stroke="{colour}" stroke-width="1.3"{dash}/>' if at else ""

    def level(self, y: Number, colour: str = QUIET, dashed: bool = False) -> str:
        """A horizontal line."""
        return _rule(self.left, float(self.down(y)), self.left + self.width, float(self.down(y)), colour, dashed)

    def upright(self, x: Number, colour: str = QUIET, dashed: bool = False) -> str:
        """A vertical line."""
        return _rule(float(self.right(x)), self.top, float(self.right(x)), self.top + self.height, colour, dashed)

    def band(self, low: Number, high: Number) -> str:
        """A grey band over all x."""
        top, bottom = float(self.down(min(high, self.y[1]))), float(self.down(max(low, self.y[0])))
        return f'<rect x="{self.left:.1f}" y="{top:.1f}" width="{self.width:.1f}" height="{bottom - top:.1f}" fill="{BAND}"/>'

    def bar(self, x0: Number, x1: Number, y0: Number, y1: Number, colour: str = "") -> str:
        """A filled rectangle between these numbers; without a colour, in that of what it is part of."""
        (a, b), (c, d) = sorted((float(self.right(x0)), float(self.right(x1)))), sorted((float(self.down(y0)), float(self.down(y1))))
        fill = f' fill="{colour}"' if colour else ""
        return f'<rect x="{a:.1f}" y="{c:.1f}" width="{b - a:.1f}" height="{d - c:.1f}"{fill}/>'

    def _finite(self, x, y):
        at = np.stack([self.right(x), self.down(y)], axis=1)
        return at[np.isfinite(at).all(axis=1)].tolist()


def _rule(x0: Number, y0: Number, x1: Number, y1: Number, colour: str, dashed: bool = False) -> str:
    dash = ' stroke-dasharray="4 3"' if dashed else ""
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}"{dash}/>'
