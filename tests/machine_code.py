"""Where motions run as machine code of our own: with llvmlite, which is not looked for under Windows."""

import importlib.util
import sys

import pytest

MADE = importlib.util.find_spec("llvmlite") is not None and sys.platform != "win32"
BACKENDS = ("xla", "native") if MADE else ("xla",)
needed = pytest.mark.skipif(not MADE, reason="no machine code is made here")
