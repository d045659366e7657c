"""One frame explained: what the front-end and the window did with it, step by step."""

from gvo.diagnostics.explain.frame import explain_frame
from gvo.diagnostics.explain.values import FrameExplanation

__all__ = ["FrameExplanation", "explain_frame"]
