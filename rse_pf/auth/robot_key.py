"""A robot's own private key, which never leaves the robot and signs the robot's short-lived tokens.

async with connect(url, token=RobotKey("robot.key", "robot-1").token) as robot: ...
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from pathlib import Path

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings
from rse_pf.errors import UsageError
from rse_pf.storage.files import create_private_file, read_private_file

__all__ = ["RobotKey", "make_robot_key"]

_SEED_BYTES = 32  # random bytes of which an Ed25519 key is made
_TOKEN_ID_BYTES = 12  # random bytes of a token's id, by which an operator can revoke the token


class RobotKey:
    """The private key of one robot, in a file that `make_robot_key` wrote; it signs the robot's tokens."""

    def __init__(
        self,
        path: str | Path,
        robot: str,
        *,
        settings: AuthSettings | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Store the path; the file is read for each token, so that a replaced key takes effect at once.

        Args:
            path: File of the private key, with the mode 0600.
            robot: Name under which the robot was enrolled.
            settings: Audience and validity of the tokens; None means the defaults.
            clock: Returns Unix seconds; servers tolerate a difference of ``auth.leeway_s`` from their clock.
        """
        self._path = Path(path)
        self._robot = robot
        self._settings = settings or AuthSettings()
        self._clock = clock

    async def token(self) -> str:
        """Return a new token; raises UsageError if the file holds no key, or other users may read it."""
        data = read_private_file(self._path, "the key", hint="make one with rse-pf robot keygen")
        key = SigningKey.from_json(data.decode("utf-8", "replace"))
        token_id = secrets.token_hex(_TOKEN_ID_BYTES)
        return key.issue(self._robot, now=self._clock(), token_id=token_id, settings=self._settings)


def make_robot_key(path: Path) -> str:
    """Write a new private key to the file *path*, which must not exist; return the public key as a JWK.

    Raises:
        UsageError: The file exists or cannot be written.
    """
    key = SigningKey.of_robot(secrets.token_bytes(_SEED_BYTES))
    try:
        create_private_file(path, key.to_json())
    except OSError as error:
        problem = "exists already" if isinstance(error, FileExistsError) else error.strerror
        raise UsageError(f"cannot write {path}: {problem}", hint="name another file with --out") from error
    return key.public_json()
