"""Work with the maps that robots share: show, merge, prune, back up, localise in them, roll them back.

The actions work on the store itself: --store, else data.store, else that of the platform on this machine,
where from-camera and from-bag keep their maps.  A VERSION is head, or six or more digits of an id; show --all
lists the ids.  rollback sets the head to an earlier version and deletes nothing; prune removes old versions.
Each action has its own help page: rse-pf map merge --help.

examples:
  rse-pf map from-camera 0 --intrinsics intrinsics.json --out out-camera
  rse-pf map from-bag kitchen.bag --out out-bag
  rse-pf map list
  rse-pf map show kitchen --png kitchen.png
  rse-pf map merge robot-1 robot-2 robot-3 --into kitchen
  rse-pf map localise kitchen recordings/kitchen:0-40
  rse-pf map localise kitchen photo.jpg --enrolment phone.enrolment --intrinsics intrinsics.json
  rse-pf map view kitchen --out kitchen.png
  rse-pf map diff kitchen 3f9bd1 head
  rse-pf map live list
  rse-pf map backup acme.maps --tenant acme --name lab
  rse-pf map restore acme.maps --tenant acme --name lab
  rse-pf map prune kitchen --keep 10
"""

from __future__ import annotations

import functools
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.cli.maps.backup import BackupRequest, RestoreRequest, run_backup, run_restore
from rse_pf.cli.maps.bags import FromBagRequest, ToBagRequest, run_from_bag, run_to_bag
from rse_pf.cli.maps.from_camera import FromCameraRequest, run_from_camera
from rse_pf.cli.maps.live import LIVE_ACTIONS, run_publish
from rse_pf.cli.maps.localise import LocaliseRequest, run_localise
from rse_pf.command_line.map_store import (
    MapRequest,
    StoreRequest,
    VersionRequest,
    head_id,
    split_version,
)
from rse_pf.command_line.merge_output import commit_merge, merge_progress
from rse_pf.command_line.options import Action, extension_actions, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.maps.registry import MapOrigin, MapRecord, MapRegistry, compare_versions
from rse_pf.maps.removal import choose_superseded, count_freed_bytes
from rse_pf.terminal import at_work, counted, format_time

__all__ = ["ACTION"]

# Digits of the id of a version that are printed.
_SHORT = 12
# Characters of a value of the provenance that are printed; a longer one is cut.
_MAX_VALUE = 80


@dataclass(frozen=True, kw_only=True)
class _ShowRequest(VersionRequest):
    all: bool = option("--all", help="list every version")
    png: Path | None = option("--png", metavar="FILE", help="write an image of the map")


@dataclass(frozen=True, kw_only=True)
class _ViewRequest(VersionRequest):
    out: Path | None = option("--out", metavar="FILE", help="the image (default: MAP.png)")


@dataclass(frozen=True, kw_only=True)
class _MergeRequest(StoreRequest):
    names: tuple[str, ...] = option(
        nargs="+",
        metavar="MAP",
        help="MAP or MAP@VERSION; the world frame of the first is kept; a single map gets its loops closed",
    )
    into: str = option("--into", required=True, metavar="NAME", help="the map that gets a new version")
    note: str = option("--note", default="", help="note of the new version")


@dataclass(frozen=True, kw_only=True)
class _DiffRequest(MapRequest):
    before: str = option(metavar="BEFORE", help="a version")
    after: str = option(nargs="?", default="head", metavar="AFTER", help="default: %(default)s")


@dataclass(frozen=True, kw_only=True)
class _RollbackRequest(MapRequest):
    version: str = option(metavar="VERSION", help="the version to go back to")


@dataclass(frozen=True, kw_only=True)
class _PruneRequest(MapRequest):
    keep: int = option(
        "--keep",
        required=True,
        metavar="N",
        help="number of the newest versions to keep; the head is always kept",
    )


def _check_folder(file: Path) -> None:
    """Raise UsageError if the folder of *file*, which is to be written, does not exist."""
    folder = file.absolute().parent
    if not folder.is_dir():
        raise UsageError(
            f"there is no folder {folder}", hint=f"create it (mkdir -p {folder}), or name another file"
        )


def _list(request: StoreRequest, settings: PlatformSettings) -> None:
    """Print the head, the current version, of each map of the tenant."""
    maps = request.open_maps(settings)
    heads = {name: maps.head(name) for name in maps.names()}
    request.print(
        [{"name": name, **_fields(head)} for name, head in heads.items()],
        *([f"{name:<24} {_record_line(head)}" for name, head in heads.items()] or ["no maps"]),
    )


def _show(request: _ShowRequest, settings: PlatformSettings) -> None:
    """Print contents and origin of a version, or with --all a line for each version of the map."""
    if request.png is not None:
        _check_folder(request.png)
    maps = request.open_maps(settings)
    if request.all:
        head = head_id(request.name, maps)
        records = maps.versions(request.name)
        request.print(
            [{**_fields(record), "head": record.id == head} for record in records],
            *(f"{'*' if record.id == head else ' '} {_record_line(record)}" for record in records),
        )
        return
    record = maps.record(request.name, request.version)
    version = maps.load(request.name, record.id)
    kinds = Counter(str(edge.kind) for edge in version.edges)
    robots = Counter(keyframe.robot for keyframe in version.keyframes)
    request.print(
        {
            **_fields(record),
            "edges_by_kind": kinds,
            "keyframes_by_robot": robots,
            "provenance": dict(version.provenance),
        },
        *_rows(
            ("version", f"{record.number}  {record.id}"),
            ("parent", record.parent or "-"),
            ("made by", f"{record.author}, {format_time(record.created_s)}  {record.note}".rstrip()),
            ("keyframes", f"{record.keyframes}  ({_counts(robots)})"),
            ("edges", f"{record.edges}  ({_counts(kinds)})"),
            ("points", record.points),
            ("size", f"{record.size} bytes, sha256 {record.digest}"),
            *(
                ("provenance", f"{key} = {_shorten(str(version.provenance[key]))}")
                for key in sorted(version.provenance)
            ),
        ),
    )
    if request.png is not None:
        _draw(request.png, request.name, maps, record)


def _view(request: _ViewRequest, settings: PlatformSettings) -> None:
    maps = request.open_maps(settings)
    record = maps.record(request.name, request.version)
    out = request.out or Path(f"{request.name}.png")
    _draw(out, request.name, maps, record)
    request.print(
        {"file": str(out), "id": record.id},
        f"{out}: {request.name}, version {record.number}",
    )


def _merge(request: _MergeRequest, settings: PlatformSettings) -> int:
    """Merge maps of the store into the next version of map --into; return 1 if any map was not joined."""
    from rse_pf.services.mapping.merge import MergeRequest, merge_maps

    maps = request.open_maps(settings)
    names = [split_version(word) for word in request.names]
    records = [maps.record(*each) for each in names]
    parent = head_id(request.into, maps)
    wanted = MergeRequest(
        maps=[maps.data(name, record.id) for (name, _), record in zip(names, records, strict=True)]
    )
    began = time.perf_counter()
    reply = merge_maps(wanted, report=merge_progress)
    seconds = round(time.perf_counter() - began, 3)
    origin = MapOrigin(parent=parent, author="rse-pf map merge", created_s=time.time(), note=request.note)
    return commit_merge(
        reply, maps, request.names, into=request.into, origin=origin,
        json_fields={"seconds": seconds} if request.json else None,
    )  # fmt: skip


def _diff(request: _DiffRequest, settings: PlatformSettings) -> None:
    """Print which keyframes, edges and points two versions of a map do not have in common."""
    maps = request.open_maps(settings)
    found = compare_versions(maps.load(request.name, request.before), maps.load(request.name, request.after))
    request.print(
        msgspec.to_builtins(found),
        *_rows(
            ("keyframes", f"+{len(found.added)} -{len(found.removed)}, {len(found.moved)} moved"),
            ("largest", f"{found.largest_move_m:.4f} m, {found.largest_turn_deg:.3f} deg"),
            ("edges", f"+{len(found.edges_added)} -{len(found.edges_removed)}"),
            ("points", f"{found.points_before} -> {found.points_after}"),
        ),
    )


def _rollback(request: _RollbackRequest, settings: PlatformSettings) -> None:
    """Set the head of a map to an earlier version; no version is removed."""
    maps = request.open_maps(settings)
    head = maps.head(request.name)
    record = maps.move_head(request.name, request.version, expected=head.id)
    request.print(
        {"was": head.id, "head": record.id},
        f"the head of {request.name} was {head.id[:_SHORT]} and is {record.id[:_SHORT]}",
    )


def _prune(request: _PruneRequest, settings: PlatformSettings) -> None:
    """Remove the versions of a map, except for the head and the --keep newest, and print what was removed."""
    if request.keep < 1:
        raise UsageError(f"--keep {request.keep} is below 1", hint="1 keeps the head and the newest version")
    maps = request.open_maps(settings)
    removed = maps.remove(request.name, functools.partial(choose_superseded, keep=request.keep))
    freed = count_freed_bytes(removed)
    request.print(
        {"removed": [_fields(record) for record in removed], "freed_bytes": freed},
        *map(_record_line, removed),
        f"{counted(len(removed), 'version')} of {request.name} removed, {freed} bytes freed",
    )


def _draw(png: Path, name: str, maps: MapRegistry, record: MapRecord) -> None:
    """Draw points and paths of a version of map *name* into *png*; raises UsageError if it has none."""
    from rse_pf.maps.map_image import RobotPath, draw_map

    _check_folder(png)
    version = maps.load(name, record.id)
    if not version.keyframes:
        raise UsageError("a map without keyframes cannot be drawn", hint="export its cloud as ply")
    robots = []
    for robot in record.robots:
        own = sorted((k for k in version.keyframes if k.robot == robot), key=lambda k: k.timestamp_s)
        robots.append(RobotPath(name=robot, T_world_camera=np.stack([k.T_world_camera for k in own])))
    caption = f"{name}, version {record.number}: {counted(record.keyframes, 'keyframe')}, "
    caption += f"{record.points:,} point{'s' * (record.points != 1)}"
    with at_work("drawing the map"):
        draw_map(png, version.points, version.colours, robots, caption)


def _record_line(record: MapRecord) -> str:
    """Return number, id, time, counts and note of a version as one line."""
    counts = ", ".join(
        (
            counted(record.keyframes, "keyframe"),
            counted(record.edges, "edge"),
            counted(record.points, "point"),
        )
    )
    columns = (f"{record.number:>4}", record.id[:_SHORT], format_time(record.created_s), counts, record.note)
    return "  ".join(columns).rstrip()


def _fields(record: MapRecord) -> dict[str, Any]:
    """Return the record of a version as plain JSON values."""
    return {"id": record.id, **msgspec.to_builtins(record)}


def _counts(counted: Counter[str]) -> str:
    return ", ".join(f"{name} {counted[name]}" for name in sorted(counted)) or "none"


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]} ... (whole with --json)"


def _rows(*rows: tuple[str, object]) -> list[str]:
    return [f"{name:<11} {value}" for name, value in rows]


ACTION = Action(
    actions={
        "list": Action(
            help="list the maps",
            example="rse-pf map list",
            request=StoreRequest,
            run=_list,
        ),
        "show": Action(
            help="show the contents and the origin of a version",
            example="rse-pf map show kitchen --png kitchen.png",
            request=_ShowRequest,
            run=_show,
        ),
        "view": Action(
            help="draw a version as an image",
            example="rse-pf map view kitchen --out kitchen.png",
            request=_ViewRequest,
            run=_view,
        ),
        "merge": Action(
            help="merge several maps into one, or close the loops of one map",
            example="rse-pf map merge robot-1 robot-2 --into kitchen",
            request=_MergeRequest,
            run=_merge,
        ),
        "localise": Action(
            help="estimate the camera poses of images in a map",
            example="rse-pf map localise kitchen frame.png",
            request=LocaliseRequest,
            run=run_localise,
        ),
        "diff": Action(
            help="show the differences between two versions",
            example="rse-pf map diff kitchen 3f9bd1 head",
            request=_DiffRequest,
            run=_diff,
        ),
        "rollback": Action(
            help="set the head to an earlier version",
            example="rse-pf map rollback kitchen 3f9bd1",
            request=_RollbackRequest,
            run=_rollback,
        ),
        "prune": Action(
            help="remove all but the newest versions",
            example="rse-pf map prune kitchen --keep 10",
            request=_PruneRequest,
            run=_prune,
        ),
        **extension_actions(export="rse_pf.extensions.map_export.command"),
        "backup": Action(
            help="write all maps of a tenant into one file",
            example="rse-pf map backup acme.maps --tenant acme",
            request=BackupRequest,
            run=run_backup,
        ),
        "restore": Action(
            help="restore the maps of a tenant from a backup",
            example="rse-pf map restore acme.maps --tenant acme",
            request=RestoreRequest,
            run=run_restore,
        ),
        "publish": Action(
            help="publish a live map as the next version of its map",
            example="rse-pf map publish warehouse",
            request=MapRequest,
            run=run_publish,
        ),
        "from-camera": Action(
            help="make a map from a camera, a video or images",
            description="Make a map from a camera, a video or images, through a platform.",
            example="rse-pf map from-camera 0 --intrinsics intrinsics.json --scale marker:100",
            request=FromCameraRequest,
            run=run_from_camera,
        ),
        "from-bag": Action(
            help="make a map from a ROS bag, without ROS",
            description="Make a map from a ROS 1 bag, or a ROS 2 bag (sqlite3, MCAP), through a platform.",
            example="rse-pf map from-bag kitchen.bag --out out-bag",
            request=FromBagRequest,
            run=run_from_bag,
        ),
        "to-bag": Action(
            help="write paths and clouds as a ROS bag",
            description="Write the paths and the cloud of a folder of results as a ROS bag.",
            example="rse-pf map to-bag out-bag --out map.mcap",
            request=ToBagRequest,
            run=run_to_bag,
        ),
        "live": Action(help="list, show, start, stop and correct live maps", actions=LIVE_ACTIONS),
    }
)
