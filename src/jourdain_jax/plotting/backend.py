"""matplotlib, loaded when a picture is asked for."""

from jourdain_jax.calculus.on_first_use import needed


def pyplot():
    """matplotlib's pyplot; an ImportError that names the extra where it is missing."""
    return needed("matplotlib.pyplot", "a picture", "plot")
