"""A folder of images as a camera: colours, with or without depth; and two folders as a pair of cameras.

Colours lie in ``rgb/``, ``color/``, ``images/`` or in the folder itself, depth (16 bits) in ``depth/``, or
beside the colours with ``depth`` in its names.  Images that belong together have one name, one number or one
time.  Names that are decimal numbers, or times since 1970, are time stamps.  Recordings that list their
images are read by `client_sdk.datasets`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client_sdk.bags.index import pair_stamps
from client_sdk.cameras.source import RawFrame, RawPair
from client_sdk.datasets.images import (
    image_files,
    numbers_in_name,
    probe,
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
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["FolderImages", "list_folder", "list_pairs", "pair_folders"]

_COLOUR_FOLDERS = ("rgb", "color", "colour", "image", "images", "results")
_DEPTH_FOLDERS = ("depth", "depths", "aligned_depth", "depth_image", "depth_images")
_PAIR_FOLDERS = ("{}", "image_{}", "images_{}", "{}_images", "img_{}", "rgb_{}")  # of left and right
_PERIOD_S = 0.1  # between images that state neither time nor rate
_MAX_APART_S = 0.02  # of a colour and a depth image that are paired by time
_NANOSECOND_DIGITS = 9  # ROS writes seconds, a point and nanoseconds, often without their leading zeros
_TIME = re.compile(r"(?:[A-Za-z][A-Za-z_]*[-_]?)?(-?\d+(?:\.\d+)?)(?:[._-][A-Za-z]+)?")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FolderImages:
    """Images in the order of time, their ``(n,)`` stamps, and what belongs to them, if anything does.

    ``partners`` are the depth images, or the images of the right camera.
    """

    name: str
    images: Sequence[Path]
    partners: Sequence[Path] | None
    stamps_s: Array
    doubts: tuple[Doubt, ...]
    assumed: tuple[str, ...]

    def facts(self, lens: Intrinsics, stated_by: str, *, has_depth: bool) -> SourceFacts:
        """Return what the folder states and delivers; some of its images are read for it.

        Raises:
            UsageError: No image can be read, or depth is of another kind.
        """
        assumed = self.assumed
        depth = None
        if has_depth and self.partners is not None:
            units_per_m = lens.depth_units_per_m
            depths = probe(self.partners, lambda path: read_depth(path, units_per_m))
            depth = DepthFacts(
                median_m=median_depth_m(depths), units_per_m=units_per_m,
                is_unit_stated=lens.depth_scale is not None, is_registered=lens.is_depth_registered,
            )  # fmt: skip
            if not depth.is_unit_stated:
                assumed += (f"{stated_by} states no depth_scale: {units_per_m:g} units a metre are assumed",)
        camera = CameraFacts(
            stated_by=stated_by, lens=lens, image_size_px=self.size_px,
        )  # fmt: skip
        return SourceFacts(
            name=self.name, cameras=(camera,), depth=depth, doubts=self.doubts, assumed=assumed,
            times=(TimeFacts(stated_by=self.name, stamps_s=self.stamps_s),),
        )  # fmt: skip

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the images; raises UsageError where none can be read."""
        height, width = probe(self.images, read_colour)[0].shape[:2]
        return width, height

    def frames(self, log: DoubtLog, depth_units_per_m: float | None) -> Iterator[RawFrame]:
        """Yield the frames, without depth if its unit is None; *log* counts images that cannot be read."""

        def read(row: int) -> RawFrame:
            depth_m = None
            if depth_units_per_m is not None and self.partners is not None:
                depth_m = read_depth(self.partners[row], depth_units_per_m)
            return float(self.stamps_s[row]), read_colour(self.images[row]), depth_m

        return readable(range(len(self.images)), read, log)

    def pairs(self, log: DoubtLog) -> Iterator[RawPair]:
        """Yield the pairs of two cameras; *log* counts images that cannot be read."""
        rights = self.partners or ()

        def read(row: int) -> RawPair:
            return float(self.stamps_s[row]), read_colour(self.images[row]), read_colour(rights[row])

        return readable(range(len(self.images)), read, log)


def list_folder(folder: Path, rate_hz: float | None = None) -> FolderImages:
    """Return the images of a folder; *rate_hz* is that of images that state no time.

    Raises:
        UsageError: There is no image, or depth that belongs to none.
    """
    inside = _first_folder(folder, _COLOUR_FOLDERS) or folder
    depth_folder = _first_folder(folder, _DEPTH_FOLDERS)
    colours = image_files(inside)
    depths = [] if depth_folder is None else image_files(depth_folder)
    if depth_folder is None or not depths:
        depths = [path for path in colours if "depth" in path.stem.lower()]
        colours = [path for path in colours if path not in set(depths)]
    if not colours:
        raise UsageError(f"{folder} holds no image", hint="put images into it, or into its folder rgb/")
    return _listed(str(folder), colours, depths or None, "depth image", rate_hz)


def pair_folders(folder: Path) -> tuple[Path, Path] | None:
    """Return the folders of the left and of the right images; None if there are not both."""
    for name in _PAIR_FOLDERS:
        left, right = (folder / name.format(side) for side in ("left", "right"))
        if left.is_dir() and right.is_dir():
            return left, right
    return None


def list_pairs(folder: Path, rate_hz: float | None = None) -> FolderImages:
    """Return the images of `pair_folders` that belong together.

    Raises:
        UsageError: There is no image, or none of the left has a partner.
    """
    left, right = pair_folders(folder) or (folder / "left", folder / "right")
    lefts, rights = image_files(left), image_files(right)
    if not lefts:
        raise UsageError(f"{left} holds no image", hint="put the images of the left camera into it")
    return _listed(str(folder), lefts, rights, "right image", rate_hz)


def _listed(
    name: str, images: list[Path], partners: list[Path] | None, what: str, rate_hz: float | None
) -> FolderImages:
    """Join images with their partners, and put them in the order of time."""
    doubts: tuple[Doubt, ...] = ()
    named_s, assumed = _named_times(images, name)
    period_s = _PERIOD_S if rate_hz is None else 1.0 / rate_hz
    stamps_s: Array = np.arange(len(images), dtype=np.float64) * period_s if named_s is None else named_s
    if named_s is None and rate_hz is None:
        assumed = (f"names of images in {name} are no times: {_PERIOD_S:g} s between images are assumed",)
    chosen: list[Path] | None = None
    if partners is not None:
        pairs = _joined(images, partners)
        if not pairs:
            raise UsageError(
                f"none of {len(images)} images of {name} has a {what} of the same name, number or time among "
                f"{len(partners)}",
                hint="give images that belong together one number or one time stamp",
            )
        joined = {row for row, _ in pairs}
        alone = [path.name for row, path in enumerate(images) if row not in joined]
        if alone:
            sentence = f"{len(alone)} of {len(images)} images of {name} left out, without a {what}: "
            doubts = (
                Doubt(name=DoubtName.LEFT_OUT, sentence=sentence + some_names(alone), hint="copy all images"),
            )
        images = [images[row] for row, _ in pairs]
        chosen = [partners[row] for _, row in pairs]
        stamps_s = stamps_s[[row for row, _ in pairs]]
    order = np.argsort(stamps_s, kind="stable")
    times = TimeFacts(stated_by=name, stamps_s=stamps_s[order])
    rows, of_times = rows_in_time(times)
    used = order[rows]
    return FolderImages(
        name=name, images=[images[row] for row in used], stamps_s=stamps_s[used],
        partners=None if chosen is None else [chosen[row] for row in used],
        doubts=(*doubts, *of_times), assumed=assumed,
    )  # fmt: skip


def _first_folder(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the folder of the first of *names* that there is; ``rgb_0`` is a folder of ``rgb``."""
    found = sorted((path for path in folder.iterdir() if path.is_dir()), reverse=True)
    by_name = {path.name.lower().rstrip("_0123456789"): path for path in found}
    return next((by_name[name] for name in names if name in by_name), None)


def _joined(firsts: list[Path], seconds: list[Path]) -> list[tuple[int, int]]:
    """Return rows of images that belong together by name, by numbers, by the last or first, or by time."""
    keys: tuple[Callable[[Path], Hashable], ...] = (
        lambda path: path.stem, numbers_in_name,
        lambda path: numbers_in_name(path)[-1:], lambda path: numbers_in_name(path)[:1],
    )  # fmt: skip
    for key in keys:
        rows = {key(path): row for row, path in enumerate(seconds)}
        of_firsts = [key(path) for path in firsts]
        if len(rows) == len(seconds) and len(set(of_firsts)) == len(firsts):
            pairs = [(row, rows[each]) for row, each in enumerate(of_firsts) if each in rows]
            if 2 * len(pairs) > min(len(firsts), len(seconds)):
                return pairs
    first_s, second_s = _named_times(firsts, "")[0], _named_times(seconds, "")[0]
    if first_s is None or second_s is None:
        return []
    first_rows, second_rows = np.argsort(first_s), np.argsort(second_s)
    pairs = pair_stamps(first_s[first_rows], second_s[second_rows], _MAX_APART_S)
    return [(int(first_rows[first]), int(second_rows[second])) for first, second in pairs]


def _named_times(paths: Sequence[Path], name: str) -> tuple[Array | None, tuple[str, ...]]:
    """Return the times, s, that names state, None if they state none; and what was assumed of them."""
    matches = [_TIME.fullmatch(path.stem) for path in paths]
    words = [match[1] for match in matches if match is not None]
    if len(words) < len(paths):
        return None, ()
    values = np.array([float(word) for word in words])
    if any("." in word for word in words):
        nanoseconds = _seconds_and_nanoseconds(words)
        if nanoseconds is not None and _unevenness(nanoseconds) < _unevenness(values):
            return nanoseconds, (f"names in {name} are taken as seconds, a point and whole nanoseconds",)
        return stamps_in_seconds(values, f"names in {name}")
    stamps_s, assumed = stamps_in_seconds(values, f"names in {name}", "seconds")
    return (stamps_s, assumed) if is_since_1970(stamps_s) else (None, ())


def _seconds_and_nanoseconds(words: Sequence[str]) -> Array | None:
    """Return names as seconds and a whole number of nanoseconds; None where they cannot be that."""
    parts = [word.partition(".") for word in words]
    lengths = {len(fraction) for _, _, fraction in parts}
    if max(lengths) != _NANOSECOND_DIGITS or len(lengths) == 1:
        return None
    return np.array([float(seconds) + 1e-9 * float(fraction or 0) for seconds, _, fraction in parts])


def _unevenness(stamps_s: Array) -> float:
    """Return how much intervals differ from their median, relative to it."""
    steps_s = np.diff(np.sort(stamps_s))
    typical_s = float(np.median(steps_s)) if len(steps_s) else 1.0
    return float(np.median(np.abs(steps_s - typical_s))) / max(typical_s, 1e-12)
