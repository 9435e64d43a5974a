"""Tell when the kernel has a new link, address or route, so that a robot tries to connect at once.

Linux only, by a netlink socket; elsewhere, or where it is not allowed, nobody is told, and a robot tries once
a second.  Nothing is configured here, and no message is read: that there is one is enough.

Source:
    rtnetlink(7).
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable

__all__ = ["NetworkChanges"]

_GROUPS = 0x1 | 0x10 | 0x40 | 0x100 | 0x400
"""RTMGRP_LINK, _IPV4_IFADDR, _IPV4_ROUTE, _IPV6_IFADDR, _IPV6_ROUTE."""
_READ_BYTES = 65536


class NetworkChanges:
    """Calls *on_change* in the event loop, between `open` and `close`."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Begin, where the kernel has such messages."""
        family = getattr(socket, "AF_NETLINK", None)
        if family is None:
            return
        try:
            made = socket.socket(family, socket.SOCK_RAW, 0)
        except OSError:
            return
        try:
            made.setblocking(False)
            made.bind((0, _GROUPS))
            asyncio.get_running_loop().add_reader(made, self._read)
        except (OSError, NotImplementedError):
            made.close()
            return
        self._socket = made

    def close(self) -> None:
        """End; does nothing a second time."""
        made, self._socket = self._socket, None
        if made is not None:
            asyncio.get_running_loop().remove_reader(made)
            made.close()

    def _read(self) -> None:
        assert self._socket is not None
        with contextlib.suppress(OSError):  # too many messages: that there were some is enough
            while self._socket.recv(_READ_BYTES):
                pass
        self._on_change()
