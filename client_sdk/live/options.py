"""Options of a robot in a live map: which keyframes it makes, and at which rates it sends them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from rse_pf.errors import UsageError
from rse_pf.slam.keyframe_points import MAX_POINTS

__all__ = ["LiveOptions"]

_MAX_JSON_FEATURES = 650
"""Most features of a keyframe that is sent with the codec ``json``, which writes bytes in base64, a third
longer: the message then has about 34 kB, the size of one with the default 870 features in ``zlib`` or
``bin``, so that the codec does not change how many keyframes the rate limit lets through."""
_MAY_BE_ZERO = ("points", "leave_s")  # options that may be 0: no points are sent; leaving does not wait


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """Options of a robot in a live map.

    The three rate limits are independent: together they may use their sum.

    Attributes:
        keyframe_m: A frame becomes a keyframe if its camera is farther than this from that of the last
            keyframe, in metres.  A camera without depth sends the keyframes of its tracker instead.
        keyframe_deg: A frame also becomes a keyframe if its camera is rotated by more than this against that
            of the last keyframe, in degrees.
        features: Most features of a keyframe that are sent: 870 take 34 kB with ``zlib`` and ``bin``;
            `sent_with` lowers the limit for ``json``.
        points: Most coloured points of a keyframe that are sent for the cloud of the map.  Fewer are sent
            while keyframes follow each other so fast that *points_bytes_per_s* would be exceeded.  0 sends
            none.
        points_bytes_per_s: Rate limit of the uploads of points, in bytes per second.
        images: Whether the images of keyframes are sent, if the operator allows it (``live.images``).
        images_bytes_per_s: Rate limit of the uploads of images, in bytes per second; while it is used up,
            keyframes are sent without an image.
        segment_after: Number of lost frames since the last pose after which a new segment begins.  Only
            frames with enough features count, so a covered lens begins no segment.  Not used without depth.
        relocalise_s: Shortest time between two relocalisations of a segment that is not aligned, in seconds;
            it becomes four times as long after six replies in a row that found no place in the map.
        bytes_per_s: Rate limit of the keyframes, in bytes per second.
        deadline_s: Deadline of one attempt to send a keyframe, and of one relocalisation, in seconds.
        leave_s: Longest time for which leaving the map waits until the map has acknowledged every keyframe
            and every attachment is uploaded, in seconds.

    Raises:
        UsageError: A number is not above 0 (*points* and *leave_s*: is below 0), or *points* is above 16,000.
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
        for name in (field.name for field in fields(self) if field.name != "images"):
            value = getattr(self, name)
            if value < 0 or (value == 0 and name not in _MAY_BE_ZERO):
                limit = "at least 0" if name in _MAY_BE_ZERO else "above 0"
                raise UsageError(f"{name} = {value:g} is not {limit}", hint="leave it out for the default")
        if self.points > MAX_POINTS:
            raise UsageError(
                f"points = {self.points} is above {MAX_POINTS}", hint=f"use at most {MAX_POINTS}"
            )

    def sent_with(self, codec: str) -> LiveOptions:
        """Return these options with at most 650 features if *codec*, that of the connection, is ``json``."""
        return replace(self, features=min(self.features, _MAX_JSON_FEATURES)) if codec == "json" else self
