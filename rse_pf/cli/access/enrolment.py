"""The action enrol --out of the verb robot: one file with address, authority and key of a robot."""

from __future__ import annotations

import argparse
import json
import os
import secrets
from pathlib import Path
from urllib.parse import urlsplit

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import is_loopback
from rse_pf.enrolment import Enrolment
from rse_pf.errors import UsageError
from rse_pf.local.state import read_state, state_folder

__all__ = ["enrolment_lines", "make_enrolment"]

_SEED_BYTES = 32
_MAX_BYTES = 65536


def make_enrolment(args: argparse.Namespace, settings: PlatformSettings) -> Enrolment:
    """Return an enrolment with a new key, for the platform that *args* mean.

    Raises:
        UsageError: The address is not known, or the file of the authority cannot be read.
    """
    url, authority = _place(args)
    auth = settings.auth
    return Enrolment(
        url=url,
        authority="" if authority is None else _certificate(authority),
        robot=args.robot,
        tenant=args.tenant,
        key=json.loads(SigningKey.of_robot(secrets.token_bytes(_SEED_BYTES)).to_json()),
        audience=auth.audience,
        token_ttl_s=auth.token_ttl_s,
    )


def enrolment_lines(made: Enrolment, file: Path) -> list[str]:
    """Return what the operator has to know about the file."""
    lines = [
        f"wrote {file}: carry it to the robot; it holds the robot's private key, so nobody else may read it",
        f"the robot connects with  client_sdk.connect(enrolment={str(file.name)!r})  to {made.url}",
    ]
    host = urlsplit(made.url).hostname or ""
    if is_loopback(host):
        lines.append("only this machine reaches that address; rse-pf local --lan opens one to others")
    elif made.url.startswith("ws:"):
        lines.append("tokens and data cross the network in clear text: the address is no wss://")
    elif not made.authority:
        lines.append(
            "the robot trusts the authorities of its machine; for a certificate of a private one enrol "
            "again with --authority and the file of that authority"
        )
    return lines


def _place(args: argparse.Namespace) -> tuple[str, Path | None]:
    """Return the address, and the file of the authority if there is one."""
    state = None if args.cloud else read_state(state_folder(args.name, os.environ))
    url, authority = args.url or (state.url if state is not None else ""), args.authority
    if not url:
        if args.cloud:
            raise UsageError(
                "the address of the deployment is not known here",
                hint="name it with --url; rse-pf cloud up and status print it",
            )
        raise UsageError(
            f"platform {args.name!r} does not run, so its address is not known",
            hint="start it with rse-pf local --lan, or name the address with --url",
        )
    parts = urlsplit(url)
    if parts.scheme not in ("ws", "wss") or not parts.hostname:
        raise UsageError(f"{url[:200]!r} is no address of a platform", hint="write wss://HOST:PORT/ws")
    if authority is None and not args.url and state is not None and state.authority_file:
        authority = Path(state.authority_file)
    return url, authority


def _certificate(path: Path) -> str:
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
