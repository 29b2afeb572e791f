"""What studies need beyond the package's own dependencies; imported when it is used, missed by the name of the extra that brings it."""

from functools import partial

from jourdain_jax.calculus.on_first_use import needed

zarr = partial(needed, "zarr", "storing a study", "ensembles")
crc32c = partial(needed, "google_crc32c", "storing a study", "ensembles")  # comes with zarr
distributed = partial(needed, "distributed", "a cluster", "cluster")
xarray = partial(needed, "xarray", "a study as labelled arrays", "ensembles")
special_functions = partial(needed, "scipy.special", "a normal distribution", "ensembles")
sequences = partial(needed, "scipy.stats.qmc", "a Sobol sequence", "ensembles")
pyplot = partial(needed, "matplotlib.pyplot", "a plot", "plot")
