"""Choose the address of rse-pf local --lan, and make the lines that it prints for other machines."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from rse_pf.auth.certificates import CertificateWithKey
from rse_pf.local.lan.addresses import check_lan_address, lan_address

__all__ = ["chosen_address", "lan_lines"]


def chosen_address(text: str | None) -> str:
    """Return the address to listen on for other machines; "" if --lan is not given.

    Args:
        text: Value of --lan; "" detects the address of this machine in its network, None means no --lan.

    Raises:
        UsageError: *text* is no address to which other machines can connect.
        ConfigurationError: No address could be detected.
    """
    if text is None:
        return ""
    return check_lan_address(text) if text else lan_address()


def lan_lines(url: str, authority: CertificateWithKey, file: Path, which: str) -> list[str]:
    """Return the lines that say how a robot or a browser of another machine connects to *url*.

    Args:
        url: Address that robots connect to.
        authority: The platform's certificate authority, which they must trust.
        file: File of the authority's certificate.
        which: Option, after a space, that names the platform in commands; "" for the default one.
    """
    port = urlsplit(url).port
    return [
        f"enrol a robot       rse-pf robot enrol robot-1 --out robot-1.enrolment{which}",
        f"firewall            open TCP port {port} of this machine, for example: ufw allow {port}/tcp",
        f"authority           {file}",
        f"its SHA-256         {authority.fingerprint}",
    ]
