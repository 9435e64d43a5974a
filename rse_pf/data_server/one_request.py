"""Take one request of a connection at a time: what follows it before its answer is sent is never a request.

Balancers and our own clients wait for an answer before they ask again.  Who does not is trying to have two
readers disagree where one request ends and the next begins (request smuggling), or gains nothing.  Promises
to change nothing else of the server, and an answer to the first request before the connection ends.
"""

from __future__ import annotations

from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["OneRequestProtocol"]


class OneRequestProtocol(H11Protocol):
    """HTTP/1.1 with keep-alive and without pipelining."""

    def on_response_complete(self) -> None:
        """End the connection if bytes came that no answered request explains."""
        if self.conn.trailing_data[0] and not self.transport.is_closing():
            self.transport.close()  # after what was written: the robot has its answer
        super().on_response_complete()
