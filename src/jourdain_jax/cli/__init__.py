"""Command line `jourdain-jax`."""

from jourdain_jax.cli.command import main

__all__ = ["main"]
