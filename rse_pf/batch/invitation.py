"""How job servers find a running batch: an object of the store with the scheduler's address and the key.

Anybody who can read it can read the maps and forge the parts anyway, because both are in the same store.
"""

from __future__ import annotations

import secrets

import msgspec

from rse_pf.batch.cluster import ClusterKey
from rse_pf.batch.parts import PREFIX
from rse_pf.errors import StoreError
from rse_pf.object_store import ObjectStore

__all__ = ["Invitation", "Invited", "invitations"]

_FOLDER = f"{PREFIX}/schedulers/"


class Invited(msgspec.Struct, frozen=True, kw_only=True):
    """A scheduler that wants workers."""

    address: str
    certificate: str
    key: str


class Invitation:
    """The invitation of one run."""

    def __init__(self, store: ObjectStore, key: ClusterKey, name: str = "") -> None:
        """Announce nothing yet; *name* is unique, by default by chance."""
        self._store = store
        self._key = key
        self._name = f"{_FOLDER}{name or secrets.token_hex(8)}"

    def announce(self, address: str) -> None:
        """Invite workers to the scheduler at *address*."""
        invited = Invited(address=address, certificate=self._key.certificate, key=self._key.key)
        self._store.put(self._name, msgspec.json.encode(invited))

    def withdraw(self) -> None:
        """Invite nobody any more."""
        self._store.delete(self._name)


def invitations(store: ObjectStore) -> dict[str, Invited]:
    """Return the invitations by name; raises StoreError."""
    found = {}
    for info in store.list(_FOLDER):
        try:
            found[info.name] = msgspec.json.decode(store.get(info.name), type=Invited)
        except msgspec.MsgspecError as error:
            raise StoreError(f"{info.name!r} is no invitation", hint="delete it") from error
    return found
