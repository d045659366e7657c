"""All fuzzing targets by their names."""

from tests.fuzz import bags, messages, pictures, runs, settings, texts
from tests.fuzz.target import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (pictures, messages, bags, texts, settings, runs)
    for target in module.TARGETS
}
