"""How the documentation is built: `python -m sphinx -W -j auto -b html docs docs/_build/html`. Nothing is
fetched while it is built or read.
"""

import os
import shutil
import subprocess
import sys
from importlib.metadata import version as installed
from pathlib import Path

# A page runs once: less effort on machine code saves a third of the time. The kernels that run the tutorials
# inherit this.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))  # for `sphinx_parts`

project = "jourdain-jax"
author = "The jourdain-jax developers"
copyright = author
version = release = installed("jourdain-jax")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_design",
    "sphinx_parts.docstrings",
    "sphinx_parts.mathml",
    "sphinx_parts.search",
]
exclude_patterns = ["_build", "gallery/scenes", "README.md", "**.ipynb_checkpoints"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["mystnb.unknown_mime_type"]
default_role = "literal"  # docstrings quote code with single backticks

# Pages run when the site is built, but for the notebooks that take minutes: these hold what their own runs
# printed.
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / ".jupyter_cache")
nb_execution_timeout = 240
nb_execution_raise_on_error = True
nb_execution_excludepatterns = [
    "tutorials/notebooks/02*",
    "tutorials/notebooks/04*",
    "tutorials/notebooks/05*",
    "tutorials/notebooks/06*",
]
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
maximum_signature_line_length = 90

templates_path = ["_templates"]
html_theme = "furo"
html_title = f"jourdain-jax {version}"
html_static_path = ["_static"]
html_extra_path = ["gallery/pages/extra"]  # 3D views, which pages of the gallery embed
html_favicon = "_static/logo.svg"
html_theme_options = {"light_logo": "logo.svg", "dark_logo": "logo_dark.svg"}
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"


def _notebooks_in_place() -> None:
    """The executed notebooks of the repository as pages."""
    target = HERE / "tutorials" / "notebooks"
    target.mkdir(exist_ok=True)
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copyfile(notebook, target / notebook.name)


def _gallery_in_place() -> None:
    """The pages of the gallery, where they were not written yet (80 s on two cores)."""
    if not (HERE / "gallery" / "pages" / "index.md").exists():
        subprocess.run([sys.executable, str(HERE / "make_gallery.py")], check=True)


_notebooks_in_place()
_gallery_in_place()
