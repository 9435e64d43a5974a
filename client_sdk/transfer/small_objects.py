"""Store small objects over the data service of a connected robot, in a thread, with the robot's own token."""

from __future__ import annotations

import asyncio
import hashlib
import ssl
from collections.abc import Awaitable, Callable

from client_sdk.transfer.data_connection import MAX_SINGLE_PUT_BYTES, DataRequests, StoredReply
from rse_pf.errors import LimitExceeded, Unauthorized

__all__ = ["RobotObjects"]

_TIMEOUT_S = 5.0


class RobotObjects:
    """Stores the objects of one robot, one at a time."""

    def __init__(
        self,
        read_token: Callable[[], Awaitable[str | None]],
        own: Callable[[], tuple[str, ssl.SSLContext | None]],
    ) -> None:
        """Connect to nobody yet.

        Args:
            read_token: Returns a valid token, None where the platform needs none.
            own: Returns the address of the robot's servers, and what it trusts.
        """
        self._read_token, self._own = read_token, own
        self._url = ""
        self._requests: DataRequests | None = None
        self._one = asyncio.Lock()

    async def store(self, data: bytes) -> str:
        """Store *data* as an object and return its digest, once it is durable; nothing is repeated.

        Raises:
            ConnectError: There is no answer, or the platform has no data service.
            LimitExceeded: *data* is larger than 256 KiB.
            StoreFull, QuotaExceeded, Unauthorized, Forbidden: The server refuses it.
        """
        if len(data) > MAX_SINGLE_PUT_BYTES:
            raise LimitExceeded(
                f"{len(data)} bytes are above {MAX_SINGLE_PUT_BYTES}", hint="use client_sdk.DataClient"
            )
        async with self._one:
            token = await self._read_token()
            if token is None:
                raise Unauthorized("objects are stored with a token only", hint="enrol the robot")
            url, ssl_context = self._own()
            if self._requests is None or url != self._url:
                self.close()
                self._requests = DataRequests(url, timeout_s=_TIMEOUT_S, ssl_context=ssl_context)
                self._url = url
            return await asyncio.to_thread(_put, self._requests, data, token)

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        requests, self._requests = self._requests, None
        if requests is not None:
            requests.close()


def _put(requests: DataRequests, data: bytes, token: str) -> str:
    digest = hashlib.sha256(data).hexdigest()
    response = requests.request("PUT", f"/data/v1/objects/{digest}", data, {}, token)
    error = requests.failure(*response)
    if error is not None:
        raise error
    return requests.decode(response, StoredReply, digest).digest
