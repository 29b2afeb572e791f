"""Search with excerpts: Pagefind indexes the pages after they are written, and `_templates/search.html` asks
the index in the browser.

The browser reads the index by HTTP. To search a site on your own disk, serve its folder with
`python -m http.server`.
"""

import subprocess
import sys

from sphinx.application import Sphinx

OPTIONS = {  # the glob omits the index and the pages of source code
    "--root-selector": "article",
    "--exclude-selectors": "svg, .headerlink",
    "--include-characters": "_.",
    "--glob": "{[!_g]*.html,g[!e]*.html,{howto,tutorials,reference,gallery}/**/*.html}",
}


def _index(app: Sphinx, failure: Exception | None) -> None:
    if failure is None and app.builder.name == "html":
        options = [word for option in OPTIONS.items() for word in option]
        subprocess.run(
            [sys.executable, "-m", "pagefind", "--quiet", "--site", str(app.outdir), *options], check=True
        )


def setup(app: Sphinx) -> dict:
    """Index the site at the end of a build."""
    app.connect("build-finished", _index)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
