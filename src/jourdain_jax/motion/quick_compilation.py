"""A function compiled with options of XLA that save compile time where they cost no running time.

XLA's newer fusion emitters on the CPU take up to twice as long to compile a scalar program of thousands of operations, for code that is no faster
(measured: one motion of a bicycle, 5.0 s against 3.1 s; in batches of dense matrices they are faster, so these are left alone).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jourdain_jax.scene.numbers import is_traced

_OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
_RUN_SELDOM: dict[str, Any] = _OPTIONS | {"xla_backend_optimization_level": 0}


def quickly_compiled(f: Callable, compiler: Callable = eqx.filter_jit, run_seldom: bool = False) -> Callable:
    """`f`, compiled by `compiler`; on a CPU with the quick options, but for calls inside another transformation: JAX takes options of whole programs only.

    `run_seldom`: what `f` costs is its compilation.
    """
    plain, quick = compiler(f), compiler(f, compiler_options=_RUN_SELDOM if run_seldom else _OPTIONS)

    def run(*arguments):
        return (quick if jax.default_backend() == "cpu" and _outermost(arguments) else plain)(*arguments)

    return run


def _outermost(arguments) -> bool:
    """Whether nothing is being traced, neither the arguments nor a function around this call."""
    return not is_traced(arguments, jnp.zeros(()))
