"""Work with the maps that robots share: show, merge, prune, back up, localise in them, roll them back.

Works on the store itself (--store; by default data.store, else that of the platform on this machine, where
from-camera and from-bag keep their maps).  A VERSION is head, or six or more digits of an id; show --all
lists the ids.  rollback sets the head to an earlier version and deletes nothing; prune removes old versions.
Each action has its own help page: rse-pf map merge --help.

examples:
  rse-pf map from-camera 0 --intrinsics intrinsics.json --out out-camera
  rse-pf map from-bag kitchen.bag --out out-bag
  rse-pf map list --store dir:objects
  rse-pf map show kitchen --store dir:objects --png kitchen.png
  rse-pf map merge robot-1 robot-2 robot-3 --into kitchen --store dir:objects
  rse-pf map localise kitchen recordings/kitchen:0-40 --store dir:objects
  rse-pf map localise kitchen photo.jpg --enrolment phone.enrolment --intrinsics intrinsics.json
  rse-pf map view kitchen --out kitchen.png --store dir:objects
  rse-pf map diff kitchen 3f9bd1 head --store dir:objects
  rse-pf map live list --store dir:objects
  rse-pf map backup acme.maps --tenant acme --name lab
  rse-pf map restore acme.maps --tenant acme --name lab
  rse-pf map prune kitchen --keep 10 --store dir:objects
  rse-pf map export kitchen --format ply --out kitchen.ply --store dir:objects
  rse-pf map export kitchen --format occupancy --out kitchen-plan --store dir:objects
"""

from __future__ import annotations

import argparse
import functools
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from rse_pf.cli.maps.backup import add_backup_arguments, add_restore_arguments, run_backup, run_restore
from rse_pf.cli.maps.bags import BAG_ACTIONS, add_bag_actions, export_bag, run_bags
from rse_pf.cli.maps.from_camera import add_from_camera_arguments, run_from_camera
from rse_pf.cli.maps.live import add_live_arguments, run_live, run_publish
from rse_pf.cli.maps.localise import add_localise_arguments, is_remote, localise_frames, localise_photos
from rse_pf.cli.maps.merge_output import commit_merge, merge_progress
from rse_pf.command_line.map_store import open_maps, with_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound, UsageError
from rse_pf.extensions.map_export.command import add_export_arguments, run_export
from rse_pf.maps.registry import MapOrigin, MapRecord, MapRegistry, compare_versions
from rse_pf.maps.removal import choose_superseded, count_freed_bytes
from rse_pf.terminal import at_work, counted, format_time, show, show_json

if TYPE_CHECKING:
    pass

__all__ = ["add_arguments", "run"]

_SHORT = 12
_MAX_VALUE = 80
_ACTIONS = {
    "list": ("list the maps", "list"),
    "show": ("show the contents and the origin of a version", "show kitchen --png kitchen.png"),
    "view": ("draw a version as an image", "view kitchen --out kitchen.png"),
    "merge": (
        "merge several maps into one, or close the loops of one map",
        "merge robot-1 robot-2 --into kitchen",
    ),
    "localise": ("estimate the camera poses of images in a map", "localise kitchen frame.png"),
    "diff": ("show the differences between two versions", "diff kitchen 3f9bd1 head"),
    "rollback": ("set the head to an earlier version", "rollback kitchen 3f9bd1"),
    "prune": ("remove all but the newest versions", "prune kitchen --keep 10"),
    "export": (
        "write a version in the format of another program",
        "export kitchen --format colmap --out kitchen-colmap",
    ),
    "backup": ("write all maps of a tenant into one file", "backup acme.maps --tenant acme"),
    "restore": ("restore the maps of a tenant from a backup", "restore acme.maps --tenant acme"),
    "publish": ("publish a live map as the next version of its map", "publish warehouse"),
}
"""Name, one line of help, and an example."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--store",
        help="store of the maps: dir:PATH or s3:BUCKET (default: data.store, or that of rse-pf local)",
    )
    common.add_argument(
        "--name",
        dest="platform",
        metavar="PLATFORM",
        help="platform of this machine whose maps are meant (default: the one that runs here)",
    )
    common.add_argument(
        "--tenant", default="default", help="tenant that owns the maps (default: %(default)s)"
    )
    common.add_argument("--json", action="store_true", help="print JSON")
    made = {
        name: actions.add_parser(
            name, parents=[common], help=text, description=f"{text[0].upper()}{text[1:]}.",
            epilog=f"example:\n  rse-pf map {example} --store dir:objects",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for name, (text, example) in _ACTIONS.items()
    }  # fmt: skip
    for name in ("show", "view", "diff", "rollback", "prune", "export", "localise", "publish"):
        made[name].add_argument("name", metavar="MAP", help="name of the map")
    for name in ("show", "view", "export"):
        made[name].add_argument(
            "version", nargs="?", default="head", metavar="VERSION", help="default: %(default)s"
        )
    made["show"].add_argument("--all", action="store_true", help="list every version")
    made["show"].add_argument("--png", type=Path, metavar="FILE", help="write an image of the map")
    made["view"].add_argument("--out", type=Path, metavar="FILE", help="the image (default: MAP.png)")
    made["diff"].add_argument("before", metavar="BEFORE", help="a version")
    made["diff"].add_argument(
        "after", nargs="?", default="head", metavar="AFTER", help="default: %(default)s"
    )
    made["rollback"].add_argument("version", metavar="VERSION", help="the version to go back to")
    made["prune"].add_argument(
        "--keep", type=int, required=True, metavar="N", help="how many of the newest stay, besides the head"
    )
    add_export_arguments(made["export"])
    add_backup_arguments(made["backup"])
    add_restore_arguments(made["restore"])
    add_from_camera_arguments(
        actions.add_parser(
            "from-camera", help="make a map from a camera, a video or images",
            description="Make a map from a camera, a video or images, through a platform.",
            epilog="example:\n  rse-pf map from-camera 0 --intrinsics intrinsics.json --scale marker:100",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
    )  # fmt: skip
    add_bag_actions(actions)
    add_live_arguments(
        actions.add_parser(
            "live", help="list, show, start, stop and correct live maps",
            description="List, show, start, stop and correct live maps.",
            epilog="example:\n  rse-pf map live show warehouse --store dir:objects",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        ),
        common,
    )  # fmt: skip
    merge = made["merge"]
    merge.add_argument(
        "names",
        nargs="+",
        metavar="MAP",
        help="MAP or MAP@VERSION; the world frame of the first is kept; a single map gets its loops closed",
    )
    merge.add_argument("--into", required=True, metavar="NAME", help="the map that gets a new version")
    merge.add_argument("--note", default="", help="note of the new version")
    add_localise_arguments(made["localise"])


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action and return the exit code."""
    if args.action == "from-camera":
        return run_from_camera(args, settings)
    if args.action in BAG_ACTIONS:
        return run_bags(args, settings)
    if args.action == "localise" and is_remote(args):
        return localise_photos(args)
    if args.store is not None and args.platform is not None:
        raise UsageError("--store and --name name two stores", hint="leave one of them out")
    chosen = with_store(args.store, settings, args.platform)
    if args.action in ("live", "publish"):
        return (run_live if args.action == "live" else run_publish)(args, chosen)
    if args.action in ("backup", "restore"):
        return (run_backup if args.action == "backup" else run_restore)(args, chosen)
    maps = open_maps(chosen, args.tenant)
    actions: dict[str, Callable[[argparse.Namespace, MapRegistry], int | None]] = {
        "list": _list,
        "show": _show,
        "view": _view,
        "merge": _merge,
        "localise": localise_frames,
        "diff": _diff,
        "rollback": _rollback,
        "prune": _prune,
        "export": functools.partial(run_export, write_bag=export_bag),
    }
    return actions[args.action](args, maps) or 0


def _check_folder(file: Path) -> None:
    folder = file.absolute().parent
    if not folder.is_dir():
        raise UsageError(
            f"there is no folder {folder}", hint=f"create it (mkdir -p {folder}), or name another file"
        )


def _list(args: argparse.Namespace, maps: MapRegistry) -> None:
    heads = {name: maps.head(name) for name in maps.names()}
    _print(
        args,
        [{"name": name, **_fields(head)} for name, head in heads.items()],
        *([f"{name:<24} {_record_line(head)}" for name, head in heads.items()] or ["no maps"]),
    )


def _show(args: argparse.Namespace, maps: MapRegistry) -> None:
    if args.png is not None:
        _check_folder(args.png)
    if args.all:
        head = _id_of_head(args.name, maps)
        records = maps.versions(args.name)
        _print(
            args,
            [{**_fields(record), "head": record.id == head} for record in records],
            *(f"{'*' if record.id == head else ' '} {_record_line(record)}" for record in records),
        )
        return
    record = maps.record(args.name, args.version)
    version = maps.load(args.name, record.id)
    kinds = Counter(str(edge.kind) for edge in version.edges)
    robots = Counter(keyframe.robot for keyframe in version.keyframes)
    _print(
        args,
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
    if args.png is not None:
        _draw(args, maps, record)


def _view(args: argparse.Namespace, maps: MapRegistry) -> None:
    record = maps.record(args.name, args.version)
    args.png = args.out or Path(f"{args.name}.png")
    _draw(args, maps, record)
    _print(
        args,
        {"file": str(args.png), "id": record.id},
        f"{args.png}: {args.name}, version {record.number}",
    )


def _merge(args: argparse.Namespace, maps: MapRegistry) -> int:
    """Merge maps into the next version of one; the exit code is 1 if any was not joined."""
    from rse_pf.services.mapping.merge import MergeRequest, merge_maps

    names = [_version_of(word) for word in args.names]
    records = [maps.record(*each) for each in names]
    parent = _id_of_head(args.into, maps)
    request = MergeRequest(
        maps=[maps.data(name, record.id) for (name, _), record in zip(names, records, strict=True)]
    )
    began = time.perf_counter()
    reply = merge_maps(request, report=merge_progress)
    seconds = round(time.perf_counter() - began, 3)
    origin = MapOrigin(parent=parent, author="rse-pf map merge", created_s=time.time(), note=args.note)
    return commit_merge(
        reply, maps, args.names, into=args.into, origin=origin,
        json_fields={"seconds": seconds} if args.json else None,
    )  # fmt: skip


def _diff(args: argparse.Namespace, maps: MapRegistry) -> None:
    found = compare_versions(maps.load(args.name, args.before), maps.load(args.name, args.after))
    _print(
        args,
        msgspec.to_builtins(found),
        *_rows(
            ("keyframes", f"+{len(found.added)} -{len(found.removed)}, {len(found.moved)} moved"),
            ("largest", f"{found.largest_move_m:.4f} m, {found.largest_turn_deg:.3f} deg"),
            ("edges", f"+{len(found.edges_added)} -{len(found.edges_removed)}"),
            ("points", f"{found.points_before} -> {found.points_after}"),
        ),
    )


def _rollback(args: argparse.Namespace, maps: MapRegistry) -> None:
    head = maps.head(args.name)
    record = maps.move_head(args.name, args.version, expected=head.id)
    _print(
        args,
        {"was": head.id, "head": record.id},
        f"the head of {args.name} was {head.id[:_SHORT]} and is {record.id[:_SHORT]}",
    )


def _prune(args: argparse.Namespace, maps: MapRegistry) -> None:
    if args.keep < 1:
        raise UsageError(f"--keep {args.keep} is below 1", hint="1 keeps the head and the newest version")
    removed = maps.remove(args.name, functools.partial(choose_superseded, keep=args.keep))
    freed = count_freed_bytes(removed)
    _print(
        args,
        {"removed": [_fields(record) for record in removed], "freed_bytes": freed},
        *map(_record_line, removed),
        f"{counted(len(removed), 'version')} of {args.name} removed, {freed} bytes freed",
    )


def _draw(args: argparse.Namespace, maps: MapRegistry, record: MapRecord) -> None:
    from rse_pf.extensions.experiments.plots.map_image import RobotPath, draw_map

    _check_folder(args.png)
    version = maps.load(args.name, record.id)
    if not version.keyframes:
        raise UsageError("a map without keyframes cannot be drawn", hint="export its cloud as ply")
    robots = []
    for robot in record.robots:
        own = sorted((k for k in version.keyframes if k.robot == robot), key=lambda k: k.timestamp_s)
        robots.append(RobotPath(name=robot, T_world_camera=np.stack([k.T_world_camera for k in own])))
    caption = f"{args.name}, version {record.number}: {counted(record.keyframes, 'keyframe')}, "
    caption += f"{record.points:,} point{'s' * (record.points != 1)}"
    with at_work("drawing the map"):
        draw_map(args.png, version.points, version.colours, robots, caption)


def _id_of_head(name: str, maps: MapRegistry) -> str | None:
    try:
        return maps.head(name).id
    except NotFound:
        return None


def _version_of(word: str) -> tuple[str, str]:
    """Return name and version of ``MAP`` or ``MAP@VERSION``."""
    name, _, version = word.partition("@")
    return name, version or "head"


def _record_line(record: MapRecord) -> str:
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
    return {"id": record.id, **msgspec.to_builtins(record)}


def _counts(counted: Counter[str]) -> str:
    return ", ".join(f"{name} {counted[name]}" for name in sorted(counted)) or "none"


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]} ... (whole with --json)"


def _rows(*rows: tuple[str, object]) -> list[str]:
    return [f"{name:<11} {value}" for name, value in rows]


def _print(args: argparse.Namespace, value: Any, *lines: str) -> None:
    """Print *value* with ``--json``, else *lines*."""
    if args.json:
        show_json(value, indent=2, sort_keys=True)
    else:
        show(*lines)
