"""How a robot takes part in a live map: which keyframes it makes, and how it sends them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rse_pf.errors import UsageError
from rse_pf.slam.keyframe_points import MAX_POINTS

__all__ = ["LiveOptions"]

_JSON_FEATURES = 650
"""Plain JSON has bytes in base64, a third longer: 650 features and the rest of the message are 34 kB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """How a robot takes part in a live map.

    Attributes:
        keyframe_m: A frame farther from the last keyframe becomes one,
        keyframe_deg: or turned further; the tracker's own keyframes are apart from these.  A camera without
            depth sends those of its tracker.
        features: At most so many features of a keyframe are sent; 870 take 34 kB with zlib and bin, and
            `sent_with` lowers them for json.
        points: At most so many coloured points of a keyframe are sent for the cloud of the map, fewer where
            keyframes follow each other fast; 0 sends none.
        points_bytes_per_s: Share of the link that points may take.
        images: Whether the image of a keyframe is sent, too, where the operator allows it (``live.images``).
        images_bytes_per_s: Share of the link that images may take; a keyframe beyond it has none.
        segment_after: A new segment begins after so many frames that show enough and no place that the robot
            knows; a covered lens does not count.
        relocalise_s: While a segment is not aligned, the robot asks for its place so often at most; after six
            answers without any place, a quarter as often, since the map tries each of its keyframes, too.
        bytes_per_s: Share of the link that keyframes may take.
        deadline_s: Of one attempt to send a keyframe, and of a relocalisation.
        leave_s: How long leaving waits until the map has every keyframe.
    """

    keyframe_m: float = 0.1
    keyframe_deg: float = 6.0
    features: int = 870
    points: int = 12_500
    points_bytes_per_s: float = 36_000.0
    images: bool = True
    images_bytes_per_s: float = 100_000.0
    segment_after: int = 5
    relocalise_s: float = 0.5
    bytes_per_s: float = 262_144.0
    deadline_s: float = 5.0
    leave_s: float = 5.0

    def __post_init__(self) -> None:
        numbers = (
            self.keyframe_m, self.keyframe_deg, self.features, self.segment_after, self.relocalise_s,
            self.bytes_per_s, self.deadline_s, self.points_bytes_per_s,
            self.images_bytes_per_s,
        )  # fmt: skip
        if min(numbers) <= 0 or min(self.leave_s, self.points) < 0:
            raise UsageError("a number of LiveOptions is not above 0", hint="leave it out for the default")
        if self.points > MAX_POINTS:
            raise UsageError(f"points = {self.points} is above {MAX_POINTS}", hint="12500 are enough")

    def sent_with(self, codec: str) -> LiveOptions:
        """Return these options with as many features as fit into 34 kB in *codec* of the connection."""
        return replace(self, features=min(self.features, _JSON_FEATURES)) if codec == "json" else self
