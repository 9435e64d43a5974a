"""The token of a control port: who may read a server's numbers, drain it, or move its robots.

A secret of one machine in a file that only its owner can read; askers carry it as ``Authorization: Bearer``.
Promises to have no part in robots' tokens, to put the secret into no message, and that the time of a
refusal tells nothing about it.
"""

from __future__ import annotations

import hmac
import re
from pathlib import Path

from rse_pf.errors import UsageError
from rse_pf.files import OWNER_ONLY, read_private_file, replace_file

__all__ = ["bearer", "ensure_control_token", "is_carried", "read_control_token"]

_TOKEN = re.compile(rb"[0-9a-fA-F]{32,256}")
_MAKE = "make one: (umask 077; openssl rand -hex 32 > FILE)"


def bearer(token: str) -> str:
    """Return the value of the ``Authorization`` header that carries *token*."""
    return f"Bearer {token}"


def is_carried(authorization: str, token: str) -> bool:
    """Whether the ``Authorization`` header *authorization*, empty if there was none, carries *token*."""
    scheme, _, told = authorization.partition(" ")
    same = hmac.compare_digest(told.encode(), token.encode())
    return same and scheme.lower() == "bearer"


def read_control_token(path: Path) -> str:
    """Return the token in *path*.

    Raises:
        UsageError: There is no such file, others may read it, or it holds less than 32 hexadecimal letters
            or anything else beside them.
    """
    token = read_private_file(path, "the control token", hint=_MAKE).strip()
    if not _TOKEN.fullmatch(token):
        raise UsageError(f"{path} holds no control token of 32 to 256 hexadecimal letters", hint=_MAKE)
    return token.decode("ascii")


def ensure_control_token(path: Path, *, seed: bytes) -> str:
    """Return the token in *path*; make it of *seed* (32 secret random bytes) if there is none.

    One that is there stays: servers that outlived who launched them know it.

    Raises:
        UsageError: The file is there, but `read_control_token` refuses it.
        OSError: The file cannot be made.
    """
    if not path.exists():
        replace_file(path, f"{seed.hex()}\n", mode=OWNER_ONLY)
    return read_control_token(path)
