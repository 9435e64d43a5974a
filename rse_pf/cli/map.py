"""Work with the maps that robots share: look at them, merge them, find a camera in them, go back.

Works on the store itself (--store, by default data.store; rse-pf local keeps its own in STATE/objects).  A
VERSION is head, or six or more digits of an id; show --all lists the ids.  rollback lets the head name an
earlier version and deletes nothing.  Each action has a page of its own: rse-pf map merge --help.

examples:
  rse-pf map list --store dir:objects
  rse-pf map show kitchen --store dir:objects --png kitchen.png
  rse-pf map merge robot-1 robot-2 robot-3 --into kitchen --store dir:objects
  rse-pf map localise kitchen recordings/kitchen:0-40 --store dir:objects
  rse-pf map view kitchen --out kitchen.png --store dir:objects
  rse-pf map diff kitchen 3f9bd1 head --store dir:objects
  rse-pf map export kitchen --format ply --out kitchen.ply --store dir:objects
"""

from __future__ import annotations

import argparse
import contextlib
import json
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.cli.data import open_any_store
from rse_pf.cli.operator import record_map_change
from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound, UsageError
from rse_pf.files import replace_file
from rse_pf.maps.export import FORMATS, export_map
from rse_pf.maps.registry import MapRecord, MapRegistry, difference

__all__ = ["add_arguments", "run"]

_SHORT = 12
_MAX_VALUE = 80
_ACTIONS = {
    "list": ("list the maps", "list"),
    "show": ("show a version: what is in it, and where it came from", "show kitchen --png kitchen.png"),
    "view": ("draw a version, or walk around in it in the browser", "view kitchen --out kitchen.png"),
    "merge": ("make one map of several, or close the loops of one", "merge robot-1 robot-2 --into kitchen"),
    "localise": ("find where frames were taken in a map", "localise kitchen frame.png"),
    "diff": ("show what differs between two versions", "diff kitchen 3f9bd1 head"),
    "rollback": ("let the head name an earlier version", "rollback kitchen 3f9bd1"),
    "export": ("write a version for another program", "export kitchen --format ply --out kitchen.ply"),
}
"""Name, one line of help, and an example."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--store", help="where the maps are: dir:PATH or s3:BUCKET (default: data.store)")
    common.add_argument("--tenant", default="default", help="whose maps (default: %(default)s)")
    common.add_argument("--json", action="store_true", help="print JSON")
    made = {
        name: actions.add_parser(
            name, parents=[common], help=text, description=f"{text[0].upper()}{text[1:]}.",
            epilog=f"example:\n  rse-pf map {example} --store dir:objects",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for name, (text, example) in _ACTIONS.items()
    }  # fmt: skip
    for name in ("show", "view", "diff", "rollback", "export", "localise"):
        made[name].add_argument("name", metavar="MAP", help="name of the map")
    for name in ("show", "view", "export"):
        made[name].add_argument(
            "version", nargs="?", default="head", metavar="VERSION", help="default: %(default)s"
        )
    made["show"].add_argument("--all", action="store_true", help="list every version")
    made["show"].add_argument("--png", type=Path, metavar="FILE", help="draw the map there")
    made["view"].add_argument("--out", type=Path, metavar="FILE", help="the picture (default: MAP.png)")
    made["view"].add_argument(
        "--browser",
        action="store_true",
        help='walk around in it in the browser (extra "view"); Ctrl-C ends it',
    )
    made["view"].add_argument("--port", type=int, default=8080, help="of the browser's page (default: 8080)")
    made["diff"].add_argument("before", metavar="BEFORE", help="a version")
    made["diff"].add_argument(
        "after", nargs="?", default="head", metavar="AFTER", help="default: %(default)s"
    )
    made["rollback"].add_argument("version", metavar="VERSION", help="the version to go back to")
    made["export"].add_argument("--format", choices=tuple(FORMATS), required=True, help="which program's")
    made["export"].add_argument("--out", type=Path, required=True, metavar="FILE", help="where to")
    made["export"].add_argument("--robot", help="tum: this robot's keyframes only")
    merge, localise = made["merge"], made["localise"]
    merge.add_argument(
        "names", nargs="+", metavar="MAP", help="MAP or MAP@VERSION; the first one's world is kept; "
        "of one map alone the loops are closed",
    )  # fmt: skip
    merge.add_argument("--into", required=True, metavar="NAME", help="the map that gets a new version")
    merge.add_argument("--note", default="", help="what is written beside the version")
    localise.add_argument(
        "frames",
        nargs="+",
        metavar="FRAME",
        help="an image, a recording, RECORDING:ROW or RECORDING:FIRST-LAST",
    )
    localise.add_argument("--every", type=int, default=1, metavar="N", help="only every n-th of them")
    localise.add_argument(
        "--camera",
        metavar="FX,FY,CX,CY",
        help="of images, pixels (default: the map's, if the size is the same)",
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action and return the exit code."""
    chosen = settings if args.store is None else settings.replace(data={"store": args.store})
    if chosen.data.store == "memory:":
        raise UsageError("maps in memory belong to another process", hint="name --store dir:PATH")

    def told(action: str, name: str, record: MapRecord) -> None:
        record_map_change(chosen, action, name, version=record.id, number=record.number)

    max_bytes = 4 * chosen.data.max_object_bytes
    maps = MapRegistry(open_any_store(chosen), args.tenant, max_bytes=max_bytes, told=told)
    if args.action in ("merge", "localise"):
        return _work(args, maps)
    actions = {
        "list": _list,
        "show": _show,
        "view": _view,
        "diff": _diff,
        "rollback": _rollback,
        "export": _export,
    }
    actions[args.action](args, maps)
    return 0


def _work(args: argparse.Namespace, maps: MapRegistry) -> int:
    from rse_pf.cli import map_work

    if args.action == "merge":
        return map_work.merge_into(args, maps)
    if args.every < 1:
        raise UsageError(f"--every {args.every} is below 1", hint="1 takes every frame")
    return map_work.localise_frames(args, maps)


def _list(args: argparse.Namespace, maps: MapRegistry) -> None:
    heads = {name: maps.head(name) for name in maps.names()}
    if args.json:
        _print_json([{"name": name, **_fields(head)} for name, head in heads.items()])
        return
    if not heads:
        print("no maps")
    for name, head in heads.items():
        print(f"{name:<24} {_line(head)}")


def _show(args: argparse.Namespace, maps: MapRegistry) -> None:
    if args.all:
        head = _id_of_head(args, maps)
        records = maps.versions(args.name)
        if args.json:
            _print_json([{**_fields(record), "head": record.id == head} for record in records])
            return
        for record in records:
            print(f"{'*' if record.id == head else ' '} {_line(record)}")
        return
    record = maps.record(args.name, args.version)
    version = maps.load(args.name, record.id)
    kinds = Counter(str(edge.kind) for edge in version.edges)
    robots = Counter(keyframe.robot for keyframe in version.keyframes)
    if args.json:
        _print_json(
            {**_fields(record), "edges_by_kind": kinds, "keyframes_by_robot": robots,
             "provenance": version.provenance}
        )  # fmt: skip
    else:
        print(f"version     {record.number}  {record.id}")
        print(f"parent      {record.parent or '-'}")
        print(f"made by     {record.author}, {_when(record.created_s)}" + f"  {record.note}".rstrip())
        print(f"keyframes   {record.keyframes}  ({_counts(robots)})")
        print(f"edges       {record.edges}  ({_counts(kinds)})")
        print(f"points      {record.points}")
        print(f"size        {record.size} bytes, sha256 {record.digest}")
        for key in sorted(version.provenance):
            print(f"provenance  {key} = {_shortened(str(version.provenance[key]))}")
    if args.png is not None:
        _draw(args, maps, record)


def _view(args: argparse.Namespace, maps: MapRegistry) -> None:
    record = maps.record(args.name, args.version)
    if args.browser:
        from rse_pf.experiments.plots.map_viewer import browse_map

        version = maps.load(args.name, record.id)
        with contextlib.suppress(KeyboardInterrupt):
            browse_map(version, args.port, _say_page, threading.Event())
        return
    args.png = args.out or Path(f"{args.name}.png")
    _draw(args, maps, record)
    if args.json:
        _print_json({"file": str(args.png), "id": record.id})
    else:
        print(f"{args.png}: {args.name}, version {record.number}")


def _say_page(url: str) -> None:
    print(f"{url}  (Ctrl-C ends it)", flush=True)


def _diff(args: argparse.Namespace, maps: MapRegistry) -> None:
    found = difference(maps.load(args.name, args.before), maps.load(args.name, args.after))
    if args.json:
        _print_json(msgspec.to_builtins(found))
        return
    print(f"keyframes   +{len(found.added)} -{len(found.removed)}, {len(found.moved)} moved")
    print(f"largest     {found.largest_move_m:.4f} m, {found.largest_turn_deg:.3f} deg")
    print(f"edges       +{len(found.edges_added)} -{len(found.edges_removed)}")
    print(f"points      {found.points_before} -> {found.points_after}")


def _rollback(args: argparse.Namespace, maps: MapRegistry) -> None:
    head = maps.head(args.name)
    record = maps.move_head(args.name, args.version, expected=head.id)
    if args.json:
        _print_json({"was": head.id, "head": record.id})
    else:
        print(f"the head of {args.name} was {head.id[:_SHORT]} and is {record.id[:_SHORT]}")


def _export(args: argparse.Namespace, maps: MapRegistry) -> None:
    if not args.out.absolute().parent.is_dir():
        raise UsageError(f"there is no folder {args.out.absolute().parent}", hint="make it")
    data = export_map(maps.load(args.name, args.version), args.format, args.robot)
    replace_file(args.out, data)
    if args.json:
        _print_json({"file": str(args.out), "bytes": len(data)})
    else:
        print(f"{args.out}: {len(data)} bytes")


def _draw(args: argparse.Namespace, maps: MapRegistry, record: MapRecord) -> None:
    from rse_pf.experiments.plots.map_image import PathOfRobot, draw_map

    if not args.png.absolute().parent.is_dir():
        raise UsageError(f"there is no folder {args.png.absolute().parent}", hint="make it")
    version = maps.load(args.name, record.id)
    if not version.keyframes:
        raise UsageError("a map without keyframes cannot be drawn", hint="export its cloud as ply")
    robots = []
    for robot in record.robots:
        own = sorted((k for k in version.keyframes if k.robot == robot), key=lambda k: k.timestamp_s)
        robots.append(PathOfRobot(name=robot, T_world_camera=np.stack([k.T_world_camera for k in own])))
    caption = f"{args.name}, version {record.number}: {record.keyframes} keyframes, {record.points:,} points"
    draw_map(args.png, version.points, version.colours, robots, caption)


def _id_of_head(args: argparse.Namespace, maps: MapRegistry) -> str | None:
    try:
        return maps.head(args.name).id
    except NotFound:
        return None


def _line(record: MapRecord) -> str:
    counts = f"{record.keyframes} keyframes, {record.edges} edges, {record.points} points"
    told = (f"{record.number:>4}", record.id[:_SHORT], _when(record.created_s), counts, record.note)
    return "  ".join(told).rstrip()


def _fields(record: MapRecord) -> dict[str, Any]:
    return {"id": record.id, **msgspec.to_builtins(record)}


def _counts(counted: Counter[str]) -> str:
    return ", ".join(f"{name} {counted[name]}" for name in sorted(counted)) or "none"


def _shortened(text: str) -> str:
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]} ... (whole with --json)"


def _when(created_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(created_s))


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, sort_keys=True, default=str))
