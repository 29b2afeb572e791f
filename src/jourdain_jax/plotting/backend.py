"""What pictures need from outside: matplotlib, loaded when one is asked for, and a folder to be written to."""

import os
from functools import partial

from jourdain_jax.calculus.on_first_use import needed

pyplot = partial(needed, "matplotlib.pyplot", "a picture", "plot")


def check_folder(path: str | os.PathLike) -> None:
    """ValueError where the folder of a file to be written does not exist."""
    folder = os.path.dirname(os.fspath(path)) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"cannot write `{os.fspath(path)}`: there is no folder `{folder}`; make it first")
