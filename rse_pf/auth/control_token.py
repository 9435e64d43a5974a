"""The control token, with which a client of a control port may read metrics, drain a server and move robots.

The token is a secret of one machine, in a file that only its user can read.  Clients send it in the header
``Authorization: Bearer``.  It has nothing to do with robots' tokens, and no message contains it.
"""

from __future__ import annotations

import hmac
import re
from pathlib import Path

from rse_pf.errors import UsageError
from rse_pf.storage.files import OWNER_ONLY, read_private_file, replace_file

__all__ = ["bearer", "carries_token", "ensure_control_token", "read_control_token"]

# The form of a control token; 32 hexadecimal digits are 128 random bits.
_TOKEN = re.compile(rb"[0-9a-fA-F]{32,256}")
_CREATE_HINT = "create one: (umask 077; openssl rand -hex 32 > FILE)"


def bearer(token: str) -> str:
    """Return the value of the header ``Authorization`` with which a client sends *token*."""
    return f"Bearer {token}"


def carries_token(authorization: str, token: str) -> bool:
    """Return whether *authorization*, the value of the header or "", is ``Bearer`` with *token*.

    The comparison takes the same time wherever the tokens differ, so that its time does not help to guess.
    """
    scheme, _, carried = authorization.partition(" ")
    is_same = hmac.compare_digest(carried.encode(), token.encode())
    return is_same and scheme.lower() == "bearer"


def read_control_token(path: Path) -> str:
    """Return the control token in the file *path*.

    Raises:
        UsageError: There is no such file, others may read it, or it holds anything but a token of 32 to 256
            hexadecimal digits.
    """
    token = read_private_file(path, "the control token", hint=_CREATE_HINT).strip()
    if not _TOKEN.fullmatch(token):
        raise UsageError(f"{path} holds no control token of 32 to 256 hexadecimal digits", hint=_CREATE_HINT)
    return token.decode("ascii")


def ensure_control_token(path: Path, *, seed: bytes) -> str:
    """Return the control token in the file *path*; if there is no such file, write one first.

    The new token is *seed*, 32 secret random bytes, in hexadecimal digits.  An existing token is kept,
    because servers that are still running use it.

    Raises:
        UsageError: The file exists, but `read_control_token` refuses it.
        OSError: The file cannot be created.
    """
    if not path.exists():
        replace_file(path, f"{seed.hex()}\n", mode=OWNER_ONLY)
    return read_control_token(path)
