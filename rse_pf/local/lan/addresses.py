"""The address at which other machines of the network reach this one.

No packet is sent: the routing table gives the source address that a packet would have.
"""

from __future__ import annotations

import ipaddress
import socket

from rse_pf.errors import ConfigurationError, UsageError

__all__ = ["check_lan_address", "host_names", "lan_address"]

_REMOTE = (("192.0.2.1", socket.AF_INET), ("2001:db8::1", socket.AF_INET6))
"""Addresses that are reserved for documentation (RFC 5737, RFC 3849)."""
_PORT = 9
_EXAMPLE = "for example: --lan 192.168.1.20; ip address shows the addresses of this machine"


def lan_address() -> str:
    """Return the address that this machine has in its network.

    Raises:
        ConfigurationError: No route leads out of this machine.
    """
    for address, family in _REMOTE:
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as trial:
                trial.connect((address, _PORT))  # a datagram socket only looks up the route
                own = str(trial.getsockname()[0])
        except OSError:
            continue
        if not ipaddress.ip_address(own).is_loopback:
            return own
    raise ConfigurationError("this machine is in no network that could be detected", hint=_EXAMPLE)


def check_lan_address(text: str) -> str:
    """Return *text*, an address that other machines could reach, in its usual form.

    Raises:
        UsageError: It is no address, or a loopback or unspecified one.
    """
    try:
        address = ipaddress.ip_address(text)
    except ValueError as error:
        raise UsageError(f"--lan {text[:80]} is not an address of this machine", hint=_EXAMPLE) from error
    if address.is_loopback or address.is_unspecified or address.is_multicast:
        raise UsageError(f"--lan {text} is no address that another machine can connect to", hint=_EXAMPLE)
    return str(address)


def host_names() -> tuple[str, ...]:
    """Return the names under which machines of the network may know this one (mDNS)."""
    label = socket.gethostname().partition(".")[0].lower()
    is_label = label.isascii() and label.replace("-", "").isalnum()
    return (f"{label}.local", "localhost") if is_label and label != "localhost" else ("localhost",)
