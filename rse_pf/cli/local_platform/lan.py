"""What rse-pf local --lan tells its operator: addresses, authority, enrolment, firewall, and a QR code."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from rse_pf.auth.certificates import CertificateWithKey
from rse_pf.local.lan.addresses import check_lan_address, lan_address
from rse_pf.terminal import can_draw, show

__all__ = ["browser_url", "chosen_address", "lan_lines", "qr_lines", "show_qr_code"]

_HALVES = {(False, False): " ", (True, False): "\u2580", (False, True): "\u2584", (True, True): "\u2588"}
"""Two modules, one above the other, in one character: light is drawn, as terminals are dark."""


def chosen_address(text: str | None) -> str:
    """Return the address that --lan means: "" without it, a detected one if it names none.

    Raises:
        UsageError: *text* is no address that others can connect to.
        ConfigurationError: None could be detected.
    """
    if text is None:
        return ""
    return check_lan_address(text) if text else lan_address()


def browser_url(url: str) -> str:
    """Return the address for browsers, from the address *url* that robots connect to."""
    return f"https://{urlsplit(url).netloc}/"


def lan_lines(url: str, authority: CertificateWithKey, file: Path, which: str) -> list[str]:
    """Return what to do so that a robot or a browser of another machine connects to *url*."""
    port = urlsplit(url).port
    return [
        f"browsers open       {browser_url(url)}",
        f"enrol a robot       rse-pf robot enrol robot-1 --out robot-1.enrolment{which}",
        f"firewall            open TCP port {port} of this machine, for example: ufw allow {port}/tcp",
        f"authority           {file}",
        f"its SHA-256         {authority.fingerprint}",
    ]


def show_qr_code(text: str) -> None:
    """Show *text* as a QR code, if the output is a terminal that can draw it, and segno is installed."""
    try:
        import segno
    except ImportError:
        return
    lines = qr_lines([list(row) for row in segno.make_qr(text, error="l").matrix_iter(border=2)])
    if can_draw("".join(_HALVES.values())):
        show("", *lines)


def qr_lines(modules: list[list[int]]) -> list[str]:
    """Return the rows of a QR code (1 is dark) as lines of half the height."""
    if len(modules) % 2:
        modules = [*modules, [1] * len(modules[0])]
    pairs = zip(modules[::2], modules[1::2], strict=True)
    return ["".join(_HALVES[not top, not low] for top, low in zip(*pair, strict=True)) for pair in pairs]
