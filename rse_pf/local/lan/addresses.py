"""Find the address at which other machines of the network reach this one.

No packet is sent: the routing table gives the source address that a packet to another network would have.
"""

from __future__ import annotations

import ipaddress
import socket

from rse_pf.errors import ConfigurationError, UsageError

__all__ = ["check_lan_address", "host_names", "lan_address"]

_REMOTE = (("192.0.2.1", socket.AF_INET), ("2001:db8::1", socket.AF_INET6))
"""Destinations whose routes are looked up: addresses reserved for documentation (RFC 5737, RFC 3849)."""
# Port of the destinations; any number, since no packet is sent.
_PORT = 9
_EXAMPLE = "for example: --lan 192.168.1.20; ip address shows the addresses of this machine"


def lan_address() -> str:
    """Return the address that this machine has in its network, IPv4 if there is one.

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
    """Return the IP address *text* in its normal form, if other machines could connect to it.

    Whether this machine has the address is not checked.

    Raises:
        UsageError: *text* is no IP address, or a loopback, unspecified or multicast one.
    """
    try:
        address = ipaddress.ip_address(text)
    except ValueError as error:
        raise UsageError(f"--lan {text[:80]} is not an address of IPv4 or IPv6", hint=_EXAMPLE) from error
    if address.is_loopback or address.is_unspecified or address.is_multicast:
        raise UsageError(f"--lan {text} is no address that another machine can connect to", hint=_EXAMPLE)
    return str(address)


def host_names() -> tuple[str, ...]:
    """Return the host names by which robots and browsers may address this machine.

    They are ``HOST.local`` of multicast DNS, unless the host name has other characters than letters, digits
    and hyphens, and ``localhost``.
    """
    label = socket.gethostname().partition(".")[0].lower()
    is_label = label.isascii() and label.replace("-", "").isalnum()
    return (f"{label}.local", "localhost") if is_label and label != "localhost" else ("localhost",)
