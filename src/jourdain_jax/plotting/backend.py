"""matplotlib, loaded when a picture is asked for."""


def pyplot():
    """matplotlib's pyplot; an ImportError that names the extra where it is missing."""
    try:
        import matplotlib.pyplot
    except ImportError:
        raise ImportError("pictures need matplotlib; install it with: pip install 'jourdain-jax[plot]'") from None
    return matplotlib.pyplot
