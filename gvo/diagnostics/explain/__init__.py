"""One frame explained: what front-end and window did with it, step by step."""

from gvo.diagnostics.explain.frame import explain_frame as explain_frame
from gvo.diagnostics.explain.values import FrameExplanation as FrameExplanation
