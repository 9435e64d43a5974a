"""Facts that a recording or camera states about itself, and the refusal of facts that contradict each other.

Each reader (folder, data set, bag, video, device) fills in `SourceFacts`: what files and messages state, what
the reader assumed, and what the images show.  `check_source` compares these facts before a frame is tracked.
Facts that contradict each other are an error with both numbers.  Facts that are only unlikely are a `Doubt`,
which users see as a *finding*: the source is used, the finding is printed, and ``rse-pf check`` proposes no
calibration until the user accepts the finding by its name (``--accept NAME``).
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
    "CameraFacts",
    "DepthFacts",
    "Doubt",
    "DoubtLog",
    "DoubtName",
    "LossFacts",
    "SourceFacts",
    "TimeFacts",
    "VideoFacts",
    "check_accepted",
    "check_reference",
    "check_source",
    "doubt_line",
    "ended_early",
    "is_since_1970",
    "median_depth_m",
    "rows_in_time",
    "some_names",
    "stamps_in_seconds",
    "time_unit_s",
    "unresolved",
]

MIN_MEDIAN_DEPTH_M = 0.05
"""Where the unit of depth is stated, a source with a smaller median depth is refused: no camera measures
nearer."""
MAX_MEDIAN_DEPTH_M = 30.0
"""Where the unit of depth is stated, a source with a larger median depth is refused: no camera measures
farther."""
MIN_ASSUMED_MEDIAN_DEPTH_M = 0.2
"""Where the unit of depth is assumed, a source with a smaller median depth is refused: its unit is another
one."""
MAX_ASSUMED_MEDIAN_DEPTH_M = 6.0
"""Where the unit of depth is assumed, a source with a larger median depth is refused: rooms are smaller."""
MIN_INTERVAL_S = 1e-4
"""A source whose median time between images is shorter is refused: no camera is faster than 10,000 Hz."""
MAX_INTERVAL_S = 1e3
"""A source whose median time between images is longer is refused: the unit of its time stamps is wrong."""
_MIN_EPOCH_S = 1e9  # smallest median of time stamps that count as seconds since 1970: the year 2001
_MAX_EPOCH_S = 1e10  # median from which on time stamps do not count as seconds since 1970: the year 2286
_TIME_UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
"""Units that the time stamps of a recording may have, each with its length in seconds.  Time stamps count in
the first unit by which they are in the years 2001 to 2286, whatever the file's format prescribes; if there is
none, in the unit of the format, or in that which their median interval suggests (`time_unit_s`)."""
_USUAL_LOSS_SHARE = 0.1
"""Share of lost images, up to which a loss with `LossFacts.is_usual` is printed as a note and not as a
finding: of two cameras that are not triggered together, some images always have no partner."""
_MAX_VIDEO_END_DIFFERENCE = 0.5
"""Largest difference between the times of the last images of the two videos of a stereo pair, in image
intervals of the faster video; videos with a larger one are refused, because one of them lacks an image."""
_MAX_NAMES_IN_SENTENCE = 12  # files that one sentence names at most; the others are counted


class DoubtName(str, Enum):
    """Names of doubts, as users write them after ``--accept``; a value never changes."""

    TIME_ORDER = "time-order"  # time stamps go back, or those of a live source do not increase
    EQUAL_STAMPS = "equal-stamps"  # several images of a recording have the same time stamp
    REFERENCE_TIMES = "reference-times"  # ground truth or odometry has no time stamp within the recording
    LEFT_OUT = "left-out"  # images are not used: damaged, empty, or without a partner
    ENDED_EARLY = "ended-early"  # the source failed after it had delivered frames
    CAMERA_CHANGES = "camera-changes"  # several calibrations of one camera are stated in one recording
    DEPTH_REGISTRATION = "depth-registration"  # depth that is perhaps not registered is used as if it were
    DEPTH_ALONG_RAY = "depth-along-ray"  # depth is measured along the ray, not along the optical axis
    STATIC_PATTERN = "static-pattern"  # something is fixed in the image while the camera moves, such as dirt
    FROZEN_IMAGES = "frozen-images"  # the driver or the recorder repeats an image while the camera moves
    MOVING_OBJECTS = "moving-objects"  # something moves in most of the view


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubt:
    """An unlikely fact about a source; the source is used all the same until the user decides.

    Attributes:
        name: Kind of the doubt, which the user may accept.
        sentence: What is unlikely, with the numbers.
        hint: The action that removes the cause.
    """

    name: DoubtName
    sentence: str
    hint: str

    def line(self) -> str:
        """Return the doubt as one line of output, see `doubt_line`."""
        return doubt_line(self.to_dict())

    def to_dict(self) -> dict[str, str]:
        """Return the doubt as an object for a JSON report."""
        return {"name": self.name.value, "sentence": self.sentence, "hint": self.hint}


def doubt_line(doubt: Mapping[str, Any]) -> str:
    """Return one line of output for a doubt of a JSON report, as `Doubt.to_dict` made it."""
    name = doubt.get("name")
    return f"finding {name}: {doubt.get('sentence')}; {doubt.get('hint')}, or --accept {name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFacts:
    """A camera as its source states it, before undistortion and rectification.

    Attributes:
        stated_by: The file, topic or person that states the lens, for error messages.
        lens: The stated camera and its distortion.
        image_size_px: Width and height of the images; None if no image was read yet.
    """

    stated_by: str
    lens: Lens
    image_size_px: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFacts:
    """What a source states about its depth images, and the depth that some of them show.

    Attributes:
        median_m: Median reading of some depth images, m; None if they have no reading.
        units_per_m: Units of a depth image in a metre, by which the median was computed.
        is_unit_stated: Whether the source states this unit; else the reader assumed it.
        is_registered: Whether depth images show the view of the colour camera; None if nobody stated it.
    """

    median_m: float | None
    units_per_m: float
    is_unit_stated: bool
    is_registered: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LossFacts:
    """Images that a source lists, and that cannot be used.

    Attributes:
        sentence: Which images are lost, and why, for the user.
        lost: Number of lost images.
        total: Number of images that the source lists.
        is_usual: Whether every recorder loses some images in this way: of two cameras that are not triggered
            together, some images have no partner.
    """

    sentence: str
    lost: int
    total: int
    is_usual: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFacts:
    """The number of images that a video file states, and the mean time between them (s)."""

    frames: int
    period_s: float

    @property
    def last_s(self) -> float:
        """Time of the last image, seconds after the first."""
        return (self.frames - 1) * self.period_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeFacts:
    """Time stamps ``(n,)`` of images or poses, seconds, in the order in which the source lists them.

    ``stated_by`` is the file or topic that holds them, for error messages.
    """

    stated_by: str
    stamps_s: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceFacts:
    """All facts that a reader has about a source before the first frame is tracked.

    Attributes:
        name: Path or device of the source, for messages.
        cameras: The cameras whose images are used.
        depth: Facts about depth images; None if the source has none, or they are not used.
        times: Time stamps of the images, one entry for each camera with time stamps of its own.
        videos: Two videos of a stereo pair by their file names, else empty.
        references: Time stamps of the ground truth and of the odometry.
        losses: Images that cannot be used.
        doubts: Doubts that the reader had while it read the source.
        assumed: Sentences on what the source does not state, and the reader assumed.
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
        """Sentences for the user that need no action: what was assumed, and usual losses."""
        return (*self.assumed, *(loss.sentence for loss in self.losses if not _is_finding(loss)))

    @property
    def span_s(self) -> tuple[float, float] | None:
        """The smallest and largest time stamp of the images of all cameras, s.

        None if *times* is empty: the time stamps are then known only while images come.
        """
        stamps_s = np.concatenate([times.stamps_s for times in self.times]) if self.times else np.empty(0)
        return (float(stamps_s.min()), float(stamps_s.max())) if len(stamps_s) else None


class DoubtLog:
    """The doubts about a source: those of `check_source`, and those that arise while frames are read."""

    def __init__(self, doubts: Iterable[Doubt] = ()) -> None:
        self._doubts = list(doubts)
        self._left_out: list[str] = []

    def add(self, doubt: Doubt) -> None:
        """Add a doubt that arose while frames were read."""
        self._doubts.append(doubt)

    def add_reference(self, file: str, stamps_s: Array, span_s: tuple[float, float] | None) -> None:
        """Add a doubt if an odometry or ground truth has no time stamp within the span of the images.

        *stamps_s* ``(n,)`` are the time stamps of *file*, *span_s* the first and last one of the images.
        Without a time stamp, or with None for the span, nothing is added.
        """
        if span_s is not None:
            reference = TimeFacts(stated_by=file, stamps_s=stamps_s)
            self._doubts += check_reference(reference, span_s)

    def leave_out(self, image: str) -> None:
        """Note an image that cannot be used; *image* is its file name or time."""
        self._left_out.append(image)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """All doubts so far, with one doubt at the end for all images that were left out."""
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
    """Return the doubt about a source that failed with *error* after it had delivered *frames* frames."""
    sentence = f"the source failed after {frames} frames, which are kept: {error.message}"
    return Doubt(name=DoubtName.ENDED_EARLY, sentence=sentence, hint=error.hint)


def check_source(facts: SourceFacts) -> tuple[Doubt, ...]:
    """Compare the facts of a source with each other, and return all doubts about the source.

    The doubts of the reader come first, then those of the comparison.

    Raises:
        UsageError: Two facts contradict each other, or a fact is impossible.
    """
    return (*facts.doubts, *(doubt for check in _CHECKS for doubt in check(facts)))


def check_accepted(names: Iterable[str]) -> None:
    """Refuse names after ``--accept`` that are not in `DoubtName`; raises UsageError."""
    known = [name.value for name in DoubtName]
    for name in names:
        if name not in known:
            raise UsageError(
                f"--accept {name} names no finding",
                hint=did_you_mean(name, known, f"write one of {', '.join(known)}"),
            )


def unresolved(doubts: Iterable[Doubt], accepted: Iterable[str]) -> tuple[Doubt, ...]:
    """Return the doubts whose names the user has not accepted."""
    accepted_names = set(accepted)
    return tuple(doubt for doubt in doubts if doubt.name.value not in accepted_names)


def time_unit_s(stamps: Array) -> tuple[str, float]:
    """Return the name and the length (s) of the most likely unit of time stamps ``(n,)`` that state no unit.

    Time stamps since 1970 show their unit by their size.  All others show it by their median interval, since
    cameras are slower than 10,000 Hz and faster than 0.1 Hz: with a median interval below 10 the unit is the
    second, below 10,000 the millisecond, below 10 million the microsecond, and else the nanosecond.
    Without two different time stamps, there is no interval, and the unit is the second.
    """
    unit = _unit_since_1970(stamps)
    if unit is not None:
        return unit
    intervals = np.diff(np.unique(stamps))
    interval = float(np.median(intervals)) if len(intervals) else 0.0
    if interval < 10.0:
        return "seconds", 1.0
    if interval < 1e4:
        return "milliseconds", 1e-3
    return ("microseconds", 1e-6) if interval < 1e7 else ("nanoseconds", 1e-9)


def is_since_1970(stamps_s: Array) -> bool:
    """Return whether time stamps ``(n,)`` are seconds since 1970: their median is in the years 2001 to 2286.

    Without a time stamp, the result is False.
    """
    return bool(len(stamps_s)) and _MIN_EPOCH_S <= float(np.median(stamps_s)) < _MAX_EPOCH_S


def _unit_since_1970(stamps: Array) -> tuple[str, float] | None:
    """Return the unit in which time stamps ``(n,)`` are times since 1970; None if there is no such unit."""
    return next((unit for unit in _TIME_UNITS_S.items() if is_since_1970(stamps * unit[1])), None)


def stamps_in_seconds(
    stamps: Array, stated_by: str, layout_unit: str | None = None
) -> tuple[Array, tuple[str, ...]]:
    """Return time stamps ``(n,)`` in seconds, and a note, or none, on a unit that is not the expected one.

    Args:
        stamps: Time stamps in an unknown unit.
        stated_by: The file that holds them, for the note.
        layout_unit: Name of the unit that the file's format prescribes, which is used unless the stamps are
            times since 1970 in another unit.  For None, the unit is the most likely one, and a note is
            returned unless that is seconds.
    """
    expected = layout_unit or "seconds"
    unit, unit_s = time_unit_s(stamps)
    if layout_unit is not None:
        unit, unit_s = _unit_since_1970(stamps) or (expected, _TIME_UNITS_S[expected])
    notes = () if unit == expected else (f"the time stamps of {stated_by} are taken as {unit}",)
    return stamps * unit_s if unit_s == 1.0 else stamps / round(1.0 / unit_s), notes


def median_depth_m(images: Iterable[npt.NDArray[np.float32]]) -> float | None:
    """Return the median depth of depth images ``(h, w)``, m; None without readings.

    Every eighth row and column counts.  A pixel without a reading is 0.
    """
    readings = [sample[sample > 0] for sample in (image[::8, ::8] for image in images)]
    depths_m = np.concatenate(readings) if readings else np.empty(0, dtype=np.float32)
    return float(np.median(depths_m)) if len(depths_m) else None


def rows_in_time(times: TimeFacts) -> tuple[list[int], tuple[Doubt, ...]]:
    """Return the indices of the time stamps that are used, which increase, and the doubts about all others.

    A time stamp that equals the one before is left out.  A recording whose clock is set back once ends there:
    the first time stamp that is earlier than the one before, and all later ones, are left out.  There is one
    doubt for each of these two reasons.

    Raises:
        UsageError: The time stamps go back more than once, or already from the first to the second: they are
            not in the order of time.
    """
    steps_s = np.diff(times.stamps_s)
    total = len(times.stamps_s)
    # 1. Find where time stamps go back, and refuse those that do so more than once or at the start.
    backs = np.flatnonzero(steps_s < 0.0)
    if len(backs) > 1 or (len(backs) == 1 and backs[0] == 0):
        raise UsageError(
            f"{times.stated_by}: {len(backs)} of {total} time stamps are earlier than the one before, first "
            f"{times.stamps_s[backs[0] + 1]:.6f} s after {times.stamps_s[backs[0]]:.6f} s",
            hint="sort the images in the order in which they were taken, if their clock can be trusted",
        )
    # 2. Leave out all time stamps from the one on that goes back.
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
    # 3. Use the first of several equal time stamps, and leave out the others.
    rows = [0][:total] + [row + 1 for row in range(end - 1) if steps_s[row] > 0.0]
    equal_count = end - len(rows)
    if equal_count:
        first_s = times.stamps_s[int(np.flatnonzero(steps_s[: end - 1] == 0.0)[0])]
        doubts.append(
            Doubt(
                name=DoubtName.EQUAL_STAMPS,
                sentence=f"{times.stated_by}: {equal_count} of {total} images have the time stamp of the "
                f"image before, first {first_s:.6f} s; they are left out",
                hint="write the time of each exposure, with all its digits",
            )
        )
    return rows, tuple(doubts)


def check_reference(reference: TimeFacts, span_s: tuple[float, float]) -> tuple[Doubt, ...]:
    """Return a doubt if a ground truth or an odometry has no time stamp within the span of the images.

    *span_s* is the first and the last time stamp of the images, s.  A reference without a time stamp gives no
    doubt.
    """
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
    """Return the first twelve names of a list, and the number of the others, for a sentence."""
    more = len(names) - _MAX_NAMES_IN_SENTENCE
    return ", ".join(names[:_MAX_NAMES_IN_SENTENCE]) + (f" and {more} more" if more > 0 else "")


def _check_cameras(facts: SourceFacts) -> Iterable[Doubt]:
    """Refuse intrinsics that do not fit the images; there are no doubts.

    Refused are another image size, a principal point outside of the image, and an implausible field of view.
    """
    for stated in facts.cameras:
        camera, lens = stated.lens.camera, stated.lens
        size = (camera.width, camera.height)
        if stated.image_size_px is not None and stated.image_size_px != size:
            raise UsageError(
                f"{facts.name} has images of {stated.image_size_px[0]}x{stated.image_size_px[1]} px, "
                f"{stated.stated_by} is for {size[0]}x{size[1]} px",
                hint="give the intrinsics of this size: scale fx fy cx cy with the image",
            )
        if not (0.0 <= camera.cx <= camera.width and 0.0 <= camera.cy <= camera.height):
            raise UsageError(
                f"{stated.stated_by}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside of the "
                f"image of {size[0]}x{size[1]} px",
                hint="give the intrinsics of this size: scale fx fy cx cy with the image",
            )
        smallest_deg, largest_deg = lens.plausible_field_of_view_deg
        if not smallest_deg <= lens.field_of_view_deg <= largest_deg:
            raise UsageError(
                f"{stated.stated_by}: fx {camera.fx:g} fy {camera.fy:g} at {size[0]}x{size[1]} px is a "
                f"field of view of {lens.field_of_view_deg:.0f} degrees, not within "
                f"{smallest_deg:g}..{largest_deg:g}",
                hint="give fx and fy in pixels of this image size; a wide lens has model fisheye",
            )
    return ()


def _check_depth(facts: SourceFacts) -> Iterator[Doubt]:
    """Refuse a unit of depth that gives an impossible median; doubt depth that is stated as unregistered."""
    depth = facts.depth
    if depth is not None and depth.is_registered is False:
        yield Doubt(
            name=DoubtName.DEPTH_REGISTRATION,
            sentence=f"depth of {facts.name} is stated not to be registered to the colour image, and is used "
            "as if it were",
            hint="record depth that the driver has aligned to the colours",
        )
    if depth is not None and depth.median_m is not None:
        min_m, max_m = MIN_MEDIAN_DEPTH_M, MAX_MEDIAN_DEPTH_M
        if not depth.is_unit_stated:
            min_m, max_m = MIN_ASSUMED_MEDIAN_DEPTH_M, MAX_ASSUMED_MEDIAN_DEPTH_M
        if not min_m <= depth.median_m <= max_m:
            assumed = "" if depth.is_unit_stated else "assumed "
            raise UsageError(
                f"the median depth of {facts.name} is {depth.median_m:g} m at {assumed}{depth.units_per_m:g} "
                f"units a metre, not within {min_m:g}..{max_m:g} m",
                hint="state the unit of depth: depth_scale 1000 for mm, 5000 for TUM, 4000 for 0.25 mm",
            )


def _check_times(facts: SourceFacts) -> Iterator[Doubt]:
    """Refuse unordered time stamps and wrong units, and doubt time stamps that repeat or jump back once."""
    reported: set[DoubtName] = set()
    for times in facts.times:
        # Colour and depth images of one driver have the same fault: each kind of doubt is reported once.
        doubts = [doubt for doubt in rows_in_time(times)[1] if doubt.name not in reported]
        reported |= {doubt.name for doubt in doubts}
        yield from doubts
        intervals_s = np.diff(np.unique(times.stamps_s))
        interval_s = float(np.median(intervals_s)) if len(intervals_s) else 1.0
        if not MIN_INTERVAL_S <= interval_s <= MAX_INTERVAL_S:
            raise UsageError(
                f"{times.stated_by}: images are {interval_s:g} s apart in the median, not within "
                f"{MIN_INTERVAL_S:g}..{MAX_INTERVAL_S:g} s",
                hint="correct the unit of the time stamps",
            )


def _is_finding(loss: LossFacts) -> bool:
    """Return whether a loss is reported as a doubt, and not only as a note.

    A usual loss is a doubt above a tenth of the images, any other loss from one image on.
    """
    return loss.lost > (_USUAL_LOSS_SHARE * loss.total if loss.is_usual else 0)


def _check_losses(facts: SourceFacts) -> Iterator[Doubt]:
    for loss in facts.losses:
        if _is_finding(loss):
            yield Doubt(
                name=DoubtName.LEFT_OUT,
                sentence=loss.sentence,
                hint="copy the recording again, or record it again",
            )


def _check_videos(facts: SourceFacts) -> Iterable[Doubt]:
    """Refuse two videos of a stereo pair that end at different times.

    Many recorders write time stamps in equal steps.  If a camera lost an image, its video is then shorter,
    and all images after the loss have wrong partners.  A video that was only stopped earlier looks the same,
    so that both are refused.  Where the time stamps have a gap for the lost image, both videos end at one
    time.
    """
    if len(facts.videos) == 2:
        (name, video), (other_name, other) = facts.videos.items()
        if abs(video.last_s - other.last_s) > _MAX_VIDEO_END_DIFFERENCE * min(video.period_s, other.period_s):
            raise UsageError(
                f"{name} has {video.frames} images until {video.last_s:.3f} s, {other_name} {other.frames} "
                f"until {other.last_s:.3f} s: their times do not say which images belong together",
                hint="record the time of each image (MP4, MKV or a bag), cut both videos to the same images, "
                "or take one: --camera left",
            )
    return ()


def _check_references(facts: SourceFacts) -> Iterator[Doubt]:
    span_s = facts.span_s
    for reference in facts.references:
        if span_s is not None:
            yield from check_reference(reference, span_s)


_CHECKS: tuple[Callable[[SourceFacts], Iterable[Doubt]], ...] = (
    _check_cameras,
    _check_depth,
    _check_times,
    _check_losses,
    _check_videos,
    _check_references,
)
"""The checks of `check_source`, in the order in which their errors and doubts are reported."""
