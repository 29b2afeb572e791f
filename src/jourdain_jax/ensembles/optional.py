"""What studies need beyond the package's own dependencies; imported when it is used, missed by the name of the extra that brings it."""

from functools import partial

from jourdain_jax.calculus.on_first_use import needed

crc32c = partial(needed, "google_crc32c", "storing a study", "ensembles")  # comes with zarr
distributed = partial(needed, "distributed", "a cluster", "cluster")
special_functions = partial(needed, "scipy.special", "a normal distribution", "ensembles")
