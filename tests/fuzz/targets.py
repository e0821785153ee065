"""All targets by name."""

from . import media, models, scenes, texts
from .target import Target

TARGETS: dict[str, Target] = {target.name: target for room in (models, scenes, texts, media) for target in room.TARGETS}
