"""Merge the maps of several robots by the service ``merge``, from upload to reply.

It decides nothing about maps: the service does.
"""

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
    """Return one map of *maps*, merged by a server; the world of the first map is that of the result.

    Args:
        robot: Asks for the merge, which may take minutes.
        data: The data client of the same robot, whose objects the maps become.
        maps: Encoded maps, such as those of `Mapper.encoded_map` or `DataClient.download_map`.
        options: None means the defaults.
        on_progress: Called with the share that is done, and what was done last.

    Raises:
        RsePfError: The typed failure of an upload, or of the command.
    """
    digests = [await asyncio.to_thread(data.upload, robot_map) for robot_map in maps]
    request: dict[str, Any] = {"maps": [{"object": digest} for digest in digests]}
    if options is not None:
        request["options"] = options
    answer = await robot.call("merge", request, MergeReply, on_progress=on_progress or _ignore)
    if answer.reply is None:  # it is stored as an object
        stored = await asyncio.to_thread(data.download, answer.object)
        return decode_reply(stored, MergeReply)
    reply: MergeReply = answer.reply
    return reply


def _ignore(done: float, what: str) -> None:
    """Take the progress of a job that nobody follows; with a callback a job has no deadline."""
