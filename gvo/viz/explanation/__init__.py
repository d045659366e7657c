"""An explained frame as pictures and a page."""

from gvo.viz.explanation.write import write_explanation as write_explanation
