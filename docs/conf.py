"""Settings of the documentation; `make docs` builds it, and any warning fails the build."""

import os
import sys
from pathlib import Path

import jax
from nbclient import NotebookClient
from pygments.lexers.special import TextLexer
from sphinx.highlighting import lexers

from qfolio.core.version import __version__

jax.Array.__module__ = "jax"  # where its users find it
sys.path.append(str(Path(__file__).parent / "_extensions"))

project = "qfolio"
copyright = "The qfolio developers"
release = version = __version__

extensions = [
    "myst_nb",
    "reference",
    "signatures",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]

myst_enable_extensions = ["colon_fence", "dollarmath", "html_image"]
myst_heading_anchors = 4
# Notebooks run when they change; an error or a cell of more than five minutes fails the build.
nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
# What a command prints comes in pieces, which break in the middle of words; they are joined.
NotebookClient.coalesce_streams = True
# Notebooks type commands as readers do, and draw in the style of the reports.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["MATPLOTLIBRC"] = str(Path(__file__).parent / "matplotlibrc")
os.environ["TTY_COMPATIBLE"] = "0"  # no colors and no moving bars

autodoc_member_order = "bysource"
napoleon_use_ivar = True
maximum_signature_line_length = 80
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "qfolio"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
lexers["csv"] = TextLexer()  # Pygments has none
copybutton_prompt_text = "$ "
