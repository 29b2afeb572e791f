"""A drawing of a scene at its example start: what a notebook shows beside its parameters."""

from jourdain_jax.calculus.figures import figure
from jourdain_jax.motion.start import start
from jourdain_jax.plotting.looks import looks_at
from jourdain_jax.plotting.space import axes_in_space, box_of, draw, painted
from jourdain_jax.plotting.still import VIEWS


def scene_picture(scene) -> str:
    """HTML of the bodies of a scene where its `example` puts them, in space, on a floor with their shadows; empty where there is none to draw.

    A scene that cannot be started has no picture: a notebook displays what is still being written, and `jj.start` says what is wrong.
    """
    try:
        bodies = painted(looks_at(scene, start(scene, **scene.example)), 0)
    except Exception:  # whatever the user's methods raise, and that numbers are not known
        return ""
    return figure(lambda whole: draw(axes_in_space(whole, VIEWS["space"]), bodies, [], box_of(bodies[:1])), 300, 200)
