"""The sources hold with Python 3.12 and with newer versions of JAX: no syntax or name that those no longer have.

A reading of the sources, so that it needs no other interpreter; where one of version 3.12 is at hand, it compiles them as well.
"""

import ast
import re
import shutil
import subprocess
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for folder in ("src", "tests", "bench", "notebooks") for path in (ROOT / folder).rglob("*.py"))

REMOVED_MODULES = {"asynchat", "asyncore", "distutils", "imp", "smtpd", "pkg_resources"}  # from Python 3.12, and setuptools from its environments
REMOVED_NAMES = (
    "datetime.datetime.utcnow",
    "datetime.utcnow",
    "jax.abstract_arrays",
    "jax.core.Primitive",
    "jax.core.ShapedArray",
    "jax.core.concrete_or_error",
    "jax.core.get_aval",
    "jax.experimental.host_callback",
    "jax.experimental.maps",
    "jax.interpreters.xla",
    "jax.lib.xla_bridge",
    "jax.linear_util",
    "jax.tree_flatten",
    "jax.tree_leaves",
    "jax.tree_map",
    "jax.tree_unflatten",
    "jax.util",
    "jax.xla_computation",
    "jnp.in1d",
    "jnp.round_",
    "jnp.row_stack",
    "jnp.trapz",
    "np.in1d",
    "np.row_stack",
    "np.trapz",
    "pkgutil.ImpImporter",
)
STILL_IN_CORE = {"Tracer"}  # `jax.core` keeps little else that is public


def _dotted(node: ast.AST) -> str:
    """`a.b.c` of an attribute; empty for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    head = _dotted(node.value) if isinstance(node, ast.Attribute) else ""
    return f"{head}.{node.attr}" if head else ""


def removed(text: str) -> list[str]:
    """What a source uses that Python 3.12 or a newer JAX lacks."""
    used: set[str] = set()
    for node in ast.walk(ast.parse(text, feature_version=(3, 12))):
        if isinstance(node, ast.Import):
            used |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            used |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
        elif isinstance(node, ast.Attribute):
            used.add(_dotted(node))
    gone = {name for name in used if name in REMOVED_NAMES or name.startswith(tuple(f"{old}." for old in REMOVED_NAMES))}
    gone |= {name for name in used if name.split(".")[0] in REMOVED_MODULES}
    return sorted(gone | {name for name in used if (found := re.match(r"jax\.core\.(\w+)", name)) and found[1] not in STILL_IN_CORE})


def test_no_source_uses_what_newer_versions_lack():
    assert SOURCES
    found = {str(path.relative_to(ROOT)): removed(path.read_text()) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def test_no_source_has_an_invalid_escape():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a SyntaxWarning in 3.12, a DeprecationWarning before
        for path in SOURCES:
            compile(path.read_text(), str(path), "exec")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("import distutils.version", "distutils.version"),
        ("from imp import reload", "imp"),
        ("import jax\njax.tree_map(f, x)", "jax.tree_map"),
        ("from jax.core import Primitive", "jax.core.Primitive"),
        ("import jax\njax.core.pp_eqn", "jax.core.pp_eqn"),
        ("from jax.experimental import host_callback", "jax.experimental.host_callback"),
        ("import datetime\ndatetime.datetime.utcnow()", "datetime.datetime.utcnow"),
        ("import jax\njax.tree.map(f, x); isinstance(x, jax.core.Tracer)", None),
    ],
)
def test_the_reader_sees_what_is_removed(text, name):
    assert (removed(text) == []) if name is None else (name in removed(text))


def test_sources_compile_under_python_3_12_where_it_is_installed(tmp_path):
    python = shutil.which("python3.12")
    # the name may be a stub that only says that the version is not installed
    if python is None or subprocess.run([python, "--version"], capture_output=True).returncode != 0:
        pytest.skip("no Python 3.12 here")
    script = "import sys\nfor path in sys.argv[1:]: compile(open(path, encoding='utf-8').read(), path, 'exec')"
    run = subprocess.run([python, "-W", "error", "-c", script, *map(str, SOURCES)], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
