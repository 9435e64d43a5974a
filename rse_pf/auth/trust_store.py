"""Store the enrolled and the denied robots next to the public keys, and load them in servers.

`AccessControlStore` changes two objects by compare-and-swap only: ``control/robots.json`` and
``control/deny.json``.  On one machine they lie in the folder of ``keys.json``, on AWS in the artifact bucket
of ``keys.json``.  `TrustStore` is the copy of keys, roster and deny list that one server uses.  When a read
fails, the server continues to use the part that it read last.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from rse_pf.auth.roster import MAX_ROSTER_BYTES, DenyList, Roster, from_json, to_json
from rse_pf.auth.tokens import KeySet
from rse_pf.config.resource_names import DENY_NAME, ROBOTS_NAME
from rse_pf.errors import ConfigurationError, Conflict, NotFound, RsePfError, UsageError, message_of
from rse_pf.storage.object_store import DirectoryStore, ObjectStore

__all__ = [
    "DENY_NAME",
    "REFRESH_S",
    "ROBOTS_NAME",
    "AccessControlStore",
    "TrustStore",
    "key_set_from_snapshot",
]

# Attempts to change an object that other writers change at the same time.
_MAX_ATTEMPTS = 20

_T = TypeVar("_T", Roster, DenyList)
REFRESH_S = 0.5
"""Seconds between two reads of the deny list and the roster.  A server reads its files, and on AWS an agent
copies the files from the bucket, so that a robot is disconnected within 2 s after it was revoked."""


class AccessControlStore:
    """The stored roster and deny list of one platform."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def roster(self) -> Roster:
        """Return the stored roster; an empty one if none was ever written."""
        return self._read(ROBOTS_NAME, Roster)[0]

    def deny_list(self) -> DenyList:
        """Return the stored deny list; an empty one if none was ever written."""
        return self._read(DENY_NAME, DenyList)[0]

    def change_roster(self, edit: Callable[[Roster], Roster]) -> None:
        """Replace the roster by what *edit* returns for it; repeat if another writer changed it meanwhile.

        Raises:
            Conflict: Other writers changed the roster at each of `_MAX_ATTEMPTS`.
            UsageError: The roster would grow above `MAX_ROSTER_BYTES`.
        """
        self._change(ROBOTS_NAME, Roster, edit)

    def change_deny_list(self, edit: Callable[[DenyList], DenyList]) -> None:
        """Replace the deny list by what *edit* returns for it; repeat if another writer changed it meanwhile.

        Raises:
            Conflict: Other writers changed the deny list at each of `_MAX_ATTEMPTS`.
        """
        self._change(DENY_NAME, DenyList, edit)

    def create_missing(self) -> None:
        """Write an empty roster or deny list where there is none.

        Without permission to list objects, S3 answers the read of a missing object like a forbidden read.
        """
        self.change_roster(lambda roster: roster)
        self.change_deny_list(lambda denied: denied)

    def _read(self, name: str, kind: type[_T]) -> tuple[_T, bytes | None]:
        try:
            data = self._store.get(name)
        except NotFound:
            return kind(), None
        return from_json(data, kind), data

    def _change(self, name: str, kind: type[_T], edit: Callable[[_T], _T]) -> None:
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            value, data = self._read(name, kind)
            changed = to_json(edit(value))
            if kind is Roster and MAX_ROSTER_BYTES < len(changed) > len(data or b""):
                raise UsageError(
                    f"a roster of {len(changed)} bytes is above {MAX_ROSTER_BYTES}",
                    hint="remove unused robots, or give them fewer scopes: services:* and the like",
                )
            try:
                if changed != data:
                    self._store.compare_and_swap(name, data, changed)
                return
            except Conflict:
                if attempt == _MAX_ATTEMPTS:
                    raise


class TrustStore:
    """The keys, the roster and the deny list that one server uses.  Its methods block.

    Attributes:
        keys: What `refresh` has read; None before the first successful read.
        snapshot: The same as JSON, for the server's other processes; see `key_set_from_snapshot`.
        problem: Which part the last `refresh` could not read, and why; "" if it could read all parts.
    """

    def __init__(self, keys_file: Path) -> None:
        """Store the path; nothing is read yet.

        Args:
            keys_file: File of the platform's public keys, a JWKS; roster and deny list are in the folder
                ``control`` next to it.
        """
        self.keys: KeySet | None = None
        self.snapshot = ""
        self.problem = ""
        self._keys_file = keys_file
        self._store = DirectoryStore(keys_file.parent)
        self._parts: dict[str, str] = {}
        self._found: set[str] = set()

    def refresh(self) -> bool:
        """Read keys, roster and deny list; return whether one of them changed.

        A part that cannot be read stays as it was read last, and ``problem`` says why.
        """
        self.problem = ""
        parts = dict(self._parts)
        for name, read in (
            ("keys", self._read_keys),
            ("robots", lambda: self._read("robots", ROBOTS_NAME, Roster)),
            ("denied", lambda: self._read("denied", DENY_NAME, DenyList)),
        ):
            try:
                parts[name] = read()
                self._found.add(name)
            except NotFound as error:
                if name == "keys" or name in self._found:  # a part that existed cannot have become empty
                    self.problem = f"{name}: {error.message}"
                else:
                    parts[name] = "{}"
            except (RsePfError, OSError, UnicodeDecodeError) as error:
                self.problem = f"{name}: {message_of(error)}"[:200]
        if parts == self._parts or len(parts) < 3:
            return False
        self._parts, self.snapshot = parts, json.dumps(parts)
        self.keys = key_set_from_snapshot(self.snapshot)
        return True

    def load(self) -> KeySet:
        """Read keys, roster and deny list for the first time, and return them.

        Raises:
            ConfigurationError: There are no keys, or a part exists and cannot be read.
        """
        self.refresh()
        if self.problem or self.keys is None:
            raise ConfigurationError(
                f"cannot read the keys, the roster or the deny list: {self.problem}",
                hint=f"check {self._keys_file} and the folder control next to it",
            )
        return self.keys

    def _read_keys(self) -> str:
        try:
            text = self._keys_file.read_text(encoding="utf-8")
        except FileNotFoundError as error:
            raise NotFound(f"there is no file {self._keys_file.name}") from error
        if text != self._parts.get("keys"):
            KeySet.from_json(text)
        return text

    def _read(self, part: str, name: str, kind: type[Roster] | type[DenyList]) -> str:
        data = self._store.get(name)
        text = data.decode()
        if text != self._parts.get(part):  # an unchanged text has been validated before
            from_json(data, kind)
        return text


def key_set_from_snapshot(snapshot: str) -> KeySet:
    """Return the keys, with roster and deny list, in the ``snapshot`` of a `TrustStore`.

    Raises:
        UsageError: The keys are damaged.
        ConfigurationError: The roster or the deny list is damaged.
    """
    parts = json.loads(snapshot)
    roster = from_json(parts["robots"], Roster)
    return KeySet.from_json(parts["keys"]).with_access_control(roster, from_json(parts["denied"], DenyList))
