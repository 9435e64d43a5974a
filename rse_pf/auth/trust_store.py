"""Store the enrolled and the denied robots next to the public keys, and load them in servers.

`AccessControlStore` holds two objects, changed by compare-and-swap only: ``control/robots.json`` and
``control/deny.json``.  On one machine they lie in the folder of ``keys.json``, in a cloud in its bucket.
`TrustStore` is a server's view of keys, robots and denials.  When a read fails, it keeps what it knew.
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

_MAX_ATTEMPTS = 20

_T = TypeVar("_T", Roster, DenyList)
REFRESH_S = 0.5
"""Pause between two reads of deny list and roster, by servers and, before them, by the agents on AWS: a robot
that is revoked is disconnected within 2 s."""


class AccessControlStore:
    """The roster and the deny list of one platform."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def roster(self) -> Roster:
        """Return the enrolled robots; an empty roster if none was ever written."""
        return self._read(ROBOTS_NAME, Roster)[0]

    def deny_list(self) -> DenyList:
        """Return the denied tokens and robots; an empty list if none was ever written."""
        return self._read(DENY_NAME, DenyList)[0]

    def change_roster(self, edit: Callable[[Roster], Roster]) -> None:
        """Apply *edit* to the current roster; raises Conflict if others keep changing it.

        Raises:
            UsageError: The roster would grow above what servers read.
        """
        self._change(ROBOTS_NAME, Roster, edit)

    def change_deny_list(self, edit: Callable[[DenyList], DenyList]) -> None:
        """Apply *edit* to the current deny list; raises Conflict if others keep changing it."""
        self._change(DENY_NAME, DenyList, edit)

    def create_missing(self) -> None:
        """Write missing objects as empty ones, so that readers can distinguish "empty" from "forbidden"."""
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
    """The keys, robots and denials that one server knows; `refresh` loads what changed.  Blocking.

    ``snapshot`` is all of it as JSON, for a server's other processes; see `key_set_from_snapshot`.
    ``problem`` is what the last `refresh` could not read, empty if it could read everything.
    """

    def __init__(self, keys_file: Path) -> None:
        """Store the path; nothing is read yet.

        Args:
            keys_file: The JWKS; roster and deny list are in the folder ``control`` next to it.
        """
        self.keys: KeySet | None = None
        self.snapshot = ""
        self.problem = ""
        self._keys_file = keys_file
        self._store = DirectoryStore(keys_file.parent)
        self._parts: dict[str, str] = {}
        self._found: set[str] = set()

    def refresh(self) -> bool:
        """Read everything; return whether it changed.  A part that cannot be read stays as it was known."""
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
        """Read everything for the first time; raises ConfigurationError if an existing part is unreadable."""
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
        if text != self._parts.get(part):  # what is known was valid
            from_json(data, kind)
        return text


def key_set_from_snapshot(snapshot: str) -> KeySet:
    """Return the keys in the ``snapshot`` of a `TrustStore`; raises UsageError or ConfigurationError."""
    parts = json.loads(snapshot)
    roster = from_json(parts["robots"], Roster)
    return KeySet.from_json(parts["keys"]).with_access_control(roster, from_json(parts["denied"], DenyList))
