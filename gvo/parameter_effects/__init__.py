"""What the runs of a batch tell of its parameters and of its configurations."""

from gvo.parameter_effects.effects import ParameterEffect, ValueEffect, parameter_effects
from gvo.parameter_effects.front import VariantMean, accuracy_front, is_non_dominated
from gvo.parameter_effects.runs import MIN_SHARE_OF_POSES, Runs

__all__ = [
    "MIN_SHARE_OF_POSES",
    "ParameterEffect",
    "Runs",
    "ValueEffect",
    "VariantMean",
    "accuracy_front",
    "is_non_dominated",
    "parameter_effects",
]
