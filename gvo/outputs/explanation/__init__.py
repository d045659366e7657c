"""An explained frame as pictures, numbers and a page."""

from gvo.outputs.explanation.writing import write_explanation

__all__ = ["write_explanation"]
