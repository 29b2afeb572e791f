"""Draws `docs/architecture.svg`: the packages from bottom to top, and the way of three calls through them.

    python docs/draw_architecture.py [FILE]       # an SVG or a PNG, by the ending of FILE

The steps are those of the numbered lists in `docs/architecture.md`.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle, Rectangle

# top first: name, purpose, whether it is a part of the package above it in the picture
ROOMS = (
    ("cli", "the shell command jourdain-jax", False),
    ("views", "pictures and animations of motions", False),
    ("bicycle", "measured bicycles: files, stability, uncertainty", False),
    ("importers", "scenes from SymPy, URDF and MJCF", False),
    ("models", "textbook scenes, to be read as examples", False),
    ("studies", "studies of many motions: designs, storage", False),
    ("identification", "fit: data, solve, inference, report", False),
    ("analysis", "report, verify, linearize, steady, family", False),
    ("motion", "build, start, simulate, rollout", False),
    ("motion/trajectories", "states over time, files", True),
    ("integrate", "methods, stop events, starts", False),
    ("integrate/arrays", "the same steps on arrays of JAX", True),
    ("integrate/loop", "steps, and their loop as machine code", True),
    ("integrate/vector_fields", "the integrated state, and its rates", True),
    ("lowering", "equations of motion as scalar programs", False),
    ("dynamics", "accelerations, forces, power at one state", False),
    ("structure", "found once: rank, privileged speeds", False),
    ("equations", "Jourdain's principle: rows, reductions", False),
    ("scene", "what a user writes: bodies, loads, rows", False),
    ("kernels", "scalar programs as machine code", False),
    ("program", "graphs of scalars: derivatives, code", False),
    ("calculus", "mathematics without physics", False),
)
# name, colour, and steps: the room, and whether the work is done in the first call only
CALLS = (
    (
        "simulate(scene, ...)",
        "#1f5fa8",
        (
            ("motion", False),
            ("structure", True),
            ("scene", True),
            ("program", True),
            ("equations", False),
            ("lowering", True),
            ("motion", False),
            ("integrate/loop", False),
            ("integrate/vector_fields", False),
            ("motion/trajectories", False),
        ),
    ),
    (
        "jax.grad of it",
        "#b3470f",
        (
            ("motion", False),
            ("structure", True),
            ("lowering", True),
            ("equations", False),
            ("calculus", False),
            ("integrate/loop", False),
            ("motion/trajectories", False),
            ("integrate/loop", False),
            ("lowering", False),
            ("motion", False),
        ),
    ),
    (
        "rollout(scene, ...)",
        "#2b7a3d",
        (
            ("motion", False),
            ("motion", False),
            ("structure", True),
            ("lowering", True),
            ("equations", False),
            ("motion", False),
            ("motion", False),
            ("integrate/loop", False),
            ("motion/trajectories", False),
            ("motion", False),
        ),
    ),
)
WIDTH, HEADER, ROW, FOOTER = 900, 44, 39, 46  # px
TEXT, COLUMN, GAP, RADIUS = 306, 188, 8, 8.6
HEIGHT = HEADER + ROW * len(ROOMS) + FOOTER


def draw(path: Path) -> None:
    """Write the picture to `path`."""
    plt.rcParams.update({"svg.hashsalt": "architecture", "font.family": "DejaVu Sans"})
    figure = plt.figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.axis("off")
    middle = {name: HEADER + ROW * (k + 0.5) for k, (name, *_) in enumerate(ROOMS)}
    shade = False
    for name, purpose, part in ROOMS:
        shade = shade if part else not shade
        top, left = middle[name] - ROW / 2, 30 if part else 12
        axes.add_patch(Rectangle((0, top), WIDTH, ROW, color="#eef1f5" if shade else "#ffffff", lw=0))
        axes.text(left, top + 13, name, fontsize=8.6, weight="bold", va="center", color="#111111")
        axes.text(left, top + 28, purpose, fontsize=7.6, va="center", color="#444444")
    axes.plot([0, WIDTH], [HEADER, HEADER], color="#888888", lw=0.8)
    axes.plot([0, WIDTH], [HEIGHT - FOOTER] * 2, color="#888888", lw=0.8)
    axes.text(
        12,
        HEADER / 2,
        "packages: each imports only\nwhat lies below it",
        fontsize=7.6,
        va="center",
        color="#444444",
    )
    for k, (call, colour, steps) in enumerate(CALLS):
        left = TEXT + k * (COLUMN + GAP)
        axes.text(
            left + COLUMN / 2,
            HEADER / 2,
            call,
            fontsize=9.2,
            weight="bold",
            color=colour,
            ha="center",
            va="center",
        )
        between = (COLUMN - 2 * RADIUS - 6) / (len(steps) - 1)
        places = [(left + RADIUS + 3 + i * between, middle[room]) for i, (room, _) in enumerate(steps)]
        axes.plot(*zip(*places, strict=True), color=colour, lw=1.3, alpha=0.55, zorder=1)
        for i, (place, (_, first)) in enumerate(zip(places, steps, strict=True)):
            axes.add_patch(
                Circle(
                    place, RADIUS, facecolor="white" if first else colour, edgecolor=colour, lw=1.3, zorder=2
                )
            )
            axes.text(
                *place,
                str(i + 1),
                fontsize=7.2,
                weight="bold",
                color=colour if first else "white",
                ha="center",
                va="center_baseline",
                zorder=3,
            )
    low = HEIGHT - FOOTER / 2
    for x, face, text in (
        (320, "#555555", "in every call"),
        (450, "white", "worked out in the first call, looked up in later ones"),
    ):
        axes.add_patch(Circle((x, low), RADIUS, facecolor=face, edgecolor="#555555", lw=1.3))
        axes.text(x + 15, low, text, fontsize=7.6, va="center", color="#444444")
    axes.text(12, low, "numbers: the lists in architecture.md", fontsize=7.6, va="center", color="#444444")
    figure.savefig(path, dpi=100, metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("architecture.svg"))
