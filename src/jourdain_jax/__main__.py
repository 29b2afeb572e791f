"""Run the command line, as `python -m jourdain_jax`."""

import sys

from jourdain_jax.cli import main

sys.exit(main())
