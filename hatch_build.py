"""Metadata that follow from the repository's address, the setting `repository` in pyproject.toml: the links
of the project and of its README.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface


class Links(MetadataHookInterface):
    """Fill in `urls` and `readme`. Without an address there are no links, and the README's stay relative."""

    def update(self, metadata: dict) -> None:
        """Set the two fields."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["urls"] = {}
        if repository := self.config["repository"].rstrip("/"):
            version = f"v{metadata['version']}"
            pages = {"Documentation": "docs/index.md", "Changelog": "CHANGELOG.md"}
            metadata["urls"] = {"Repository": repository, "Issues": f"{repository}/issues"}
            metadata["urls"] |= {name: f"{repository}/blob/{version}/{page}" for name, page in pages.items()}
            text = re.sub(r"(!\[[^]]*]\()(?!https?:)", rf"\g<1>{repository}/raw/{version}/", text)
            text = re.sub(r"((?<!!)\[[^]]*]\()(?!https?:|#)", rf"\g<1>{repository}/blob/{version}/", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
