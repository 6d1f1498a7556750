"""The site made of these pages: `sphinx-build -W docs build/site`, with the packages of `pip install -e '.[docs]'`."""

import sys
from pathlib import Path

import telebip

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "telebip"
version = release = telebip.__version__
html_title = "telebip"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "docstrings",
    "generated",
    "mathml",
]
exclude_patterns = ["_ext", "build"]

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
html_show_sphinx = False
html_copy_source = html_show_copyright = False
highlight_language = "bash"
pygments_style, pygments_dark_style = "tango", "monokai"

myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3  # `page.md#a-heading`, as on GitHub

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 90
napoleon_numpy_docstring = False
