"""Processes that compute in one kind of floats, as JAX chooses once: set up before JAX is imported."""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

# Hundreds of small programs: compiling them is most of the time. The first flag belongs to jaxlib 0.10.
FLAGS = "--xla_backend_optimization_level=0"
FLAGS += " --xla_cpu_use_fusion_emitters=false" * version("jaxlib").startswith("0.10.")
TYPES = ("float64", "float32")


def prepare(dtype):
    """Set this process up; `tests` holds closed forms and small scenes."""
    os.environ.setdefault("XLA_FLAGS", FLAGS)
    os.environ["JAX_ENABLE_X64"] = str(int(dtype == "float64"))
    here = Path(__file__).resolve().parent
    sys.path[:0] = [str(here), str(here.parent / "tests")]


def processes(dtype, count=1) -> ProcessPoolExecutor:
    """Fresh processes of one kind."""
    spawn = get_context("spawn")
    return ProcessPoolExecutor(count, mp_context=spawn, initializer=prepare, initargs=(dtype,))
