"""Connect by the one file of ``rse-pf robot enrol ROBOT --out FILE``: address, authority and key of a robot.

``client_sdk.connect(enrolment="robot-1.enrolment")`` is all that a robot program needs; the functions here
are for what else needs an address and a token, such as the data client.  Nothing here connects.
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
    """How an enrolled robot connects: address, trusted authority, and where its tokens come from.

    ``ssl_context`` trusts the authority of the file and no other; None means the authorities of the machine.
    ``token`` is for `client_sdk.connect`, ``fresh_token`` for `client_sdk.DataClient`; both sign a new token.
    """

    robot: str
    url: str
    ssl_context: ssl.SSLContext | None
    token: Callable[[], Awaitable[str]]
    fresh_token: Callable[[], str]


def read_enrolment(path: str | Path) -> EnrolledRobotAccess:
    """Return what the enrolment in the file *path* says.

    Raises:
        UsageError: The file cannot be read, others may read it, or it holds no enrolment.
        MissingExtra: The extra ``keys`` is not installed.
    """
    from rse_pf.enrolment import EnrolmentFile

    file = EnrolmentFile(path)
    read = file.read()
    file.fresh_token()  # a damaged key is found now, and not at the first connect
    return EnrolledRobotAccess(
        robot=read.robot,
        url=read.url,
        ssl_context=_trusting(read.authority, path) if read.authority else None,
        token=file.token,
        fresh_token=file.fresh_token,
    )


def _trusting(authority: str, path: str | Path) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cadata=authority)
    except ssl.SSLError as error:
        raise UsageError(
            f"{path}: its authority is no certificate", hint="enrol the robot again: rse-pf robot enrol"
        ) from error
