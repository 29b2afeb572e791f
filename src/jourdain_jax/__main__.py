"""`python -m jourdain_jax` is the command line."""

import sys

from jourdain_jax.cli import main

sys.exit(main())
