"""Notify a robot when the kernel reports a new network link, address or route, so that it dials at once.

It works on Linux only, by a netlink socket (rtnetlink(7)).  Where such a socket does not exist or is not
allowed, nothing is reported, and a robot without a network dials once a second anyway.  The messages are not
parsed.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable

__all__ = ["NetworkChanges"]

NETLINK_GROUPS = 0x1 | 0x10 | 0x40 | 0x100 | 0x400
"""Multicast groups of rtnetlink(7): RTMGRP_LINK, _IPV4_IFADDR, _IPV4_ROUTE, _IPV6_IFADDR and _IPV6_ROUTE."""
READ_BYTES = 65536
"""Bytes of netlink messages that are read at once, and dropped."""


class NetworkChanges:
    """Call a function in the event loop after each network change, between `open` and `close`."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        """Prepare to call *on_change*, a function without arguments, after each network change."""
        self._on_change = on_change
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Begin to watch; do nothing where the kernel has no netlink or forbids it."""
        family = getattr(socket, "AF_NETLINK", None)
        if family is None:
            return
        try:
            netlink = socket.socket(family, socket.SOCK_RAW, 0)
        except OSError:
            return
        try:
            netlink.setblocking(False)
            netlink.bind((0, NETLINK_GROUPS))
            asyncio.get_running_loop().add_reader(netlink, self._read)
        except (OSError, NotImplementedError):
            netlink.close()
            return
        self._socket = netlink

    def close(self) -> None:
        """Watch no longer; do nothing if this was called before."""
        netlink, self._socket = self._socket, None
        if netlink is not None:
            asyncio.get_running_loop().remove_reader(netlink)
            netlink.close()

    def _read(self) -> None:
        assert self._socket is not None
        with contextlib.suppress(OSError):  # nothing left to read, or more messages than the kernel keeps
            while self._socket.recv(READ_BYTES):
                pass
        self._on_change()
