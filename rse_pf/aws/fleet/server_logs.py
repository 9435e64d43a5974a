"""Read the logs of servers for an operator: journals in the artifact bucket, or the console of an instance.

Nothing is changed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from rse_pf.aws.account import Account
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config.resource_names import JOURNAL_PREFIX, ResourceNames
from rse_pf.storage.object_store import ObjectStore

__all__ = ["LoggedServer", "console_of", "last_lines", "list_logged_servers", "open_journals"]

_PIECE = re.compile(rf"{JOURNAL_PREFIX}/(?P<server>[A-Za-z0-9-]{{1,64}})/(?P<first_us>\d{{20}})\.log")
# Most pieces of a server's journals that are read at once, the newest ones: hours of logs, in some seconds.
_MAX_PIECES = 200
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # control characters, which could change a terminal


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedServer:
    """A server with journals in the bucket.

    Attributes:
        name: Instance id.
        pieces: Names of the objects that hold its journals, oldest first.
        newest_s: Time of the first line of the newest piece, Unix seconds.
    """

    name: str
    pieces: tuple[str, ...]
    newest_s: float


def open_journals(account: Account, names: ResourceNames) -> S3Store:
    """Return the artifact bucket, which holds the journals; raises ConfigurationError if there is none."""
    bucket = account.resource(names.stack("Data"), "AWS::S3::Bucket", "Artifacts")
    return S3Store(account.client("s3"), bucket)


def list_logged_servers(store: ObjectStore) -> list[LoggedServer]:
    """Return the servers with journals in *store*, the one with the newest piece first; raises StoreError."""
    pieces: dict[str, list[str]] = {}
    for info in store.list(f"{JOURNAL_PREFIX}/"):
        match = _PIECE.fullmatch(info.name)
        if match is not None:
            pieces.setdefault(match["server"], []).append(info.name)
    servers = [
        LoggedServer(name=server, pieces=tuple(sorted(names)), newest_s=_begin_s(max(names)))
        for server, names in pieces.items()
    ]
    return sorted(servers, key=lambda server: (-server.newest_s, server.name))


def last_lines(store: ObjectStore, server: LoggedServer, count: int) -> list[str]:
    """Return the last *count* lines of a server's journals, fewer if there are fewer; raises StoreError.

    Control characters are replaced by ``?``.
    """
    lines: list[str] = []
    for name in reversed(server.pieces[-_MAX_PIECES:]):
        lines = store.get(name).decode("utf-8", "replace").splitlines() + lines
        if len(lines) >= count:
            break
    return [_CONTROL.sub("?", line) for line in lines[-count:]]


def console_of(account: Account, server: str) -> list[str]:
    """Return the lines of an instance's console output; empty if AWS has none.

    AWS keeps the output for an hour after the instance was terminated.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    output = account.find("ec2", "get_console_output", InstanceId=server, Latest=False)
    text = str((output or {}).get("Output", ""))  # botocore has decoded the base64
    return [_CONTROL.sub("?", line) for line in text.splitlines()]


def _begin_s(piece: str) -> float:
    match = _PIECE.fullmatch(piece)
    assert match is not None
    return int(match["first_us"]) / 1e6
