"""Live maps, which robots make together while they drive: ``rse-pf map live`` and ``rse-pf map publish``.

Works on the store, and through it with the owner of the map, which must be reachable from this machine.  An
owner is started here for the command if no server has the map now; ``list`` and ``show`` start none.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rse_pf.audit.operator import record_map_change
from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, NotFound
from rse_pf.identity import RobotId, shown_name
from rse_pf.terminal import counted, show, show_json
from rse_pf.wire.live_map import LiveForget, LiveMapRequest, LiveRequest, LiveStart

if TYPE_CHECKING:
    from rse_pf.server.live_map.client import LiveMapClient

__all__ = ["LIVE_ACTIONS", "add_live_arguments", "run_live", "run_publish"]

_DEADLINE_S = 30.0
_OWNER_S = 3.0
"""After this the owner of a map that is only shown counts as gone."""
LIVE_ACTIONS = {
    "list": ("list the live maps", "list"),
    "show": ("show the robots and the owner of a live map", "show warehouse"),
    "start": ("begin a live map, empty or with a version of a map", "start warehouse --from warehouse"),
    "stop": ("publish a live map and end it", "stop warehouse"),
    "forget": ("take out what a robot contributed", "forget warehouse robot-1"),
}
"""Name, one line of help, and an example."""


def add_live_arguments(parser: argparse.ArgumentParser, common: argparse.ArgumentParser) -> None:
    """Declare the actions of ``map live``; each has the options of *common*."""
    actions = parser.add_subparsers(dest="live_action", required=True, metavar="ACTION")
    for name, (text, example) in LIVE_ACTIONS.items():
        made = actions.add_parser(
            name, parents=[common], help=text, description=f"{text[0].upper()}{text[1:]}.",
            epilog=f"example:\n  rse-pf map live {example} --store dir:objects",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        if name != "list":
            made.add_argument("name", metavar="MAP", help="name of the live map")
        if name == "start":
            made.add_argument(
                "--from", dest="source", default="", metavar="VERSION",
                help="MAP, MAP@VERSION, or a version of the map of the same name (default: an empty map)",
            )  # fmt: skip
            made.add_argument(
                "--equal-rooms-m", type=float, default=0.0, metavar="METRES",
                help="size of rooms that look the same; what joins robots must reach farther (default: 0)",
            )  # fmt: skip
        if name == "forget":
            made.add_argument("robot", metavar="ROBOT", help="name of the robot")


def run_live(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action of ``map live`` and return the exit code."""
    actions: dict[str, Callable[[argparse.Namespace, PlatformSettings], None]] = {
        "list": _list, "show": _show, "start": _start, "stop": _stop, "forget": _forget,
    }  # fmt: skip
    actions[args.live_action](args, settings)
    return 0


def run_publish(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Publish a live map as the next version of the map of the same name."""
    reply = _ask(args, settings, "live-publish", LiveMapRequest(map=args.name))
    _record(args, settings, reply)
    _print(args, reply, _publication_line(args.name, reply))
    return 0


def _list(args: argparse.Namespace, settings: PlatformSettings) -> None:
    rows = asyncio.run(_with_links(settings, lambda links: links.list_maps(args.tenant)))
    lines = [f"{row['name']:<24} {row['state']:<8} {row['server']}" for row in rows]
    _print(args, rows, *(lines or ["no live maps"]))


def _show(args: argparse.Namespace, settings: PlatformSettings) -> None:
    try:
        request = LiveMapRequest(map=args.name)
        reply = _ask(args, settings.replace(live={"max_owners": 0}), "live-show", request, _OWNER_S)
    except Busy:
        reply = {}
    if not reply or reply["state"] == "none":
        reply = _read(args, settings)
    del reply["you"]
    robots = [
        f"{row['robot']}: {counted(row['keyframes'], 'keyframe')}, "
        + ("in the map" if row["aligned"] else f"not in the map: {row['reason']}")
        for row in reply["robots"]
    ]
    _print(
        args,
        reply,
        f"{'state':<11}{reply['state']}",
        f"{'owner':<11}{reply['server'] or '-'}",
        f"{'keyframes':<11}{reply['keyframes']}, {counted(reply['links'], 'link')}",
        f"{'log':<11}{counted(reply['version'], 'entry')}".replace("entrys", "entries"),
        *(f"{'robot' if row == 0 else '':<11}{robot}" for row, robot in enumerate(robots)),
    )


def _start(args: argparse.Namespace, settings: PlatformSettings) -> None:
    request = LiveStart(map=args.name, source=args.source, equal_rooms_m=args.equal_rooms_m)
    reply = _ask(args, settings, "live-start", request)
    _print(args, reply, f"{args.name} has begun with {counted(reply['keyframes'], 'keyframe')}")


def _stop(args: argparse.Namespace, settings: PlatformSettings) -> None:
    reply = _ask(args, settings, "live-stop", LiveMapRequest(map=args.name))
    if reply:
        _record(args, settings, reply)
    what = (
        _publication_line(args.name, reply) if reply else f"{args.name} was empty, so nothing was published"
    )
    _print(args, reply, f"{args.name} was stopped", what)


def _forget(args: argparse.Namespace, settings: PlatformSettings) -> None:
    reply = _ask(args, settings, "live-forget", LiveForget(map=args.name, robot=args.robot))
    _print(args, reply, f"{args.name} holds nothing of {args.robot} any more")


def _publication_line(name: str, reply: dict[str, Any]) -> str:
    return f"{name} is now version {reply['number']}, {reply['version'][:12]}: " + counted(
        reply["keyframes"], "keyframe"
    )


def _record(args: argparse.Namespace, settings: PlatformSettings, reply: dict[str, Any]) -> None:
    subject = str(RobotId(args.tenant, args.name))
    record_map_change(settings, "map.commit", subject, version=reply["version"], number=reply["number"])


def _ask(
    args: argparse.Namespace, settings: PlatformSettings, operation: str, request: LiveRequest,
    deadline_s: float = _DEADLINE_S,
) -> dict[str, Any]:  # fmt: skip
    """Return what the owner of the map answers; raises what it refuses, or Busy."""
    from rse_pf.server.live_map.lease import map_folder

    map_folder(args.tenant, args.name)  # refuse a wrong name first
    operator = RobotId(args.tenant, "operator")

    async def ask(links: LiveMapClient) -> dict[str, Any]:
        return await links.request(args.tenant, args.name, operator, operation, request, deadline_s)

    return asyncio.run(_with_links(settings, ask))


async def _with_links(settings: PlatformSettings, act: Callable[[LiveMapClient], Any]) -> Any:
    from rse_pf.server.live_map.client import LiveMapClient
    from rse_pf.server.log import JsonLog

    settings = settings.replace(serving={"log_level": "error"})  # the owner's lines are for a server's log
    log = JsonLog(level="error", server="operator", wall_clock=time.time).start()
    links = LiveMapClient(
        store=open_data_store(settings), settings=settings, server_id=f"operator-{os.getpid()}",
        log=log, on_update=lambda tenant, name, payload: None,
    )  # fmt: skip
    try:
        return await act(links)
    finally:
        await links.close()
        log.close()


def _read(args: argparse.Namespace, settings: PlatformSettings) -> dict[str, Any]:
    """Return what the log says of a map that has no owner now; raises NotFound."""
    from rse_pf.server.live_map.lease import decode_lease, lease_name, map_folder
    from rse_pf.server.live_map.map_server.environment import LIVE_MAP
    from rse_pf.server.live_map.map_server.log import LiveLog
    from rse_pf.server.live_map.map_server.messages import show_reply
    from rse_pf.server.live_map.map_server.state import restore

    store = open_data_store(settings)
    name = lease_name(args.tenant, args.name)
    try:
        lease = decode_lease(name, store.get(name))
    except NotFound:
        lease = None
    if lease is None or lease.state == "stopped":
        why = "there is no" if lease is None else "somebody stopped the"
        raise NotFound(f"{why} live map {args.name!r}", hint="see rse-pf map live list")
    log = LiveLog(store, map_folder(args.tenant, args.name), owner="", epoch=0, base=lease.base)
    state = restore(log, LIVE_MAP)
    return show_reply(
        RobotId(args.tenant, "operator"), state, lease, service_state="idle", name_of=shown_name,
        is_present=lambda folder: False,
    )  # fmt: skip


def _print(args: argparse.Namespace, value: Any, *lines: str) -> None:
    if args.json:
        show_json(value)
        return
    show(*lines)
