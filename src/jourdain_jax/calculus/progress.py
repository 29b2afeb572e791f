"""Work that may take seconds: a message in terminals and notebooks, and no search for unreachable objects."""

import gc
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def announced(what: str) -> Iterator[None]:
    """Return a context that prints `what` to stderr after 2 s, in a terminal or a notebook only."""
    seen = sys.stderr.isatty() or "ipykernel" in sys.modules
    message = threading.Timer(2.0, print, (f"jourdain-jax: {what}",), {"file": sys.stderr, "flush": True})
    message.daemon = True
    if seen:
        message.start()
    try:
        yield
    finally:
        message.cancel()


@contextmanager
def all_objects_kept() -> Iterator[None]:
    """Return a context in which Python does not look for unreachable objects. Graphs and their texts are
    millions of reachable ones, and each search visits all objects of JAX, too.
    """
    looks = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if looks:
            gc.enable()
