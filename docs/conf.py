"""How Sphinx makes HTML of these pages: sphinx-build -W docs docs/_build."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from numpydoc.xref import DEFAULT_LINKS

import gvo
import gvo.errors

project = "gvo"
author = "gvo developers"
copyright = "gvo developers"
release = gvo.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]

# The pages are written for GitHub: links to headings, to files of the repository.
myst_heading_anchors = 3

# A name in single backticks is a link where the reference has it.
default_role = "py:obj"
autodoc_typehints = "none"
autodoc_member_order = "bysource"
add_module_names = False
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
# Types of Python and numpy link nowhere: the pages are built without a network.
numpydoc_xref_aliases = {
    **{name: name for name in DEFAULT_LINKS},
    **{name: f"gvo.{name}" for name in gvo.__all__},
    **{name: f"gvo.errors.{name}" for name in vars(gvo.errors) if name.endswith("Error")},
    "Source": "gvo.io.recording.Source",
    "Calibration": "gvo.geometry.camera.Calibration",
    "CheckResult": "gvo.diagnostics.check.findings.CheckResult",
    "Conversion": "gvo.io.convert.convert.Conversion",
    "FrameLink": "gvo.types.FrameLink",
    "SegmentJoin": "gvo.types.SegmentJoin",
}
smartquotes = False

html_theme = "furo"
html_title = f"gvo {release}"
