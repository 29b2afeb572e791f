"""Argument parser, entry point and exit codes of the command line.

Exit codes: 0 success; 1 a failed check (verification, incomplete motion, rejected file); 2 wrong usage
(unknown verb, name or option, unreadable file, bad number).
"""

import argparse
import gc
import os
import sys
from collections.abc import Sequence

import jaxlib

from jourdain_jax.calculus.lazy_imports import version_of
from jourdain_jax.cli.bicycle_verbs import add as add_bicycle_verbs
from jourdain_jax.cli.model_verbs import add as add_model_verbs
from jourdain_jax.cli.sweep_verbs import add as add_sweep_verb
from jourdain_jax.scene.coordinates import nearest
from jourdain_jax.studies.records import InUseError

OK, FAILED, USAGE = 0, 1, 2  # code
QUICKLY = "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
VERBS = ("models", "report", "verify", "simulate", "bicycle", "demo", "sweep")


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    top = argparse.ArgumentParser(
        prog="jourdain-jax",
        description="Dynamics of holonomic and nonholonomic mechanical systems.",
        epilog=(
            "exit codes: 0 success; 1 failed check, incomplete motion or rejected file; 2 "
            "wrong usage or unknown name"
        ),
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {version_of('jourdain-jax')}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    add_model_verbs(verbs)
    add_bicycle_verbs(verbs)
    add_sweep_verb(verbs)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    # tracing makes millions of short-lived objects, so a short process collects garbage rarely
    if arguments is None:
        gc.freeze()
        gc.set_threshold(50_000, 20, 20)
        # cheaper compilation for programs that run once; other versions of jaxlib may not know the flags
        if jaxlib.__version__.startswith("0.10."):
            os.environ["XLA_FLAGS"] = f"{QUICKLY} {os.environ.get('XLA_FLAGS', '')}"
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments and not arguments[0].startswith("-") and arguments[0] not in VERBS:
        print(f"jourdain-jax: unknown verb `{arguments[0]}`; {nearest(arguments[0], VERBS)}", file=sys.stderr)
        return USAGE
    options = parser().parse_args(arguments)
    try:
        return OK if options.run(options) else FAILED
    except (ValueError, InUseError, ImportError) as error:
        print(f"jourdain-jax: {error}", file=sys.stderr)
        return USAGE
    except BrokenPipeError:  # the process that reads our output (head, less) has exited
        sys.stderr.close()
        return OK
    except OSError as error:
        where = f"`{error.filename}`: " if error.filename else ""
        print(
            f"jourdain-jax: cannot read or write {where}{error.strerror or error}; check "
            "the path and its permissions",
            file=sys.stderr,
        )
        return USAGE
