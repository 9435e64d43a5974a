"""The end of a demo with --merge: the maps of the robots are merged into one, which is drawn and evaluated.

Every robot has committed its map to the data service.  The parent process downloads the maps, stores each as
an object of its own, calls the service ``merge`` with their digests (a job on a backend server), and commits
the result as a map that all robots of the tenant may read.  The maps of the robots are not changed, and a map
that could not be joined is not drawn.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from client_sdk.commands.answer_types import Answer, decode_reply
from client_sdk.point_map import write_ply
from client_sdk.trajectory import Trajectory, write_trajectory
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import SessionSettings
from rse_pf.extensions.experiments.results.map_error import JoinedRobot, joined_robots, merge_section
from rse_pf.maps.format import MapVersion, decode_map
from rse_pf.maps.map_image import RobotPath, draw_map
from rse_pf.services.mapping.merge import MergeReply

__all__ = [
    "MAP_FILE",
    "MERGED_MAP",
    "MergeMaps",
    "merge_on_platform",
    "print_tenths",
    "write_merged",
]

MAP_FILE = "map.rsemap"
"""Name of a robot's map in its folder, encoded by `rse_pf.maps.format.encode_map`."""
MERGED_MAP = "merged.rsemap"
"""Name of the file with the merged map, in the folder of the demo."""
MERGED_NAME = "merged"
"""Name under which the merged map is committed to the data service."""

MergeMaps = Callable[[Sequence[bytes]], tuple[MergeReply, dict[str, Any]]]
"""Function that merges encoded maps.

Returns the reply of ``merge``, and members for the report about the call.
"""


def write_merged(
    folder: Path,
    names: Sequence[str],
    paths: Sequence[Trajectory],
    truths: Sequence[Trajectory | None],
    merge: MergeMaps,
) -> dict[str, Any]:
    """Merge the maps in the folders of the robots, write the results, and return the report's section.

    Writes ``merged.rsemap``, ``merged.ply``, ``map_merged.png``, and ``merged_trajectory.txt`` in the folder
    of every robot that was joined.

    Args:
        folder: Folder of the demo; each robot has a folder of its name in it.
        names: Names of the robots; the world frame of the first one becomes that of the map.
        paths: Estimated trajectories, each in the world frame of its robot.
        truths: True trajectories in one common world frame, where known.
        merge: Merges the encoded maps.

    Raises:
        MissingExtra: The extra "maps" is not installed where the merge runs.
    """
    encoded = [(folder / name / MAP_FILE).read_bytes() for name in names]
    versions = [decode_map(data) for data in encoded]
    reply, origin = merge(encoded)
    merged = decode_map(reply.map)
    robots = joined_robots(names, paths, truths, versions, reply, merged)
    (folder / MERGED_MAP).write_bytes(reply.map)
    write_ply(folder / "merged.ply", merged.points, merged.colours)
    for robot in robots:
        write_trajectory(folder / robot.name / "merged_trajectory.txt", robot.merged)
    section = merge_section(names, robots, reply, merged, origin)
    _draw(folder / "map_merged.png", robots, merged, section)
    return section


def _draw(path: Path, robots: Sequence[JoinedRobot], merged: MapVersion, section: dict[str, Any]) -> None:
    subject = f"{len(robots)} robots" if len(robots) > 1 else "1 robot"
    caption = f"{subject} in one map: {section['keyframes']} keyframes"
    caption += (
        f", {section['loop_closures_between_robots']} loop closures between robots" if len(robots) > 1 else ""
    )
    if section["ate_cm"] is not None:
        caption += f", ATE {section['ate_cm']:.1f} cm"
    if section["not_joined"]:
        caption += f"; not joined: {', '.join(entry['robot'] for entry in section['not_joined'])}"
    shown = [RobotPath(name=robot.name, T_world_camera=robot.merged.T_world_camera) for robot in robots]
    draw_map(path, merged.points, merged.colours, shown, caption)


def merge_on_platform(
    url: str,
    token: str,
    names: Sequence[str],
    session: SessionSettings,
    progress: Callable[[float, str], None],
) -> tuple[MergeReply, dict[str, Any]]:
    """Merge the committed maps *names* on the platform at *url*; block until the result is committed.

    *progress* is called with the completed fraction of the job (0 to 1) and its phase.

    Returns:
        The reply of the service, and for the report the server, the durations in seconds and the map's
        version.

    Raises:
        RsePfError: A transfer or the job failed.
    """
    data = DataClient(url, token)
    try:
        began = time.perf_counter()
        digests = [data.upload(data.download_map(name)) for name in names]
        stored_s = time.perf_counter() - began
        answer = asyncio.run(_call(url, token, digests, session, progress))
        merged_s = time.perf_counter() - began - stored_s
        if answer.reply is None:
            reply = decode_reply(data.download(answer.object), MergeReply)
        else:
            reply = answer.reply
        note = f"merged {', '.join(names[row] for row in reply.joined)}"
        version = data.update_map(MERGED_NAME, reply.map, note=note)
    finally:
        data.close()
    return reply, {
        "merged_by": answer.server,
        "merge_s": round(merged_s, 3),
        "transfer_s": round(stored_s, 3),
        "map": {"name": MERGED_NAME, "version": version},
    }


def print_tenths(say: Callable[[str], None]) -> Callable[[float, str], None]:
    """Return a progress callback that prints a line whenever another tenth of the job is completed.

    A job that is restarted on another server prints nothing until it is further than before.
    """
    reached = -1

    def report(done: float, what: str) -> None:
        nonlocal reached
        if int(10 * done) > reached:
            reached = int(10 * done)
            say(f"merging the maps: {10 * reached} %, {what}")

    return report


async def _call(
    url: str,
    token: str,
    digests: Sequence[str],
    session: SessionSettings,
    progress: Callable[[float, str], None],
) -> Answer:
    from client_sdk import connect

    request = {"maps": [{"object": digest} for digest in digests]}
    async with connect(url, token=token, settings=session) as client:
        return await client.call("merge", request, MergeReply, on_progress=progress)
