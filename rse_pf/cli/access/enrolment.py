"""Make the file of rse-pf robot enrol --out, which holds address, authority and key for one robot."""

from __future__ import annotations

import json
import secrets
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from rse_pf.auth.tokens import SigningKey
from rse_pf.cli.access.access_control import RobotRequest
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import is_loopback
from rse_pf.enrolment import Enrolment
from rse_pf.errors import UsageError
from rse_pf.local.state import read_state

__all__ = ["EnrolRequest", "enrolment_lines", "make_enrolment"]

# Random bytes from which a robot's private key (Ed25519) is made.
_SEED_BYTES = 32
# Bytes that are read of the certificate of an authority; a longer file is cut.
_MAX_BYTES = 65536


@dataclass(frozen=True, kw_only=True)
class EnrolRequest(RobotRequest):
    """The options of rse-pf robot enrol: the robot, its key, its scopes and its quota."""

    out: Path | None = option(
        "--out", metavar="FILE", help="make a key, and write all that the robot needs to connect to FILE"
    )
    url: str | None = option(
        "--url", help="with --out: where the robot connects (default: the address of the local platform)"
    )
    authority: Path | None = option(
        "--authority",
        metavar="FILE",
        help="with --out: certificate (PEM) of the authority to trust (default: the local platform's)",
    )
    public_key: Path | None = option(
        "--public-key",
        metavar="FILE",
        help="the public key that keygen printed; - reads standard input",
    )
    scope: tuple[str, ...] = option(
        "--scope",
        action="append",
        default=(),
        metavar="SCOPE",
        help="allow only this, such as services:pnp or maps:read; repeatable (default: everything)",
    )
    quota: tuple[str, ...] = option(
        "--quota",
        action="append",
        default=(),
        metavar="NAME=N",
        help="data_bytes=N, the bytes that the robot may store, or data_bytes=default (data.quota_bytes)",
    )


def make_enrolment(request: EnrolRequest, tenant: str, settings: PlatformSettings) -> Enrolment:
    """Return the content of an enrolment file for the robot of *request*, with a new private key.

    Raises:
        UsageError: The address of the platform is not known or not valid, or the file of the authority cannot
            be read or holds no certificate.
    """
    url, authority = _place(request)
    auth = settings.auth
    return Enrolment(
        url=url,
        authority="" if authority is None else _certificate(authority),
        robot=request.robot,
        tenant=tenant,
        key=json.loads(SigningKey.of_robot(secrets.token_bytes(_SEED_BYTES)).to_json()),
        audience=auth.audience,
        token_ttl_s=auth.token_ttl_s,
    )


def enrolment_lines(made: Enrolment, file: Path) -> list[str]:
    """Return the lines that are printed after the enrolment *made* was written to *file*."""
    lines = [
        f"wrote {file}: carry it to the robot; it holds the robot's private key, so nobody else may read it",
        f"the robot connects with  client_sdk.connect(enrolment={str(file.name)!r})  to {made.url}",
    ]
    host = urlsplit(made.url).hostname or ""
    if is_loopback(host):
        lines.append("only this machine reaches that address; rse-pf local --lan opens one to others")
    elif made.url.startswith("ws:"):
        lines.append(
            "tokens and data cross the network in clear text: the address does not begin with wss://"
        )
    elif not made.authority:
        lines.append(
            "the robot trusts the authorities of its machine; for a certificate of a private one enrol "
            "again with --authority and the file of that authority"
        )
    return lines


def _place(request: EnrolRequest) -> tuple[str, Path | None]:
    """Return the address that the robot connects to, and the file of the authority, None if there is none."""
    state = None if request.cloud else read_state(request.folder)
    url, authority = request.url or (state.url if state is not None else ""), request.authority
    if not url:
        if request.cloud:
            raise UsageError(
                "the address of the deployment is not known here",
                hint="name it with --url; rse-pf cloud up and status print it",
            )
        raise UsageError(
            f"platform {request.name!r} does not run, so its address is not known",
            hint="start it with rse-pf local --lan, or name the address with --url",
        )
    parts = urlsplit(url)
    if parts.scheme not in ("ws", "wss") or not parts.hostname:
        raise UsageError(f"{url[:200]!r} is not the address of a platform", hint="write wss://HOST:PORT/ws")
    if authority is None and not request.url and state is not None and state.authority_file:
        authority = Path(state.authority_file)
    return url, authority


def _certificate(path: Path) -> str:
    """Return the certificate in the PEM file *path*; raises UsageError if it has none, or a private key."""
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read the authority {path}", hint="name a PEM file") from error
    if "BEGIN CERTIFICATE" not in text or "PRIVATE KEY" in text:
        raise UsageError(
            f"{path} is not the certificate of an authority", hint="name a PEM file that holds no private key"
        )
    return text
