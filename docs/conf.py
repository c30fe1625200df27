"""Configuration of the documentation: `sphinx-build -W -b html docs docs/_build`."""

import re
import shutil
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.application import Sphinx

HERE = Path(__file__).parent
ROOT = HERE.parent
# Sphinx reads pages only below its own folder. Git ignores these copies.
COPIES = {"notebooks": "gallery", "experiments": "studies/experiments", "fits": "studies/fits"}

project = "foamfit"
author = "the foamfit authors"
copyright = f"2026, {author}"
version = release = version_of("foamfit")

extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "jupyter_execute", ".jupyter_cache", "studies/fits/README.md"]
suppress_warnings = ["toc.no_title"]  # some pages of studies are single tables

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False

html_theme = "furo"
html_title = f"foamfit {release}"
html_static_path = ["_static"]
html_css_files = ["formulas.css"]


def copy_pages() -> None:
    """Copy notebooks and studies, whose pages are part of the site."""
    for source, target in COPIES.items():
        shutil.rmtree(HERE / target, ignore_errors=True)
        ignored = shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(ROOT / source, HERE / target, ignore=ignored)


def link_to_copies(app: Sphinx, name: str, source: list[str]) -> None:
    """Let links to studies, which are right in the repository, lead to their copies."""
    source[0] = re.sub(r"\]\(\.\./(experiments|fits)/", r"](studies/\1/", source[0])


def setup(app: Sphinx) -> None:
    """Prepare the pages that lie elsewhere."""
    copy_pages()
    app.connect("source-read", link_to_copies)
