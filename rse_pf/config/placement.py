"""Where one server runs: its addresses, its processes, and where its data and its keys are."""

from __future__ import annotations

import ipaddress

__all__ = ["is_loopback"]


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach *host*: a loopback address, or the name ``localhost``.

    Source:
        RFC 6761, Sect. 6.3: the name ``localhost`` always means a loopback address.
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
