"""The control room: where an operator's decisions lie beside the public keys, and how servers learn of them.

Two objects in a store, changed by compare-and-swap alone: ``control/robots.json`` and ``control/deny.json``.
On one machine they lie in the folder of ``keys.json``, in a cloud in its bucket.  Promises that a reader
which knew a list once never knows less because a read failed, and no thread and no timer.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from rse_pf.auth.roster import DenyList, Roster, from_json, to_json
from rse_pf.auth.tokens import KeySet
from rse_pf.config.resource_names import DENY_NAME, ROBOTS_NAME
from rse_pf.errors import ConfigurationError, Conflict, NotFound, RsePfError
from rse_pf.object_store import DirectoryStore, ObjectStore

__all__ = [
    "DENY_NAME",
    "REFRESH_S",
    "ROBOTS_NAME",
    "AccessControlStore",
    "TrustStore",
    "key_set_from_snapshot",
]

_TRIES = 20

_T = TypeVar("_T", Roster, DenyList)
REFRESH_S = 0.5
"""Time between two looks at the deny-list and the roster: a revoked robot is disconnected within 2 s."""


class AccessControlStore:
    """The two objects of one platform."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def roster(self) -> Roster:
        """Return who is enrolled; nobody if nothing was ever written."""
        return self._read(ROBOTS_NAME, Roster)[0]

    def denied(self) -> DenyList:
        """Return who is refused; nobody if nothing was ever written."""
        return self._read(DENY_NAME, DenyList)[0]

    def change_roster(self, edit: Callable[[Roster], Roster]) -> None:
        """Apply *edit* to the newest roster; raises Conflict when others write all the time."""
        self._change(ROBOTS_NAME, Roster, edit)

    def change_deny_list(self, edit: Callable[[DenyList], DenyList]) -> None:
        """Apply *edit* to the newest deny-list; raises Conflict when others write all the time."""
        self._change(DENY_NAME, DenyList, edit)

    def create_missing(self) -> None:
        """Write empty objects where there are none, so that a reader can tell "empty" from "forbidden"."""
        self.change_roster(lambda roster: roster)
        self.change_deny_list(lambda denied: denied)

    def _read(self, name: str, kind: type[_T]) -> tuple[_T, bytes | None]:
        try:
            data = self._store.get(name)
        except NotFound:
            return kind(), None
        return from_json(data, kind), data

    def _change(self, name: str, kind: type[_T], edit: Callable[[_T], _T]) -> None:
        for attempt in range(_TRIES):
            value, data = self._read(name, kind)
            fresh = to_json(edit(value))
            if fresh == data:
                return
            try:
                self._store.compare_and_swap(name, data, fresh)
                return
            except Conflict:
                if attempt + 1 == _TRIES:
                    raise


class TrustStore:
    """What one server knows of keys, robots and denials; `look` learns what is new.  Blocking.

    ``text`` is all of it as JSON for a server's other processes, see `key_set_from_snapshot`.
    """

    def __init__(self, keys_file: Path) -> None:
        """Know nothing yet.

        Args:
            keys_file: The JWKS; the control room lies in the same folder.
        """
        self.keys: KeySet | None = None
        self.text = ""
        self.problem = ""
        """Why the last look learned nothing of some object; empty if it could read all."""
        self._keys_file = keys_file
        self._store = DirectoryStore(keys_file.parent)
        self._parts: dict[str, str] = {}
        self._found: set[str] = set()

    def look(self) -> bool:
        """Read what there is; return whether it changed.  What cannot be read stays as it was known."""
        self.problem = ""
        parts = dict(self._parts)
        for name, read in (
            ("keys", self._read_keys),
            ("robots", lambda: self._read(ROBOTS_NAME, Roster)),
            ("denied", lambda: self._read(DENY_NAME, DenyList)),
        ):
            try:
                text = read()
            except NotFound as error:
                if name == "keys" or name in self._found:  # what was there once has not become empty
                    self.problem = f"{name}: {error.message}"
                else:
                    parts[name] = "{}"
                continue
            except (RsePfError, OSError, UnicodeDecodeError) as error:
                self.problem = f"{name}: {error}"[:200]
                continue
            parts[name] = text
            self._found.add(name)
        if parts == self._parts or len(parts) < 3:
            return False
        self._parts = parts
        self.text = json.dumps(parts)
        self.keys = key_set_from_snapshot(self.text)
        return True

    def first(self) -> None:
        """Look for the first time; raises ConfigurationError if anything that is there cannot be read."""
        self.look()
        if self.problem or self.keys is None:
            raise ConfigurationError(
                f"who may come in is not known: {self.problem}",
                hint=f"look at {self._keys_file} and the folder control beside it",
            )

    def _read_keys(self) -> str:
        try:
            text = self._keys_file.read_text(encoding="utf-8")
        except FileNotFoundError as error:
            raise NotFound(f"there is no file {self._keys_file.name}") from error
        KeySet.from_json(text)
        return text

    def _read(self, name: str, kind: type[Roster] | type[DenyList]) -> str:
        data = self._store.get(name)
        from_json(data, kind)
        return data.decode()


def key_set_from_snapshot(text: str) -> KeySet:
    """Return what the ``text`` of a `TrustStore` says; raises UsageError or ConfigurationError."""
    parts = json.loads(text)
    roster = from_json(parts["robots"], Roster)
    return KeySet.from_json(parts["keys"]).with_access_control(roster, from_json(parts["denied"], DenyList))
