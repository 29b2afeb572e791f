"""Settings that JAX reads from the environment once, when it starts.

Why XLA's pool has at least 16 threads: a batched LAPACK call of jaxlib 0.10 waits, in a thread of the pool,
for work that is queued on the same pool. If all threads make such calls, they wait for ever (observed with
two threads and 24 independent batches of 30,000 solves). jaxlib 0.11 no longer splits batches.

Why loops are compiled into one function: by default, XLA does so only if its body touches less than 1 kB.
Otherwise it starts each operation separately, and a motion of one disc by XLA takes 8.3 ms instead of 0.6 ms.
Machine code is not affected.
"""

import os

import jax

from jourdain_jax.calculus.files import whole_number

MOST_THREADS = 1024  # tuning: each thread reserves 8 MB of address space for its stack
_POOL = ("PJRT_NPROC", "NPROC")
_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1048576"


def configure(*, threads: int | None = None, xla_threads: int | None = None) -> dict[str, str]:
    """Set what JAX and the machine code read from the environment, and return these variables by name.

    Call it before the first computation of JAX. Without such a call, the first use of any other public name
    or package applies the defaults, if JAX has not computed anything yet. Variables that are set already are
    kept.

        jj.configure(threads=8)  # the first line after `import jourdain_jax as jj`

    **Arguments**

    - `threads`: threads that share a batch in machine code (`JOURDAIN_JAX_THREADS`); default: one per core.
    - `xla_threads`: threads of XLA on the CPU (`PJRT_NPROC`); default: one per core, at least 16, because
      batches on dense matrices may wait for ever on fewer threads with jaxlib 0.10.

    `XLA_FLAGS` gets an option that compiles loops which touch less than 1 MB into one function, unless it
    contains `xla_backend_extra_options`: motions by XLA are then four to ten times as fast.

    **Raises** RuntimeError if JAX has already computed something.
    """
    if _has_started():
        raise RuntimeError(
            "JAX has already computed something, and reads these settings only once; call `jj.configure()` "
            "before the first computation of JAX and before the first scene is made"
        )
    stated = {"JOURDAIN_JAX_THREADS": (threads, "`threads`"), "PJRT_NPROC": (xla_threads, "`xla_threads`")}
    for variable, (count, what) in stated.items():
        if count is not None:
            os.environ[variable] = str(whole_number(str(count), what, MOST_THREADS))
    return _with_defaults()


def configure_by_default() -> None:
    """Apply the defaults of `configure`, unless they are set or JAX has already computed something."""
    flags = os.environ.get("XLA_FLAGS", "")
    complete = "xla_backend_extra_options" in flags and not os.environ.keys().isdisjoint(_POOL)
    if not (complete or _has_started()):
        _with_defaults()


def _with_defaults() -> dict[str, str]:
    if os.environ.keys().isdisjoint(_POOL):
        os.environ["PJRT_NPROC"] = str(max(16, os.cpu_count() or 1))
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_LOOPS}".strip()
    names = ("JOURDAIN_JAX_THREADS", *_POOL, "XLA_FLAGS")
    return {name: os.environ[name] for name in names if name in os.environ}


def _has_started() -> bool:
    """Return whether JAX has computed anything, after which its settings are fixed."""
    devices = jax.config.jax_num_cpu_devices
    try:
        jax.config.update("jax_num_cpu_devices", devices + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False
