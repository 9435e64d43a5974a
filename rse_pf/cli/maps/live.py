"""Show and change live maps, which robots make together: ``rse-pf map live`` and ``rse-pf map publish``.

Each live map has one map server, a process of some backend server; its address is in the store, and it must
be reachable from this machine.  If no server has the map now, a map server is started here for the time of
the command, which needs the extra ``maps``; ``list`` and ``show`` start none.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rse_pf.audit.operator import record_map_change
from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.extras import require
from rse_pf.command_line.map_store import MapRequest, StoreRequest
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, NotFound
from rse_pf.identity import RobotId, shown_name
from rse_pf.terminal import counted
from rse_pf.wire.live_map import LiveForget, LiveMapRequest, LiveRequest, LiveStart

if TYPE_CHECKING:
    from rse_pf.server.live_map.client import LiveMapClient

__all__ = ["LIVE_ACTIONS", "run_publish"]

# Time limit of a request to a map server, in seconds.
_DEADLINE_S = 30.0
# Time limit of a request to a map server in rse-pf map live show, in seconds; then the state is read from the
# store.
_SHOW_DEADLINE_S = 3.0


@dataclass(frozen=True, kw_only=True)
class _StartRequest(MapRequest):
    source: str = option(
        "--from",
        default="",
        metavar="VERSION",
        help="MAP, MAP@VERSION, or a version of the map of the same name (default: an empty map)",
    )
    equal_rooms_m: float = option(
        "--equal-rooms-m",
        default=0.0,
        metavar="METRES",
        help="size of rooms that look the same; the maps of two robots are joined only by views "
        "that extend farther than this (default: 0)",
    )


@dataclass(frozen=True, kw_only=True)
class _ForgetRequest(MapRequest):
    robot: str = option(metavar="ROBOT", help="name of the robot")


def run_publish(request: MapRequest, settings: PlatformSettings) -> None:
    """Publish a live map as the next version of the map of the same name, and print that version."""
    require("map publish")
    settings = request.settings_with_store(settings)
    reply = _ask(request, settings, "live-publish", LiveMapRequest(map=request.name))
    _record(request, settings, reply)
    request.print(reply, _publication_line(request.name, reply))


def _list(request: StoreRequest, settings: PlatformSettings) -> None:
    """Print name, state and map server of each live map of the tenant."""
    settings = request.settings_with_store(settings)
    rows = asyncio.run(_with_client(settings, lambda client: client.list_maps(request.tenant)))
    lines = [f"{row['name']:<24} {row['state']:<8} {row['server']}" for row in rows]
    request.print(rows, *(lines or ["no live maps"]))


def _show(request: MapRequest, settings: PlatformSettings) -> None:
    """Print state, map server, size and robots of a live map, from its map server or else from the store."""
    settings = request.settings_with_store(settings)
    try:
        without_servers = settings.replace(live={"max_owners": 0})
        reply = _ask(
            request, without_servers, "live-show", LiveMapRequest(map=request.name), _SHOW_DEADLINE_S
        )
    except Busy:
        reply = {}
    if not reply or reply["state"] == "none":
        reply = _read(request, settings)
    del reply["you"]
    robots = [
        f"{row['robot']}: {counted(row['keyframes'], 'keyframe')}, "
        + ("in the map" if row["aligned"] else f"not in the map: {row['reason']}")
        for row in reply["robots"]
    ]
    request.print(
        reply,
        f"{'state':<11}{reply['state']}",
        f"{'server':<11}{reply['server'] or '-'}",
        f"{'keyframes':<11}{reply['keyframes']}, {counted(reply['links'], 'loop closure')}",
        f"{'log':<11}{counted(reply['version'], 'entry')}".replace("entrys", "entries"),
        *(f"{'robot' if row == 0 else '':<11}{robot}" for row, robot in enumerate(robots)),
    )


def _start(request: _StartRequest, settings: PlatformSettings) -> None:
    """Begin a live map, empty or with the keyframes of a version of a map."""
    require("map live")
    settings = request.settings_with_store(settings)
    start = LiveStart(map=request.name, source=request.source, equal_rooms_m=request.equal_rooms_m)
    reply = _ask(request, settings, "live-start", start)
    request.print(reply, f"{request.name} has begun with {counted(reply['keyframes'], 'keyframe')}")


def _stop(request: MapRequest, settings: PlatformSettings) -> None:
    """Publish a live map as a version, unless it is empty, and close it."""
    require("map live")
    settings = request.settings_with_store(settings)
    reply = _ask(request, settings, "live-stop", LiveMapRequest(map=request.name))
    if reply:
        _record(request, settings, reply)
    what = (
        _publication_line(request.name, reply)
        if reply
        else f"{request.name} was empty, so nothing was published"
    )
    request.print(reply, f"{request.name} was stopped", what)


def _forget(request: _ForgetRequest, settings: PlatformSettings) -> None:
    """Remove all that one robot contributed to a live map."""
    require("map live")
    settings = request.settings_with_store(settings)
    reply = _ask(request, settings, "live-forget", LiveForget(map=request.name, robot=request.robot))
    request.print(reply, f"{request.name} holds nothing of {request.robot} any more")


def _publication_line(name: str, reply: dict[str, Any]) -> str:
    return f"{name} is now version {reply['number']}, {reply['version'][:12]}: " + counted(
        reply["keyframes"], "keyframe"
    )


def _record(request: MapRequest, settings: PlatformSettings, reply: dict[str, Any]) -> None:
    """Write the version in *reply* to the platform's audit log, as ``map.commit``."""
    subject = str(RobotId(request.tenant, request.name))
    record_map_change(settings, "map.commit", subject, version=reply["version"], number=reply["number"])


def _ask(
    request: MapRequest, settings: PlatformSettings, operation: str, message: LiveRequest,
    deadline_s: float = _DEADLINE_S,
) -> dict[str, Any]:  # fmt: skip
    """Send a request about the live map of *request* to its map server, and return the answer.

    Args:
        request: Tenant and name of the map.
        settings: Settings with the store.
        operation: Name of the operation, such as ``live-stop``.
        message: Content of the request.
        deadline_s: Time limit in seconds.

    Raises:
        Busy: No map server answered in time, or none may be started here.
        RsePfError: The map server refused the request.
    """
    from rse_pf.server.live_map.lease import map_folder

    map_folder(request.tenant, request.name)  # refuse a wrong name first
    operator = RobotId(request.tenant, "operator")

    async def ask(client: LiveMapClient) -> dict[str, Any]:
        return await client.request(request.tenant, request.name, operator, operation, message, deadline_s)

    return asyncio.run(_with_client(settings, ask))


async def _with_client(settings: PlatformSettings, act: Callable[[LiveMapClient], Any]) -> Any:
    """Return what *act* returns for a client of all live maps in the store, which is then closed."""
    from rse_pf.server.live_map.client import LiveMapClient
    from rse_pf.server.log import JsonLog

    settings = settings.replace(
        serving={"log_level": "error"}
    )  # a map server that is started here logs errors only, on standard error
    log = JsonLog(level="error", server="operator", wall_clock=time.time).start()
    client = LiveMapClient(
        store=open_data_store(settings), settings=settings, server_id=f"operator-{os.getpid()}",
        log=log, on_update=lambda tenant, name, payload: None,
    )  # fmt: skip
    try:
        return await act(client)
    finally:
        await client.close()
        log.close()


def _read(request: MapRequest, settings: PlatformSettings) -> dict[str, Any]:
    """Return the state of a live map without a map server, from its lease and log in the store.

    It has the form of the reply to ``live-show``.

    Raises:
        NotFound: There is no such live map, or it was stopped.
    """
    from rse_pf.server.live_map.lease import decode_lease, lease_name, map_folder
    from rse_pf.server.live_map.map_server.environment import LIVE_MAP
    from rse_pf.server.live_map.map_server.log import LiveLog
    from rse_pf.server.live_map.map_server.messages import show_reply
    from rse_pf.server.live_map.map_server.state import restore

    store = open_data_store(settings)
    name = lease_name(request.tenant, request.name)
    try:
        lease = decode_lease(name, store.get(name))
    except NotFound:
        lease = None
    if lease is None or lease.state == "stopped":
        live_map = f"live map {request.name!r}"
        why = f"there is no {live_map}" if lease is None else f"{live_map} was stopped"
        raise NotFound(why, hint="see rse-pf map live list")
    log = LiveLog(store, map_folder(request.tenant, request.name), owner="", epoch=0, base=lease.base)
    state = restore(log, LIVE_MAP)
    return show_reply(
        RobotId(request.tenant, "operator"), state, lease, service_state="idle", name_of=shown_name,
        is_present=lambda folder: False,
    )  # fmt: skip


LIVE_ACTIONS = {
    "list": Action(
        help="list the live maps",
        example="rse-pf map live list",
        request=StoreRequest,
        run=_list,
    ),
    "show": Action(
        help="show the robots and the map server of a live map",
        example="rse-pf map live show warehouse",
        request=MapRequest,
        run=_show,
    ),
    "start": Action(
        help="begin a live map, empty or with a version of a map",
        example="rse-pf map live start warehouse --from warehouse",
        request=_StartRequest,
        run=_start,
    ),
    "stop": Action(
        help="publish a live map and close it",
        example="rse-pf map live stop warehouse",
        request=MapRequest,
        run=_stop,
    ),
    "forget": Action(
        help="remove what a robot contributed",
        example="rse-pf map live forget warehouse robot-1",
        request=_ForgetRequest,
        run=_forget,
    ),
}
