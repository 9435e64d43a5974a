"""Merge maps of several robots: upload the maps, send the command ``merge``, and fetch the reply."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from client_sdk.commands.answer_types import decode_reply
from client_sdk.transfer.data_client import DataClient
from rse_pf.services.mapping.merge import MergeReply
from rse_pf.slam.map_merge import MergeOptions

if TYPE_CHECKING:
    from client_sdk.robot import OnProgress, Robot

__all__ = ["merge_maps"]


async def merge_maps(
    robot: Robot,
    data: DataClient,
    maps: Sequence[bytes],
    *,
    options: MergeOptions | None = None,
    on_progress: OnProgress | None = None,
) -> MergeReply:
    """Return one map of several, merged by a server; the world frame is that of the first map.

    A further map that shows no place of the others is not in the result: ``not_joined`` of the reply says
    why.

    Args:
        robot: Sends the command, which may take minutes.
        data: Data client of the same robot, as whose objects the maps are stored.
        maps: Encoded maps, such as those of `Mapper.encoded_map` or `DataClient.download_map`.
        options: Conditions of loop closures within and between the maps; None means the defaults.
        on_progress: Called with the share that is done (0..1), and the name of the last step that is
            complete.

    Raises:
        RsePfError: The typed failure of an upload, of the command, or of the download.
    """
    digests = [await asyncio.to_thread(data.upload, robot_map) for robot_map in maps]
    request: dict[str, Any] = {"maps": [{"object": digest} for digest in digests]}
    if options is not None:
        request["options"] = options
    answer = await robot.call("merge", request, MergeReply, on_progress=on_progress or _ignore_progress)
    if answer.reply is None:  # too large for a message, so that the server has stored it as an object
        stored = await asyncio.to_thread(data.download, answer.object)
        return decode_reply(stored, MergeReply)
    reply: MergeReply = answer.reply
    return reply


def _ignore_progress(done: float, step: str) -> None:
    """Ignore the progress; a call of `Robot.call` with an *on_progress* has no default deadline."""
