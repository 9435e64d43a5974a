"""The gate before tracking: what a source states, assumes and delivers, compared before a frame is used.

Each reader (folder, data set, bag, video, device) fills in `SourceFacts` and calls `check_source`, which
knows no file and no device.  Two facts that contradict each other raise an error with both of them.  What is
only unlikely is a `Doubt`: the source is used, the doubt is printed, and the check of the drive gives no
advice until the user accepts the doubt by its name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.config.validation import did_you_mean
from rse_pf.errors import RsePfError, UsageError
from rse_pf.geometry import Array, Lens

__all__ = [
    "CameraFacts", "DepthFacts", "Doubt", "DoubtLog", "DoubtName", "LossFacts", "SourceFacts", "TimeFacts",
    "VideoFacts", "check_accepted", "check_reference", "check_source", "doubt_line", "ended_early",
    "is_since_1970", "median_depth_m", "rows_in_time", "some_names", "stamps_in_seconds", "time_unit_s",
    "unresolved",
]  # fmt: skip

MIN_MEDIAN_DEPTH_M = 0.05  # nearer than any depth camera measures
MAX_MEDIAN_DEPTH_M = 30.0  # farther than any depth camera measures
MIN_ASSUMED_MEDIAN_DEPTH_M = 0.2  # of a depth unit that nobody stated
MAX_ASSUMED_MEDIAN_DEPTH_M = 6.0  # of a depth unit that nobody stated: rooms are smaller
MIN_INTERVAL_S = 1e-4  # no camera is faster than 10,000 Hz
MAX_INTERVAL_S = 1e3  # slower than any drive: the unit of the time stamps is wrong
_EPOCH_S = (1e9, 1e10)  # seconds since 1970 of the years 2001 to 2286
_UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_USUAL_LOSS = 0.1  # of the images of a camera that runs freely beside another find no partner
_MAX_APART = 0.5  # frames between the last images of two videos that were recorded together
_MAX_NAMED = 12  # files that one sentence names at most


class DoubtName(str, Enum):
    """The names of doubts, as ``--accept`` takes them; the values are stable."""

    TIME_ORDER = "time-order"  # time stamps go back: the clock was set in the drive
    EQUAL_STAMPS = "equal-stamps"  # several images have one time stamp
    REFERENCE_TIMES = "reference-times"  # truth or odometry has no time stamp within the recording
    LEFT_OUT = "left-out"  # images were damaged, empty or without a partner
    ENDED_EARLY = "ended-early"  # the source failed in the drive
    CAMERA_CHANGES = "camera-changes"  # several calibrations are stated in one drive
    DEPTH_REGISTRATION = "depth-registration"  # nothing says that depth is registered to the colour image
    DEPTH_ALONG_RAY = "depth-along-ray"  # depth is measured along the ray, not along the optical axis
    STATIC_PATTERN = "static-pattern"  # something stands still in the image while the camera moves
    FROZEN_IMAGES = "frozen-images"  # the driver repeats an image
    MOVING_OBJECTS = "moving-objects"  # something moves in most of the view


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubt:
    """Something unlikely that was found in a source; *hint* is the action that settles it."""

    name: DoubtName
    sentence: str
    hint: str

    def line(self) -> str:
        """Return the doubt in one line for people."""
        return doubt_line(self.to_dict())

    def to_dict(self) -> dict[str, str]:
        """Return what a report holds of the doubt."""
        return {"name": self.name.value, "sentence": self.sentence, "hint": self.hint}


def doubt_line(told: Mapping[str, Any]) -> str:
    """Return a doubt of a report in one line for people."""
    name = told.get("name")
    return f"finding {name}: {told.get('sentence')}; {told.get('hint')}, or --accept {name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFacts:
    """A camera as its source states it (*stated_by* is a file or topic), and the images that it delivers."""

    stated_by: str
    lens: Lens
    image_size_px: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFacts:
    """Depth of some frames: its median, m (None without a reading), and the unit that gave it.

    ``is_registered`` says whether depth images show the view of the colour camera; None if nobody stated it.
    """

    median_m: float | None
    units_per_m: float
    is_unit_stated: bool
    is_registered: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LossFacts:
    """Images that a source states and does not deliver: *lost* of *total*; *sentence* says which, and why.

    ``is_usual`` says that a few of them are lost by all recorders: two cameras that run freely lose partners.
    """

    sentence: str
    lost: int
    total: int
    is_usual: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFacts:
    """How many images a video states, and the mean time between them."""

    frames: int
    period_s: float

    @property
    def last_s(self) -> float:
        """When the last image is shown, seconds after the first."""
        return (self.frames - 1) * self.period_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeFacts:
    """Time stamps ``(n,)`` in seconds, in the order of the source; *stated_by* is a file or topic."""

    stated_by: str
    stamps_s: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceFacts:
    """What a source states, what was assumed, and what it delivers.

    Attributes:
        name: Of the source, for people.
        cameras: As they are stated, before undistortion and rectification.
        depth: None without depth.
        times: Of the images, of each camera that has its own.
        videos: Of the two videos of a pair, by their names.
        references: Times of the truth and of the odometry.
        losses: Images that are left out.
        doubts: What the reader itself met.
        assumed: Sentences on what the source does not state.
    """

    name: str
    cameras: Sequence[CameraFacts] = ()
    depth: DepthFacts | None = None
    times: Sequence[TimeFacts] = ()
    videos: Mapping[str, VideoFacts] = field(default_factory=dict)
    references: Sequence[TimeFacts] = ()
    losses: Sequence[LossFacts] = ()
    doubts: Sequence[Doubt] = ()
    assumed: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What is said about the source and needs no action: what was assumed, and losses that are usual."""
        return (*self.assumed, *(loss.sentence for loss in self.losses if not _is_finding(loss)))

    @property
    def span_s(self) -> tuple[float, float] | None:
        """The first and the last time stamp of the images; None if they are not known before the drive."""
        stamps_s = np.concatenate([each.stamps_s for each in self.times]) if self.times else np.empty(0)
        return (float(stamps_s.min()), float(stamps_s.max())) if len(stamps_s) else None


class DoubtLog:
    """The doubts about a source: those of the gate, and those that appear while the source is read."""

    def __init__(self, doubts: Iterable[Doubt] = ()) -> None:
        self._doubts = list(doubts)
        self._left_out: list[str] = []

    def add(self, doubt: Doubt) -> None:
        """Add a doubt that appeared in the drive."""
        self._doubts.append(doubt)

    def add_reference(self, file: str, stamps_s: Array, span_s: tuple[float, float] | None) -> None:
        """Add a doubt if an odometry or truth has no time stamp within the span of the images."""
        if span_s is not None:
            reference = TimeFacts(stated_by=file, stamps_s=stamps_s)
            self._doubts += check_reference(reference, span_s)

    def leave_out(self, image: str) -> None:
        """Count an image that cannot be used, by its name."""
        self._left_out.append(image)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """All doubts so far, in the order in which they appeared."""
        if not self._left_out:
            return tuple(self._doubts)
        images = f"{len(self._left_out)} image" + ("s" if len(self._left_out) > 1 else "")
        left_out = Doubt(
            name=DoubtName.LEFT_OUT,
            sentence=f"{images} left out, damaged or empty: {some_names(self._left_out)}",
            hint="copy the recording again, or record it again",
        )
        return (*self._doubts, left_out)


def ended_early(error: RsePfError, frames: int) -> Doubt:
    """Return the doubt about a source that failed after it had delivered some frames."""
    sentence = f"the source failed after {frames} frames, which are kept: {error.message}"
    return Doubt(name=DoubtName.ENDED_EARLY, sentence=sentence, hint=error.hint)


def check_source(facts: SourceFacts) -> tuple[Doubt, ...]:
    """Return the doubts about a source.

    Raises:
        UsageError: Two facts contradict each other, or a fact is impossible.
    """
    return (*facts.doubts, *(doubt for rule in _RULES for doubt in rule(facts)))


def check_accepted(names: Iterable[str]) -> None:
    """Refuse names of ``--accept`` that are no doubt's; raises UsageError."""
    known = [each.value for each in DoubtName]
    for name in names:
        if name not in known:
            raise UsageError(
                f"--accept {name} names no finding",
                hint=did_you_mean(name, known, f"write one of {', '.join(known)}"),
            )


def unresolved(doubts: Iterable[Doubt], accepted: Iterable[str]) -> tuple[Doubt, ...]:
    """Return the doubts whose names are not accepted."""
    names = set(accepted)
    return tuple(doubt for doubt in doubts if doubt.name.value not in names)


def time_unit_s(stamps: Array) -> tuple[str, float]:
    """Return the name and the length, s, of the unit of time stamps ``(n,)`` that state none.

    Stamps since 1970 tell their unit by their size.  Of others it is the unit in which images come 0.1 to
    100 times a second.
    """
    unit = _unit_since_1970(stamps)
    if unit is not None:
        return unit
    steps = np.diff(np.unique(stamps))
    interval = float(np.median(steps)) if len(steps) else 0.0
    if interval < 10.0:
        return "seconds", 1.0
    if interval < 1e4:
        return "milliseconds", 1e-3
    return ("microseconds", 1e-6) if interval < 1e7 else ("nanoseconds", 1e-9)


def is_since_1970(stamps_s: Array) -> bool:
    """Return whether stamps ``(n,)`` are seconds since 1970, of the years 2001 to 2286."""
    return bool(len(stamps_s)) and _EPOCH_S[0] <= float(np.median(stamps_s)) < _EPOCH_S[1]


def _unit_since_1970(stamps: Array) -> tuple[str, float] | None:
    return next((unit for unit in _UNITS_S.items() if is_since_1970(stamps * unit[1])), None)


def stamps_in_seconds(
    stamps: Array, stated_by: str, layout_unit: str | None = None
) -> tuple[Array, tuple[str, ...]]:
    """Return time stamps ``(n,)`` in seconds, and a note where their unit was assumed.

    *layout_unit* is the unit that the format of the file prescribes; it counts unless the stamps are times
    since 1970 in another one.  None means seconds, unless the stamps look otherwise.
    """
    expected = layout_unit or "seconds"
    unit, unit_s = time_unit_s(stamps)
    if layout_unit is not None:
        unit, unit_s = _unit_since_1970(stamps) or (expected, _UNITS_S[expected])
    notes = () if unit == expected else (f"the time stamps of {stated_by} are taken as {unit}",)
    return stamps * unit_s if unit_s == 1.0 else stamps / round(1.0 / unit_s), notes


def median_depth_m(images: Iterable[npt.NDArray[np.float32]]) -> float | None:
    """Return the median reading, m, of ``(h, w)`` depth images; None without a reading."""
    readings = [some[some > 0] for some in (image[::8, ::8] for image in images)]
    known = np.concatenate(readings) if readings else np.empty(0, dtype=np.float32)
    return float(np.median(known)) if len(known) else None


def rows_in_time(times: TimeFacts) -> tuple[list[int], tuple[Doubt, ...]]:
    """Return the rows whose time stamps increase, and doubts about the others.

    Rows with the time stamp of the row before are left out.  The recording ends where the clock was set
    back.

    Raises:
        UsageError: The time stamps go back more than once, or at once: the rows are in no order of time.
    """
    steps_s = np.diff(times.stamps_s)
    backs = np.flatnonzero(steps_s < 0.0)
    total = len(times.stamps_s)
    if len(backs) > 1 or (len(backs) == 1 and backs[0] == 0):
        raise UsageError(
            f"{times.stated_by}: {len(backs)} of {total} time stamps are earlier than the one before, first "
            f"{times.stamps_s[backs[0] + 1]:.6f} s after {times.stamps_s[backs[0]]:.6f} s",
            hint="sort the images in the order in which they were taken, if their clock can be trusted",
        )
    doubts = []
    end = total
    if len(backs):
        end = int(backs[0]) + 1
        doubts.append(
            Doubt(
                name=DoubtName.TIME_ORDER,
                sentence=f"{times.stated_by}: the clock goes back by {-steps_s[end - 1]:.3f} s after "
                f"{times.stamps_s[end - 1]:.6f} s; the recording ends there, with {end} of {total} images",
                hint="make two recordings of it, one before and one after the jump",
            )
        )
    rows = [0][:total] + [row + 1 for row in range(end - 1) if steps_s[row] > 0.0]
    equal = end - len(rows)
    if equal:
        first_s = times.stamps_s[int(np.flatnonzero(steps_s[: end - 1] == 0.0)[0])]
        doubts.append(
            Doubt(
                name=DoubtName.EQUAL_STAMPS,
                sentence=f"{times.stated_by}: {equal} of {total} images have the time stamp of the image "
                f"before, first {first_s:.6f} s; they are left out",
                hint="write the time of each exposure, with all its digits",
            )
        )
    return rows, tuple(doubts)


def check_reference(reference: TimeFacts, span_s: tuple[float, float]) -> tuple[Doubt, ...]:
    """Return a doubt if a truth or an odometry has no time stamp within the span of the images."""
    stamps_s = reference.stamps_s
    if not len(stamps_s) or ((stamps_s >= span_s[0]) & (stamps_s <= span_s[1])).any():
        return ()
    sentence = (
        f"{reference.stated_by} has no time stamp within the recording: it covers {stamps_s.min():.3f}.."
        f"{stamps_s.max():.3f} s, the images {span_s[0]:.3f}..{span_s[1]:.3f} s"
    )
    hint = "write its time stamps in seconds of the clock of the images"
    return (Doubt(name=DoubtName.REFERENCE_TIMES, sentence=sentence, hint=hint),)


def some_names(names: Sequence[str]) -> str:
    """Return the first names of a list, and how many there are."""
    more = len(names) - _MAX_NAMED
    return ", ".join(names[:_MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _check_cameras(facts: SourceFacts) -> Iterable[Doubt]:
    for each in facts.cameras:
        camera = each.lens.camera
        size = (camera.width, camera.height)
        if each.image_size_px is not None and each.image_size_px != size:
            raise UsageError(
                f"{facts.name} has images of {each.image_size_px[0]}x{each.image_size_px[1]} px, "
                f"{each.stated_by} is for {size[0]}x{size[1]} px",
                hint="give the intrinsics of this size: scale fx fy cx cy with the image",
            )
        if not (0.0 <= camera.cx <= camera.width and 0.0 <= camera.cy <= camera.height):
            raise UsageError(
                f"{each.stated_by}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside of the "
                f"image of {size[0]}x{size[1]} px",
                hint="give the intrinsics of this size: scale fx fy cx cy with the image",
            )
        smallest_deg, largest_deg = each.lens.plausible_field_of_view_deg
        if not smallest_deg <= each.lens.field_of_view_deg <= largest_deg:
            raise UsageError(
                f"{each.stated_by}: fx {camera.fx:g} fy {camera.fy:g} at {size[0]}x{size[1]} px is a "
                f"field of view of {each.lens.field_of_view_deg:.0f} degrees, not within "
                f"{smallest_deg:g}..{largest_deg:g}",
                hint="give fx and fy in pixels of this image size; a wide lens has model fisheye",
            )
    return ()


def _check_depth(facts: SourceFacts) -> Iterator[Doubt]:
    depth = facts.depth
    if depth is not None and depth.is_registered is False:
        yield Doubt(
            name=DoubtName.DEPTH_REGISTRATION,
            sentence=f"depth of {facts.name} is stated not to be registered to the colour image, and is used "
            "as if it were",
            hint="record depth that the driver has aligned to the colours",
        )
    if depth is not None and depth.median_m is not None:
        low, high = MIN_MEDIAN_DEPTH_M, MAX_MEDIAN_DEPTH_M
        if not depth.is_unit_stated:
            low, high = MIN_ASSUMED_MEDIAN_DEPTH_M, MAX_ASSUMED_MEDIAN_DEPTH_M
        if not low <= depth.median_m <= high:
            how = "" if depth.is_unit_stated else "assumed "
            raise UsageError(
                f"the median depth of {facts.name} is {depth.median_m:g} m at {how}{depth.units_per_m:g} "
                f"units a metre, not within {low:g}..{high:g} m",
                hint="state the unit of depth: depth_scale 1000 for mm, 5000 for TUM, 4000 for 0.25 mm",
            )


def _check_times(facts: SourceFacts) -> Iterator[Doubt]:
    named: set[DoubtName] = set()
    for each in facts.times:
        # Colour and depth of one driver have one fault.
        doubts = [doubt for doubt in rows_in_time(each)[1] if doubt.name not in named]
        named |= {doubt.name for doubt in doubts}
        yield from doubts
        steps_s = np.diff(np.unique(each.stamps_s))
        interval_s = float(np.median(steps_s)) if len(steps_s) else 1.0
        if not MIN_INTERVAL_S <= interval_s <= MAX_INTERVAL_S:
            raise UsageError(
                f"{each.stated_by}: images are {interval_s:g} s apart in the median, not within "
                f"{MIN_INTERVAL_S:g}..{MAX_INTERVAL_S:g} s",
                hint="correct the unit of the time stamps",
            )


def _is_finding(loss: LossFacts) -> bool:
    return loss.lost > (_USUAL_LOSS * loss.total if loss.is_usual else 0)


def _check_losses(facts: SourceFacts) -> Iterator[Doubt]:
    for loss in facts.losses:
        if _is_finding(loss):
            yield Doubt(
                name=DoubtName.LEFT_OUT, sentence=loss.sentence,
                hint="copy the recording again, or record it again",
            )  # fmt: skip


def _check_videos(facts: SourceFacts) -> Iterable[Doubt]:
    """Refuse two videos whose last images have different times: where the times differ, no one can tell.

    A camera that lost an image delivers a shorter video with times in equal steps, as one does that was
    stopped earlier.  Where the times have a gap for the lost image, both videos end at the same time.
    """
    if len(facts.videos) == 2:
        (name, video), (other_name, other) = facts.videos.items()
        if abs(video.last_s - other.last_s) > _MAX_APART * min(video.period_s, other.period_s):
            raise UsageError(
                f"{name} has {video.frames} images until {video.last_s:.3f} s, {other_name} {other.frames} "
                f"until {other.last_s:.3f} s: their times do not say which images belong together",
                hint="record the time of each image (MP4, MKV or a bag), cut both videos to the same images, "
                "or take one: --camera left",
            )
    return ()


def _check_references(facts: SourceFacts) -> Iterator[Doubt]:
    span_s = facts.span_s
    for each in facts.references:
        if span_s is not None:
            yield from check_reference(each, span_s)


_RULES: tuple[Callable[[SourceFacts], Iterable[Doubt]], ...] = (
    _check_cameras, _check_depth, _check_times, _check_losses, _check_videos, _check_references,
)  # fmt: skip
