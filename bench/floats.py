"""A process that computes in one kind of floats, as JAX chooses once: to be set up before JAX is imported."""

import os
import sys
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Hundreds of small programs: compiling them is most of the time. The first flag belongs to jaxlib 0.10.
FLAGS = "--xla_backend_optimization_level=0" + (
    " --xla_cpu_use_fusion_emitters=false" if version("jaxlib").startswith("0.10.") else ""
)
TYPES = ("float64", "float32")


def environment(dtype: str) -> dict[str, str]:
    """Settings of JAX."""
    return {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", FLAGS),
        "JAX_ENABLE_X64": "1" if dtype == "float64" else "0",
    }


def prepare(dtype: str) -> None:
    """Set this process up; `tests` holds closed forms and small scenes."""
    os.environ.update(environment(dtype))
    sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]
