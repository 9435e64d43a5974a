"""What `rse-pf map` asks the map services for, in this process: merge maps, localise frames in one.

Promises to write nothing but a new version of the map that was named.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import CommandFailed, NotFound, UsageError
from rse_pf.geometry import Camera, rotation_angle_deg, to_quaternion
from rse_pf.maps.format import MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.services.mapping.localise import Location, locate
from rse_pf.services.mapping.merge import MergeReply, MergeRequest, merge_maps
from rse_pf.services.mapping.place import opened_map
from rse_pf.services.mapping.relative_pose import View

__all__ = ["localise_frames", "merge_into", "version_of"]

_FRAMES = re.compile(r"(?P<folder>.+):(?P<first>\d+)(-(?P<last>\d+))?")


def merge_into(args: argparse.Namespace, maps: MapRegistry) -> int:
    """Merge the maps of *args* into the next version of one; the exit code is 1 if any was left out."""
    names = [version_of(word) for word in args.names]
    records = [maps.record(*each) for each in names]
    parent = _head(maps, args.into)
    request = MergeRequest(
        maps=[maps.data(name, record.id) for (name, _), record in zip(names, records, strict=True)]
    )
    began = time.perf_counter()
    reply = merge_maps(request, report=_progress(sys.stderr))
    took_s = time.perf_counter() - began
    left_out = [(args.names[each.map], each.reason) for each in reply.not_joined]
    if len(args.names) > 1 and len(reply.joined) < 2:
        told = "; ".join(f"{name}: {reason}" for name, reason in left_out)
        raise CommandFailed(
            f"no two of these maps can be joined, so nothing was written: {told}",
            hint="record frames from where another robot has been, then merge again",
        )
    joined = [args.names[row] for row in reply.joined]
    made = maps.commit(
        args.into, reply.map, parent=parent, author="rse-pf map merge", created_s=time.time(),
        note=args.note or f"merged {', '.join(joined)}",
    )  # fmt: skip
    refused = _refused(args.names, reply)
    if args.json:
        _print_json(
            {"name": args.into, "id": made.id, "number": made.number, "joined": joined,
             "not_joined": [{"map": name, "reason": reason} for name, reason in left_out],
             "refused": refused, "links": reply.merges, "loops": reply.loops, "seconds": round(took_s, 3)}
        )  # fmt: skip
        return 1 if left_out else 0
    print(f"{args.into} is now version {made.number}, {made.id[:12]}: {made.keyframes} keyframes, "
          f"{made.points} points, {reply.merges} links between maps, {reply.loops} loops")  # fmt: skip
    print(f"joined      {', '.join(joined)}")
    for name, reason in left_out:
        print(f"not joined  {name}: {reason}")
    for each in refused:
        told = ", ".join(f"{count} {reason}" for reason, count in each["reasons"].items())
        print(f"refused     {each['between']}: {told}")
    return 1 if left_out else 0


def localise_frames(args: argparse.Namespace, maps: MapRegistry) -> int:
    """Find each frame of *args* in a map, a line each; the exit code is 1 if none was found."""
    name, version = version_of(args.name)
    data = maps.data(name, version)
    version_map, index = opened_map(data)
    asked = [each for word in args.frames for each in _asked(word, args.every)]
    found: list[dict[str, Any]] = []
    for each in asked:
        location = locate(index, _view(each, version_map, args.camera))
        found.append(_found(each.label, location))
        if not args.json:
            print(_line(found[-1]), flush=True)
    good = sum(each["verdict"] == "ok" for each in found)
    if args.json:
        _print_json(found)
    else:
        print(f"{good} of {len(found)} found")
    return 0 if good else 1


def version_of(word: str) -> tuple[str, str]:
    """Return name and version of ``MAP`` or ``MAP@VERSION``."""
    name, _, version = word.partition("@")
    return name, version or "head"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    """A frame to localise: a row of a recording, or (row None) an image."""

    label: str
    path: Path
    row: int | None


def _asked(word: str, every: int) -> Iterator[_Asked]:
    path = Path(word)
    if path.is_file():
        yield _Asked(label=word, path=path, row=None)
        return
    first, last = 0, -1
    match = None if path.is_dir() else _FRAMES.fullmatch(word)
    if match is not None:
        path = Path(match["folder"])
        first = int(match["first"])
        last = int(match["last"] or first)
    if not path.exists():
        raise UsageError(
            f"there is no image or recording {word}",
            hint="name an image, a recording, or RECORDING:FIRST-LAST",
        )
    from client_sdk.datasets import open_dataset

    count = len(open_dataset(path))
    if match is not None and not first <= last < count:
        raise UsageError(
            f"{path} has the frames 0 to {count - 1}, not {word.rpartition(':')[2]}",
            hint="count frames from 0",
        )
    for row in range(first, count if last < 0 else last + 1, every):
        yield _Asked(label=f"{path.name}:{row}", path=path, row=row)


def _view(asked: _Asked, version: MapVersion, camera: str | None) -> View:
    from client_sdk.datasets import open_dataset, read_colour
    from client_sdk.frontend import Frame, FrontEndOptions, extract

    if asked.row is not None:
        recording = open_dataset(asked.path)
        frame = recording.read(recording.rows[asked.row])
    else:
        rgb = read_colour(asked.path)
        height, width = rgb.shape[:2]
        lens = _lens(camera, width, height) if camera else _lens_of_map(version, width, height, asked.label)
        nothing = np.zeros((height, width), dtype=np.float32)
        frame = Frame(timestamp_s=0.0, rgb=rgb, depth_m=nothing, camera=lens)
    features = extract(frame, FrontEndOptions())
    return View(camera=frame.camera, pixels=features.pixels, descriptors=features.descriptors)


def _lens(numbers: str, width: int, height: int) -> Camera:
    try:
        fx, fy, cx, cy = (float(each) for each in numbers.split(","))
    except ValueError as error:
        raise UsageError(
            f"--camera {numbers} is not four numbers", hint="write fx,fy,cx,cy in pixels"
        ) from error
    return Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _lens_of_map(version: MapVersion, width: int, height: int, label: str) -> Camera:
    """Return the camera of the map's keyframes: an image of the same size was likely made by it."""
    for keyframe in version.keyframes:
        if (keyframe.camera.width, keyframe.camera.height) == (width, height):
            return keyframe.camera
    raise UsageError(
        f"{label} is {width}x{height} px, and no camera of the map is", hint="tell it: --camera fx,fy,cx,cy"
    )


def _found(label: str, location: Location) -> dict[str, Any]:
    T = location.T_map_camera
    return {
        "frame": label, "verdict": location.verdict, "reason": location.reason, "inliers": location.inliers,
        "rmse_px": round(location.rmse_px, 3), "keyframes": list(location.keyframes),
        "position_m": None if T is None else [round(float(x), 4) + 0.0 for x in T[:3, 3]],
        "quaternion_xyzw": None if T is None else [round(float(x), 6) for x in to_quaternion(T[:3, :3])],
        "turned_deg": None if T is None else round(rotation_angle_deg(T[:3, :3]), 2),
    }  # fmt: skip


def _line(found: dict[str, Any]) -> str:
    start = f"{found['frame']:<24} {found['verdict']:<4}"
    if found["position_m"] is None:
        return f"{start}  {found['reason']}, {found['inliers']} inliers"
    x, y, z = found["position_m"]
    doubt = f" ({found['reason']})" if found["reason"] else ""
    keyframes = ", ".join(str(each) for each in found["keyframes"])
    return (
        f"{start}  x {x:7.3f}  y {y:7.3f}  z {z:7.3f} m, turned {found['turned_deg']:6.2f} deg; "
        f"{found['inliers']} inliers, {found['rmse_px']:.2f} px, keyframes {keyframes}{doubt}"
    )


def _refused(names: Sequence[str], reply: MergeReply) -> list[dict[str, Any]]:
    """Return which pairs of keyframes made no link, by the maps that they are from."""
    pairs: dict[str, dict[str, int]] = {}
    for each in reply.refused:
        between = " and ".join(dict.fromkeys(names[row] for row in each.maps))
        if len(set(each.maps)) == 1:
            between = f"within {between}"
        pairs.setdefault(between, {})[each.reason] = each.count
    return [{"between": between, "reasons": reasons} for between, reasons in pairs.items()]


def _head(maps: MapRegistry, name: str) -> str | None:
    try:
        return maps.head(name).id
    except NotFound:
        return None


def _progress(screen: Any) -> Any:
    """Return a report callback that rewrites one line of a terminal, and nothing elsewhere."""

    def tell(done: float, what: str) -> None:
        if screen.isatty():
            end = "\n" if done >= 1.0 else ""
            print(f"\r\033[K{100 * done:3.0f} %  {what}", end=end, file=screen, flush=True)

    return tell


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, sort_keys=True))
