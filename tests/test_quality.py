"""Static checks: ruff over the repository, mypy over the package."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def _run(*command: str):
    return subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)


def test_ruff_finds_nothing():
    result = _run("ruff", "check", "--no-cache", "--output-format=concise", ".")
    assert result.returncode == 0, result.stdout + result.stderr


def test_types_hold():
    result = _run("mypy")
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_list_of_slow_tests_names_tests_that_exist():
    lines = [
        line for line in (ROOT / "tests" / "slow.txt").read_text().splitlines() if not line.startswith("#")
    ]
    assert len(set(lines)) == len(lines)
    for line in lines:
        file, _, name = line.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / "tests" / file).read_text(), line


MODULES = r"(?:asynchat|asyncore|distutils|imp|smtpd|pkg_resources)\b"
OF_JAX = (
    r"(?:abstract_arrays|interpreters\.xla|lib\.xla_bridge|linear_util"
    r"|tree_(?:flatten|leaves|map|unflatten)|util|xla_computation)\b"
)
OF_NUMPY = r"\b(?:jnp\.round_|j?np\.(?:in1d|row_stack|trapz))\b"
EXPERIMENTAL = r"\bjax\.experimental(?:\.| import )(?:host_callback|maps)\b"
OF_CORE = r"\bjax\.core(?:\.| import )(?!Tracer\b)"  # it keeps little else that is public
PATTERN = re.compile(
    rf"^\s*(?:import|from) {MODULES}|\bjax(?:\.| import"
    rf" ){OF_JAX}|{OF_NUMPY}|{EXPERIMENTAL}|{OF_CORE}|\butcnow\b|\bpkgutil\.ImpImporter\b",
    re.MULTILINE,
)


def test_no_source_uses_what_newer_versions_lack():
    sources = [
        path
        for folder in ("src", "tests", "bench", "notebooks")
        for path in (ROOT / folder).rglob("*.py")
        if path != Path(__file__)
    ]
    assert sources
    assert [
        (path.name, found[0])
        for path in sources
        for found in PATTERN.finditer(path.read_text(encoding="utf-8"))
    ] == []


@pytest.mark.parametrize(
    "text",
    [
        "import distutils.version",
        "from imp import reload",
        "jax.tree_map(f, x)",
        "from jax.core import Primitive",
        "jax.core.pp_eqn",
        "from jax.experimental import host_callback",
        "datetime.datetime.utcnow()",
    ],
)
def test_the_reader_sees_what_is_removed(text):
    assert PATTERN.search(text)
    assert not PATTERN.search(
        "jax.tree.map(f, x); isinstance(x, jax.core.Tracer); jax.tree_util; np.trapezoid(y)"
    )
