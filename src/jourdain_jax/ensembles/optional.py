"""What studies need beyond the package's own dependencies; imported when it is used, missed by the name of the extra that brings it."""

EXTRA = 'it comes with the extra `ensembles`: pip install "jourdain-jax[ensembles]"'


def missing(package: str, purpose: str) -> ImportError:
    """The error of a package that is not installed."""
    return ImportError(f"{purpose} needs the package `{package}`, which is not installed; {EXTRA}")


def stored_by():
    """The packages `zarr` and `google_crc32c`, which comes with it."""
    try:
        import google_crc32c
        import zarr
    except ImportError as error:
        raise missing("zarr", "storing a study") from error
    return zarr, google_crc32c


def cluster_by():
    """The package `distributed`, of Dask."""
    try:
        import distributed
    except ImportError as error:
        raise ImportError('a cluster needs Dask, which is not installed; pip install "jourdain-jax[cluster]"') from error
    return distributed


def labelled_by():
    """The package `xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise missing("xarray", "a study as labelled arrays") from error
    return xarray


def special_functions():
    """The module `scipy.special`."""
    try:
        import scipy.special
    except ImportError as error:
        raise missing("scipy", "a normal distribution") from error
    return scipy.special


def sequences():
    """The module `scipy.stats.qmc`."""
    try:
        import scipy.stats.qmc
    except ImportError as error:
        raise missing("scipy", "a Sobol sequence") from error
    return scipy.stats.qmc


def draws_with():
    """The module `matplotlib.pyplot`."""
    try:
        import matplotlib.pyplot
    except ImportError as error:
        raise ImportError('a plot needs matplotlib, which is not installed; pip install "jourdain-jax[plot]"') from error
    return matplotlib.pyplot
