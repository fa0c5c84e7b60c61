"""What of a model file is wanted."""

from __future__ import annotations

from typing import NamedTuple


class Options(NamedTuple):
    """What to read of a model besides its geometry, and how its images are filtered."""

    materials: bool = True  # without them a surface is white, and no image is read
    channels: tuple[str, ...] | None = None  # None: every channel that the materials state
    filter: str = "ewa"
    without: tuple[str, ...] = ()  # channels whose images are not read, as they come from elsewhere
    normals: bool = False  # the model's own, also where no normal map needs them
    pose: str | None = None  # NAME@SECONDS of an animation; None: as it rests

    def wants(self, channel: str) -> bool:
        """Say whether a channel is to be read."""
        is_named = self.channels is None or channel in self.channels
        return self.materials and is_named and channel not in self.without

    def wants_image(self, channel: str) -> bool:
        """Say whether a channel's image is to be read; colour is averaged by coverage: alpha comes along."""
        pair = ("base_color", "alpha")
        return any(map(self.wants, pair)) if channel in pair else self.wants(channel)
