"""The enrolment file, with which a robot connects: address, authority of the platform, and its own key.

An operator writes it with ``rse-pf robot enrol ROBOT --out FILE`` and carries it to the robot.  It contains a
private key: it is created with mode 0600, and refused if others may read it.  JSON, one object:

- ``format``: ``rse-pf-enrolment``; ``version``: 1.  Readers ignore unknown members.
- ``url``: address to which the robot connects, ``wss://`` or ``ws://``.
- ``authority``: the only certificate authority (PEM) that the robot trusts for ``url``.  If it is empty, the
  robot trusts the certificate authorities of its machine.
- ``robot``, ``tenant``: the name and the tenant under which the robot is enrolled.
- ``key``: the robot's private key, a JWK (RFC 8037).
- ``issuer``, ``audience``, ``token_ttl_s``: issuer, audience and validity (seconds) of the tokens that the
  robot signs with ``key``.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings
from rse_pf.errors import UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.storage.files import create_private_file, read_private_file

__all__ = ["Enrolment", "EnrolmentFile"]

# Random bytes of a token's id, so that no two tokens of a robot have the same id.
_TOKEN_ID_BYTES = 12
# Hint of each error about an enrolment file that is missing or damaged.
_HINT = "make one with rse-pf robot enrol ROBOT --out FILE"


class Enrolment(msgspec.Struct, frozen=True, kw_only=True):
    """The content of an enrolment file; the docstring of this module describes the fields."""

    format: Literal["rse-pf-enrolment"] = "rse-pf-enrolment"
    version: Literal[1] = 1
    url: str
    authority: str = ""
    robot: str
    tenant: str = DEFAULT_TENANT
    key: dict[str, Any]
    issuer: Literal["rse-pf"] = "rse-pf"
    audience: str = "rse-pf"
    token_ttl_s: int = 900

    @classmethod
    def read(cls, path: str | Path) -> Enrolment:
        """Return the enrolment in the file *path*.

        Raises:
            UsageError: There is no such file, others may read it, or it holds no enrolment.
        """
        data = read_private_file(Path(path), "the enrolment", hint=_HINT)
        try:
            return msgspec.json.decode(data, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise UsageError(f"{path} is not an enrolment: {str(error)[:150]}", hint=_HINT) from error

    def write(self, path: Path) -> None:
        """Write the enrolment to the new file *path* with the mode 0600.

        Raises:
            UsageError: The file exists already, or cannot be written.
        """
        try:
            create_private_file(
                path, msgspec.json.format(msgspec.json.encode(self), indent=1).decode() + "\n"
            )
        except OSError as error:
            problem = "exists already" if isinstance(error, FileExistsError) else error.strerror
            raise UsageError(
                f"cannot write {path}: {problem}", hint="name another file with --out"
            ) from error

    def token(self, *, now_s: float, token_id: str) -> str:
        """Return a robot token, signed with ``key`` and valid for ``token_ttl_s`` seconds from *now_s*.

        Args:
            now_s: Unix seconds.
            token_id: Id of the token (``jti``), by which an operator can revoke it.

        Raises:
            UsageError: ``key`` is not a private key, or ``robot`` or ``token_ttl_s`` is invalid.
        """
        settings = AuthSettings(audience=self.audience, token_ttl_s=self.token_ttl_s)
        key = SigningKey.from_json(msgspec.json.encode(self.key))
        return key.issue(self.robot, now=now_s, token_id=token_id, settings=settings)


class EnrolmentFile:
    """An enrolment file that is read again for each token, so that a replaced key takes effect at once."""

    def __init__(self, path: str | Path, *, clock: Callable[[], float] = time.time) -> None:
        """Store the path without reading the file; *clock* returns Unix seconds."""
        self._path = Path(path)
        self._clock = clock

    def read(self) -> Enrolment:
        """Return the enrolment in the file; raises UsageError."""
        return Enrolment.read(self._path)

    def fresh_token(self) -> str:
        """Return a new token, signed with the robot's key; raises UsageError if file or key is invalid."""
        return self.read().token(now_s=self._clock(), token_id=secrets.token_hex(_TOKEN_ID_BYTES))

    async def token(self) -> str:
        """Return `fresh_token`; pass this coroutine function to `client_sdk.connect` as its *token*."""
        return self.fresh_token()
