"""Store small objects at the data service of a connected robot, in a thread, with the robot's own token."""

from __future__ import annotations

import asyncio
import hashlib
import ssl
from collections.abc import Awaitable, Callable

from client_sdk.transfer.data_connection import MAX_SINGLE_PUT_BYTES, DataConnection, StoredReply
from rse_pf.errors import LimitExceeded, Unauthorized

__all__ = ["SmallObjectStore"]

REQUEST_TIMEOUT_S = 5.0
"""How long one request may wait for the next bytes of its answer, in seconds."""


class SmallObjectStore:
    """Store objects of one robot at the data service, one at a time."""

    def __init__(
        self,
        read_token: Callable[[], Awaitable[str | None]],
        read_access: Callable[[], tuple[str, ssl.SSLContext | None]],
    ) -> None:
        """Store the two functions; nothing is sent yet.

        Args:
            read_token: Returns the robot's token, None if the robot has none; `store` needs one.
            read_access: Returns the present WebSocket address of the robot's servers, at which the data
                service is, too, and the TLS context for it (None trusts the authorities of the machine).
        """
        self._read_token = read_token
        self._read_access = read_access
        self._url = ""
        self._connection: DataConnection | None = None
        self._lock = asyncio.Lock()

    async def store(self, data: bytes) -> str:
        """Store *data* as an object and return its sha256 once it is durable; do not repeat a failed request.

        Raises:
            ConnectError: There is no answer, or the platform has no data service.
            LimitExceeded: *data* is larger than 256 KiB.
            Unauthorized: The robot has no token, or the data service refuses it.
            StoreFull, QuotaExceeded, Forbidden: The data service refuses the object.
        """
        if len(data) > MAX_SINGLE_PUT_BYTES:
            raise LimitExceeded(
                f"an object of {len(data)} bytes is above {MAX_SINGLE_PUT_BYTES}",
                hint="store it by client_sdk.DataClient",
            )
        async with self._lock:
            token = await self._read_token()
            if token is None:
                raise Unauthorized("objects are stored with a token only", hint="enrol the robot")
            url, ssl_context = self._read_access()
            if self._connection is None or url != self._url:
                self.close()
                self._connection = DataConnection(url, timeout_s=REQUEST_TIMEOUT_S, ssl_context=ssl_context)
                self._url = url
            return await asyncio.to_thread(_put_object, self._connection, data, token)

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


def _put_object(connection: DataConnection, data: bytes, token: str) -> str:
    digest = hashlib.sha256(data).hexdigest()
    response = connection.request("PUT", f"/data/v1/objects/{digest}", data, {}, token)
    error = connection.failure(*response)
    if error is not None:
        raise error
    return connection.decode(response, StoredReply, digest).digest
