"""Closed forms use nothing of the package. They are compared with motions of the engine, which tests both."""

from pathlib import Path


def test_the_oracles_do_not_know_the_package():
    for path in (Path(__file__).parent / "oracles").glob("*.py"):
        assert "jourdain_jax" not in path.read_text(), path
