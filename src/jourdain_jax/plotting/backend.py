"""What pictures need from outside: matplotlib, loaded when one is asked for."""

from functools import partial

from jourdain_jax.calculus.on_first_use import needed

pyplot = partial(needed, "matplotlib.pyplot", "a picture", "plot")
