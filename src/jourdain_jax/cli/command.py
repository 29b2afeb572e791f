"""Parsing of the command line, and its exit codes.

Exit codes: 0 all went well; 1 something ran and failed its check (a verification, a motion that did not reach its end, a file refused);
2 the command was wrong (unknown verb, name or option, unreadable file, bad number).
"""

import argparse
import gc
import os
import sys
from collections.abc import Sequence

import jaxlib

from jourdain_jax.calculus.on_first_use import version_of
from jourdain_jax.cli.bicycle_verbs import add as add_bicycle_verbs
from jourdain_jax.cli.model_verbs import add as add_model_verbs
from jourdain_jax.cli.sweep_verbs import add as add_sweep_verb
from jourdain_jax.ensembles.files import InUseError
from jourdain_jax.scene.names import nearest

OK, FAILED, USAGE = 0, 1, 2
VERBS = ("models", "report", "verify", "simulate", "bicycle", "demo", "sweep")


def parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs."""
    top = argparse.ArgumentParser(
        prog="jourdain-jax",
        description="Dynamics of holonomic and nonholonomic mechanical systems.",
        epilog="exit codes: 0 well; 1 a check failed, a motion did not reach its end, or a file was refused; "
            "2 wrong usage or unknown name",
    )
    top.add_argument("--version", action="version", version=f"%(prog)s {version_of('jourdain-jax')}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    add_model_verbs(verbs)
    add_bicycle_verbs(verbs)
    add_sweep_verb(verbs)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code."""
    if arguments is None:  # as a process of its own. Tracing makes millions of objects that live for a moment: garbage is looked for rarely
        gc.freeze()
        gc.set_threshold(50_000, 20, 20)
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments and not arguments[0].startswith("-") and arguments[0] not in VERBS:
        print(f"jourdain-jax: unknown verb `{arguments[0]}`; {nearest(arguments[0], VERBS)}", file=sys.stderr)
        return USAGE
    options = parser().parse_args(arguments)
    if jaxlib.__version__.startswith("0.10."):  # less effort on programs that run once; another series may not know the flags
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false "
            "--xla_backend_optimization_level=0")
    try:
        return OK if options.run(options) else FAILED
    except (ValueError, InUseError, ImportError) as error:
        print(f"jourdain-jax: {error}", file=sys.stderr)
        return USAGE
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        sys.stderr.close()
        return OK
    except OSError as error:
        where = f"`{error.filename}`: " if error.filename else ""
        print(f"jourdain-jax: cannot read or write {where}{error.strerror or error}; check the path and its "
            "permissions", file=sys.stderr)
        return USAGE
