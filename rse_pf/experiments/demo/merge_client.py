"""Merge through the platform, as an operator would: maps and results by HTTP, the work by a command.

Every robot has committed its map to the data service.  This client fetches them, stores them under its own
name, asks ``merge`` for them by digest (a long service: it runs as a job, behind everything else), and
commits the result as a map that all robots of the tenant may read.  Promises to merge nothing itself.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Any

from client_sdk.answers import Answer, decode_reply
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import SessionSettings
from rse_pf.errors import NotFound
from rse_pf.services.mapping.merge import MergeReply

__all__ = ["MERGED_NAME", "commit", "merge_there", "tenths"]

MERGED_NAME = "merged"


def merge_there(
    url: str,
    token: str,
    names: Sequence[str],
    session: SessionSettings,
    progress: Callable[[float, str], None],
) -> tuple[MergeReply, dict[str, Any]]:
    """Merge the maps *names* of the registry on the platform at *url*; blocks until it is done.

    Returns:
        What the service said, and what a report says of the asking: server, seconds, the map's id.

    Raises:
        RsePfError: The typed failure of a transfer or of the job.
    """
    data = DataClient(url, token)
    try:
        began = time.perf_counter()
        digests = [data.upload(data.download_map(name)) for name in names]
        stored_s = time.perf_counter() - began
        answer = asyncio.run(_ask(url, token, digests, session, progress))
        merged_s = time.perf_counter() - began - stored_s
        if answer.reply is None:
            reply = decode_reply(data.download(answer.object), MergeReply)
        else:
            reply = answer.reply
        version = commit(
            data, MERGED_NAME, reply.map, f"merged {', '.join(names[row] for row in reply.joined)}"
        )
    finally:
        data.close()
    return reply, {
        "merged_by": answer.server,
        "merge_s": round(merged_s, 3),
        "transfer_s": round(stored_s, 3),
        "map": {"name": MERGED_NAME, "version": version},
    }


def commit(data: DataClient, name: str, encoded: bytes, note: str) -> str:
    """Make *encoded* the next version of map *name*; return its id."""
    try:
        parent: str | None = data.map_version(name)["id"]
    except NotFound:
        parent = None
    return data.commit_map(name, encoded, parent=parent, note=note)


def tenths(say: Callable[[str], None]) -> Callable[[float, str], None]:
    """Return a progress callback that says a line when the next tenth is reached, and never goes back.

    A job that another server begins anew is silent until it is where the first one was.
    """
    reached = -1

    def tell(done: float, what: str) -> None:
        nonlocal reached
        if int(10 * done) > reached:
            reached = int(10 * done)
            say(f"merging the maps: {10 * reached} %, {what}")

    return tell


async def _ask(
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
