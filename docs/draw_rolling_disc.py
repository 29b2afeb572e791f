"""Draws the moving picture of the front page: `python docs/draw_rolling_disc.py` writes
docs/_static/rolling_disc.gif (needs matplotlib).
"""

from pathlib import Path

import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import jourdain_jax as jj

FRAMES, FINER, SPAN, RIM, FACE, TRACK = 72, 4, 6.0, "#1f3a5f", "#8fb8de", "#d1495b"


def main() -> None:
    """One wobbling disc, the path of its contact, and its shadow."""
    disc = jj.models.TiltingDisc()
    motion = jj.simulate(
        disc,
        {"lean": 0.35, "yaw_rate": 0.6, "spin_rate": -3.4},
        ts=jnp.linspace(0.0, SPAN, FINER * (FRAMES - 1) + 1),
    )
    body = motion.motions()["disc"]
    centre, turned = np.asarray(body.position)[::FINER], np.asarray(body.orientation)[::FINER]
    angle = np.linspace(0.0, 2 * np.pi, 61)
    circle = 0.5 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)])  # the axle is the body's y axis
    rims = np.moveaxis(turned @ circle + centre[..., None], 1, 2)
    spokes = [
        np.moveaxis(turned @ (0.5 * np.outer([np.cos(a), 0, np.sin(a)], [-1, 1])) + centre[..., None], 1, 2)
        for a in (0.0, np.pi / 2)
    ]
    contact = np.stack([motion["x"], motion["y"]], axis=1)

    figure = plt.figure(figsize=(5.6, 3.6), layout="none")
    axes = figure.add_axes((-0.12, -0.28, 1.24, 1.52), projection="3d", computed_zorder=False)
    axes.set_axis_off()
    axes.view_init(24, -62)
    low, high = contact.min(0) - 0.5, contact.max(0) + 0.5
    half = 0.5 * np.max(high - low)
    middle = 0.5 * (high + low)
    axes.set(
        xlim=middle[0] + np.array([-half, half]),
        ylim=middle[1] + np.array([-half, half]),
        zlim=(-0.4 * half, 0.6 * half),
    )
    axes.set_box_aspect((2, 2, 1))
    x0, x1, y0, y1 = middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half
    axes.add_collection3d(
        Poly3DCollection(
            [[(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]],
            facecolor="#f2efe9",
            edgecolor="#c9c3b8",
            zorder=0,
        )
    )
    shadow = Poly3DCollection([np.zeros((3, 3))], facecolor="#000000", alpha=0.12, zorder=1)
    face = Poly3DCollection(
        [np.zeros((3, 3))], facecolor=FACE, edgecolor=RIM, linewidth=2.2, alpha=0.95, zorder=3
    )
    axes.add_collection3d(shadow)
    axes.add_collection3d(face)
    (track,) = axes.plot([], [], [], color=TRACK, lw=1.8, zorder=2)
    lines = [axes.plot([], [], [], color=RIM, lw=1.2, zorder=4)[0] for _ in spokes]

    def frame(k):
        face.set_verts([rims[k]])
        shadow.set_verts([rims[k] * [1, 1, 0]])
        behind = contact[: FINER * k + 1].T
        track.set_data_3d(*behind, np.zeros(behind.shape[1]))
        for line, spoke in zip(lines, spokes, strict=True):
            line.set_data_3d(*spoke[k].T)
        return [face, shadow, track, *lines]

    out = Path(__file__).parent / "_static" / "rolling_disc.gif"
    FuncAnimation(figure, frame, frames=FRAMES).save(out, writer=PillowWriter(fps=FRAMES / SPAN), dpi=85)


if __name__ == "__main__":
    main()
