"""What rse-pf local --lan prints: addresses, authority, enrolment and firewall."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from rse_pf.auth.certificates import CertificateWithKey
from rse_pf.local.lan.addresses import check_lan_address, lan_address

__all__ = ["chosen_address", "lan_lines"]


def chosen_address(text: str | None) -> str:
    """Return the address that --lan means: "" without it, a detected one if it names none.

    Raises:
        UsageError: *text* is no address that others can connect to.
        ConfigurationError: None could be detected.
    """
    if text is None:
        return ""
    return check_lan_address(text) if text else lan_address()


def lan_lines(url: str, authority: CertificateWithKey, file: Path, which: str) -> list[str]:
    """Return what to do so that a robot or a browser of another machine connects to *url*."""
    port = urlsplit(url).port
    return [
        f"enrol a robot       rse-pf robot enrol robot-1 --out robot-1.enrolment{which}",
        f"firewall            open TCP port {port} of this machine, for example: ufw allow {port}/tcp",
        f"authority           {file}",
        f"its SHA-256         {authority.fingerprint}",
    ]
