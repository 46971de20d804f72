"""How Sphinx builds the documentation: warnings are errors, and every figure is computed anew."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "tests" / "helpers")]

project = "vstent"
author = "The vstent developers"
copyright = "The vstent developers. Research use only: not cleared for diagnosis or treatment."
version = release = version_of("vstent")

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx_gallery.gen_gallery", "pages"]
exclude_patterns = ["_build", "recorded", "generated/*.inc", "gallery"]
html_theme = "furo"
html_title = "vstent"
nitpicky = False
default_role = "code"
suppress_warnings = ["config.cache"]

autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_rtype = False

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "examples",
    "filename_pattern": "/",
    "abort_on_example_error": True,
    "only_warn_on_example_error": False,
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "remove_config_comments": True,
    "write_computation_times": False,
    "plot_gallery": "True",
}
