"""The manifest of a study: digests of the files that are written once."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from jourdain_jax.calculus.files import write_whole

MANIFEST, GRID = "run/manifest.json", "run/grid.json"


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def digest_of(digests: Mapping[str, str]) -> str:
    return digest(json.dumps(digests, sort_keys=True).encode())


def write_manifest(path: Path, digests: Mapping[str, str]) -> None:
    write_whole(
        path / MANIFEST,
        json.dumps({"digests": dict(digests), "digest": digest_of(digests)}, indent=1).encode(),
        wait=True,
    )
