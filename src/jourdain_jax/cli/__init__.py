"""The command line `jourdain-jax`: thin, on top of everything else."""

from jourdain_jax.cli.command import main

__all__ = ["main"]
