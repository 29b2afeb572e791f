"""Command line `jourdain-jax`.

Commands, options, exit codes and JSON keys stay as they are; new ones may be added. Open `command.py` first;
each `*_verbs.py` adds commands to its parser.
"""

from jourdain_jax.cli.command import main

__all__ = ["main"]
