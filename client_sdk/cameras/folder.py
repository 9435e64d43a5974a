"""Read a folder of images as a camera, with or without depth, and two folders as a stereo pair.

Colour images are in a folder that `_COLOUR_FOLDERS` names, such as ``rgb/``, or in the folder itself.  Depth
images (16 bits) are in a folder that `_DEPTH_FOLDERS` names, such as ``depth/``, or in the folder of the
colour images with ``depth`` in their names.  Images that belong together share their name, a number in their
name, or their time.  Names that are decimal numbers, or times since 1970, are time stamps.  Recordings that
list their images in a file are read by `client_sdk.datasets`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client_sdk.cameras.source import RawFrame, RawPair
from client_sdk.datasets.images import (
    image_files,
    numbers_in_name,
    probe,
    probe_size_px,
    read_colour,
    read_depth,
    readable,
)
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.source_facts import (
    CameraFacts,
    DepthFacts,
    Doubt,
    DoubtLog,
    DoubtName,
    SourceFacts,
    TimeFacts,
    is_since_1970,
    median_depth_m,
    rows_in_time,
    some_names,
    stamps_in_seconds,
)
from client_sdk.stamp_pairs import pair_stamps
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["FolderImages", "list_folder", "list_pairs", "pair_folders"]

_COLOUR_FOLDERS = ("rgb", "color", "colour", "image", "images", "results")
"""Names that other programs give to the folder of the colour images; the first that exists is used (see
`_find_folder`).  Replica recordings have colour and depth images in ``results``."""
_VIDEO_ENDINGS = {".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".3gp"}
"""Endings of videos, for the hint where a folder without images holds one."""
_DEPTH_FOLDERS = ("depth", "depths", "aligned_depth", "depth_image", "depth_images")
"""Names that other programs give to the folder of the depth images; the first that exists is used."""
_PAIR_FOLDERS = ("{}", "image_{}", "images_{}", "{}_images", "img_{}", "rgb_{}")
"""Names of the two folders of a stereo pair, with ``left`` and ``right`` in the place of the braces."""
_ASSUMED_PERIOD_S = 0.1  # time between images if neither their names nor the intrinsics state times or a rate
_MAX_PAIR_DIFFERENCE_S = 0.02
"""Largest difference of the times in the names of two images that are paired by time."""
_NANOSECOND_DIGITS = 9
"""Most digits of the nanoseconds in a name: ROS names images SECONDS.NANOSECONDS, often without the leading
zeros of the nanoseconds."""
_NAME_WITH_TIME = re.compile(r"(?:[A-Za-z][A-Za-z_]*[-_]?)?(-?\d+(?:\.\d+)?)(?:[._-][A-Za-z]+)?")
"""Name of an image that may state its time: the number, perhaps with a word before it, and perhaps with a
mark and a word after it, such as ``frame_12.5-color``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FolderImages:
    """The images of a folder in the order of time.

    Attributes:
        name: Path of the folder, for messages.
        images: Files of the colour images, or of the images of the left camera.
        partners: For each image, the file of its depth image or of the image of the right camera; None if the
            folder has neither.
        stamps_s: ``(n,)``, s, time stamps of the images, which increase.
        doubts: Doubts about the time stamps, and about images without a partner, which are left out.
        assumed: Sentences for the user on what was assumed because the folder does not state it.
    """

    name: str
    images: Sequence[Path]
    partners: Sequence[Path] | None
    stamps_s: Array
    doubts: tuple[Doubt, ...]
    assumed: tuple[str, ...]

    def facts(self, lens: Intrinsics, stated_by: str, *, has_depth: bool) -> SourceFacts:
        """Return what the folder states, and the image size and median depth with which that is compared.

        For both, the first, the middle and the last image are read; the size is that of the first readable
        one.

        Args:
            lens: Intrinsics of the images.
            stated_by: The file of the intrinsics, for messages.
            has_depth: Whether the partners are depth images that will be used.

        Raises:
            UsageError: None of these images can be read, or a depth image does not have 16 bits.
        """
        assumed = self.assumed
        depth = None
        if has_depth and self.partners is not None:
            units_per_m = lens.depth_units_per_m
            depths = probe(self.partners, lambda path: read_depth(path, units_per_m))
            depth = DepthFacts(
                median_m=median_depth_m(depths),
                units_per_m=units_per_m,
                is_unit_stated=lens.depth_scale is not None,
                is_registered=lens.is_depth_registered,
            )
            if not depth.is_unit_stated:
                assumed += (f"{stated_by} states no depth_scale: {units_per_m:g} units a metre are assumed",)
        camera = CameraFacts(
            stated_by=stated_by,
            lens=lens,
            image_size_px=self.size_px,
        )
        return SourceFacts(
            name=self.name,
            cameras=(camera,),
            depth=depth,
            doubts=self.doubts,
            assumed=assumed,
            times=(TimeFacts(stated_by=self.name, stamps_s=self.stamps_s),),
        )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the images, px; raises UsageError if no image can be read."""
        return probe_size_px(self.images)

    def frames(self, log: DoubtLog, depth_units_per_m: float | None) -> Iterator[RawFrame]:
        """Yield the frames, not undistorted; leave out, and count in *log*, unreadable ones.

        *depth_units_per_m* is the number of units of a depth image per metre; with None, depth is not read.
        """

        def read(row: int) -> RawFrame:
            depth_m = None
            if depth_units_per_m is not None and self.partners is not None:
                depth_m = read_depth(self.partners[row], depth_units_per_m)
            return float(self.stamps_s[row]), read_colour(self.images[row]), depth_m

        return readable(range(len(self.images)), read, log)

    def pairs(self, log: DoubtLog) -> Iterator[RawPair]:
        """Yield the stereo pairs, not rectified; leave out, and count in *log*, unreadable ones.

        `partners` must be the images of the right camera.
        """
        rights = self.partners or ()

        def read(row: int) -> RawPair:
            return float(self.stamps_s[row]), read_colour(self.images[row]), read_colour(rights[row])

        return readable(range(len(self.images)), read, log)


def list_folder(folder: Path, rate_hz: float | None = None) -> FolderImages:
    """Return the images of a folder, with their depth images if there are some.

    *rate_hz* is the rate of images whose names state no time; None means 10 Hz, with a sentence in `assumed`.

    Raises:
        UsageError: There is no image, or there are depth images and none belongs to a colour image.
    """
    colour_folder = _find_folder(folder, _COLOUR_FOLDERS) or folder
    depth_folder = _find_folder(folder, _DEPTH_FOLDERS)
    colours = image_files(colour_folder)
    depths = [] if depth_folder is None else image_files(depth_folder)
    if depth_folder is None or not depths:
        depths = [path for path in colours if "depth" in path.stem.lower()]
        colours = [path for path in colours if path not in set(depths)]
    if not colours:
        video = next(
            (path for path in sorted(folder.iterdir()) if path.suffix.lower() in _VIDEO_ENDINGS), None
        )
        raise UsageError(
            f"{folder} holds no image",
            hint="put images into it, or into its folder rgb/"
            if video is None
            else f"name the video: {video}",
        )
    return _order_by_time(str(folder), colours, depths or None, "depth image", rate_hz)


def pair_folders(folder: Path) -> tuple[Path, Path] | None:
    """Return the folders of the left and of the right images of a stereo pair, inside *folder*.

    They have the first names of `_PAIR_FOLDERS` for which both folders exist; None if there are none.
    """
    for name in _PAIR_FOLDERS:
        left, right = (folder / name.format(side) for side in ("left", "right"))
        if left.is_dir() and right.is_dir():
            return left, right
    return None


def list_pairs(folder: Path, rate_hz: float | None = None) -> FolderImages:
    """Return the stereo pairs of the two folders of `pair_folders`; *rate_hz* as of `list_folder`.

    Raises:
        UsageError: There is no left image, or no left image has a right one.
    """
    left, right = pair_folders(folder) or (folder / "left", folder / "right")
    lefts, rights = image_files(left), image_files(right)
    if not lefts:
        raise UsageError(f"{left} holds no image", hint="put the images of the left camera into it")
    return _order_by_time(str(folder), lefts, rights, "right image", rate_hz)


def _order_by_time(
    name: str, images: list[Path], partners: list[Path] | None, partner_kind: str, rate_hz: float | None
) -> FolderImages:
    """Return images with their partners in the order of time.

    Args:
        name: Path of the folder, for messages.
        images: All images, in the order of the numbers in their names.
        partners: All depth images or right images, in any order; None without any.
        partner_kind: Word for a partner in messages, such as ``depth image``.
        rate_hz: Rate of images whose names state no time; None means 10 Hz.

    Raises:
        UsageError: No image has a partner.
    """
    # 1. Take time stamps from names, or from the rate.
    doubts: tuple[Doubt, ...] = ()
    named_s, assumed = _times_in_names(images, name)
    period_s = _ASSUMED_PERIOD_S if rate_hz is None else 1.0 / rate_hz
    stamps_s: Array = np.arange(len(images), dtype=np.float64) * period_s if named_s is None else named_s
    if named_s is None and rate_hz is None:
        assumed = (
            f"names of images in {name} are no times: {_ASSUMED_PERIOD_S:g} s between images are assumed",
        )
    # 2. Leave out images without a partner.
    paired: list[Path] | None = None
    if partners is not None:
        pairs = _match_names(images, partners)
        if not pairs:
            raise UsageError(
                f"none of {len(images)} images of {name} has a {partner_kind} with the same name, number "
                f"or time among {len(partners)}",
                hint="give images that belong together one number or one time stamp",
            )
        rows_with_partner = {row for row, _ in pairs}
        alone = [path.name for row, path in enumerate(images) if row not in rows_with_partner]
        if alone:
            sentence = f"{len(alone)} of {len(images)} images of {name} left out, without a {partner_kind}: "
            doubts = (
                Doubt(name=DoubtName.LEFT_OUT, sentence=sentence + some_names(alone), hint="copy all images"),
            )
        images = [images[row] for row, _ in pairs]
        paired = [partners[row] for _, row in pairs]
        stamps_s = stamps_s[[row for row, _ in pairs]]
    # 3. Sort the images by time, and leave out each image that has the time stamp of the image before it.
    order = np.argsort(stamps_s, kind="stable")
    times = TimeFacts(stated_by=name, stamps_s=stamps_s[order])
    rows, time_doubts = rows_in_time(times)
    used = order[rows]
    return FolderImages(
        name=name,
        images=[images[row] for row in used],
        stamps_s=stamps_s[used],
        partners=None if paired is None else [paired[row] for row in used],
        doubts=(*doubts, *time_doubts),
        assumed=assumed,
    )


def _find_folder(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the folder inside *folder* with the first of *names* that exists; None if none exists.

    Upper case, and digits and underscores at the end, are ignored: ``RGB_0`` counts as ``rgb``.  If several
    folders count as the same name, the first of them in alphabetical order is returned.
    """
    folders = sorted((path for path in folder.iterdir() if path.is_dir()), reverse=True)
    by_name = {path.name.lower().rstrip("_0123456789"): path for path in folders}
    return next((by_name[name] for name in names if name in by_name), None)


def _match_names(firsts: list[Path], seconds: list[Path]) -> list[tuple[int, int]]:
    """Return the pairs (index in *firsts*, index in *seconds*) of files that belong together by their names.

    Files belong together by one of these rules, which are tried in this order: equal names, equal numbers in
    the names, equal last numbers, equal first numbers.  A rule is used for all files if no two files of the
    same list are equal by it, and if it pairs more than half of the files of the shorter list.  If no rule
    does, and all names state times, each file is paired with the one nearest in time within 20 ms, however
    few pairs that gives.  The result is empty if there is no pair.
    """
    keys: tuple[Callable[[Path], Hashable], ...] = (
        lambda path: path.stem,
        numbers_in_name,
        lambda path: numbers_in_name(path)[-1:],
        lambda path: numbers_in_name(path)[:1],
    )
    for key in keys:
        second_rows_by_key = {key(path): row for row, path in enumerate(seconds)}
        first_keys = [key(path) for path in firsts]
        if len(second_rows_by_key) == len(seconds) and len(set(first_keys)) == len(firsts):
            pairs = [
                (row, second_rows_by_key[first_key])
                for row, first_key in enumerate(first_keys)
                if first_key in second_rows_by_key
            ]
            if 2 * len(pairs) > min(len(firsts), len(seconds)):
                return pairs
    first_s, second_s = _times_in_names(firsts, "")[0], _times_in_names(seconds, "")[0]
    if first_s is None or second_s is None:
        return []
    first_rows, second_rows = np.argsort(first_s), np.argsort(second_s)
    pairs = pair_stamps(first_s[first_rows], second_s[second_rows], _MAX_PAIR_DIFFERENCE_S)
    return [(int(first_rows[first]), int(second_rows[second])) for first, second in pairs]


def _times_in_names(paths: Sequence[Path], name: str) -> tuple[Array | None, tuple[str, ...]]:
    """Return the times ``(n,)``, s, that the names of files state, and notes on what was assumed of them.

    The times are None if a name states no number (`_NAME_WITH_TIME`), or if the numbers are whole and cannot
    be times since 1970: they are probably frame numbers.  *name* is the folder, for the notes.
    """
    matches = [_NAME_WITH_TIME.fullmatch(path.stem) for path in paths]
    words = [match[1] for match in matches if match is not None]
    if len(words) < len(paths):
        return None, ()
    values = np.array([float(word) for word in words])
    if any("." in word for word in words):
        with_nanoseconds_s = _parse_seconds_and_nanoseconds(words)
        if with_nanoseconds_s is not None and _unevenness(with_nanoseconds_s) < _unevenness(values):
            return with_nanoseconds_s, (
                f"names in {name} are taken as seconds, a point and whole nanoseconds",
            )
        return stamps_in_seconds(values, f"names in {name}")
    stamps_s, assumed = stamps_in_seconds(values, f"names in {name}", "seconds")
    return (stamps_s, assumed) if is_since_1970(stamps_s) else (None, ())


def _parse_seconds_and_nanoseconds(words: Sequence[str]) -> Array | None:
    """Return the times ``(n,)``, s, of words ``SECONDS.NANOSECONDS`` whose leading zeros are missing.

    Words are of this kind if the longest has nine digits after its point and another one has fewer.  For
    other words, which are decimal numbers, the result is None.
    """
    parts = [word.partition(".") for word in words]
    lengths = {len(fraction) for _, _, fraction in parts}
    if max(lengths) != _NANOSECOND_DIGITS or len(lengths) == 1:
        return None
    return np.array([float(seconds) + 1e-9 * float(fraction or 0) for seconds, _, fraction in parts])


def _unevenness(stamps_s: Array) -> float:
    """Return how much the intervals between successive times ``(n,)`` vary, after sorting the times.

    It is the median absolute deviation of the intervals from their median, divided by this median; 0 for two
    times, and NaN for fewer.
    """
    intervals_s = np.diff(np.sort(stamps_s))
    median_s = float(np.median(intervals_s)) if len(intervals_s) else 1.0
    return float(np.median(np.abs(intervals_s - median_s))) / max(median_s, 1e-12)
