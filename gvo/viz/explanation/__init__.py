"""An explained frame as pictures, numbers and a page."""

from gvo.viz.explanation.write import open_folder, write_explanation

__all__ = ["open_folder", "write_explanation"]
