"""Read the enrolment file of a robot, which ``rse-pf robot enrol ROBOT --out FILE`` writes.

It holds the address of the platform, the certificate authority, and the key with which the robot signs
tokens.

``client_sdk.connect(enrolment="robot-1.enrolment")`` reads the file by itself; these functions are for
programs that need the address or a token for other clients, such as the data client.  Nothing here connects.
"""

from __future__ import annotations

import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from rse_pf.errors import UsageError

__all__ = ["EnrolledRobotAccess", "read_enrolment"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EnrolledRobotAccess:
    """How an enrolled robot connects to its platform.

    Attributes:
        robot: Name of the robot.
        url: WebSocket address of the platform.
        ssl_context: Trusts the authority in the file and no other; None if the file names no authority: then
            those of the machine are trusted.
        token: Async function that signs a new token at each call, as `client_sdk.connect` takes it.
        fresh_token: Function that does the same without asyncio, as `client_sdk.DataClient` takes it.
    """

    robot: str
    url: str
    ssl_context: ssl.SSLContext | None
    token: Callable[[], Awaitable[str]]
    fresh_token: Callable[[], str]


def read_enrolment(path: str | Path) -> EnrolledRobotAccess:
    """Return the content of the enrolment file *path*.

    Raises:
        UsageError: The file cannot be read, its permissions let other users read it, or it holds no
            enrolment.
        MissingExtra: The extra ``keys`` is not installed.
    """
    from rse_pf.enrolment import EnrolmentFile

    file = EnrolmentFile(path)
    enrolment = file.read()
    file.fresh_token()  # so that a damaged key is found now, and not at the first connect
    return EnrolledRobotAccess(
        robot=enrolment.robot,
        url=enrolment.url,
        ssl_context=_context_with_authority(enrolment.authority, path) if enrolment.authority else None,
        token=file.token,
        fresh_token=file.fresh_token,
    )


def _context_with_authority(authority_pem: str, path: str | Path) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cadata=authority_pem)
    except ssl.SSLError as error:
        raise UsageError(
            f"{path}: the authority in the file is no certificate",
            hint="enrol the robot again: rse-pf robot enrol",
        ) from error
