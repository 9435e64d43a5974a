"""A robot's own key: it never leaves the robot, and signs the robot's short tokens.

    async with connect(url, token=RobotKey("robot.key", "robot-1").token) as robot: ...

Promises to make nothing that lives longer than a token may, and to read one file that only its owner can.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from pathlib import Path

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings
from rse_pf.errors import UsageError
from rse_pf.files import create_private_file, read_private_file

__all__ = ["RobotKey", "make_robot_key"]

_SEED_BYTES, _ID_BYTES = 32, 12


class RobotKey:
    """The key in a file that `make_robot_key` wrote, used in the name of one robot."""

    def __init__(
        self,
        path: str | Path,
        robot: str,
        *,
        settings: AuthSettings | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Remember where the key is; it is read for each token, so a new file counts at once.

        Args:
            path: The private key, mode 0600.
            robot: The name under which the robot was enrolled.
            settings: Issuer, audience and life; None means the defaults.
            clock: Unix seconds; the platform forgives ``auth.leeway_s`` of difference.
        """
        self._path = Path(path)
        self._robot = robot
        self._settings = settings or AuthSettings()
        self._clock = clock

    async def token(self) -> str:
        """Return a fresh token; raises UsageError if the file holds no key of its owner alone."""
        hint = "make one with rse-pf robot keygen"
        key = SigningKey.from_json(read_private_file(self._path, "the key", hint=hint))
        token_id = secrets.token_hex(_ID_BYTES)
        return key.issue(self._robot, now=self._clock(), token_id=token_id, settings=self._settings)


def make_robot_key(path: Path) -> str:
    """Write a new private key to *path*, which must not exist, and return its public half as a JWK.

    Raises:
        UsageError: There is a file already, or none can be made.
    """
    key = SigningKey.of_robot(secrets.token_bytes(_SEED_BYTES))
    try:
        create_private_file(path, key.to_json())
    except FileExistsError as error:
        raise UsageError(f"there is a file {path} already", hint="name another with --out") from error
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another with --out") from error
    return key.public_json()
