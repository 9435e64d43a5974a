"""How job servers find a running batch: an object of the store with the scheduler's address and the key.

Anybody who can read it can read the maps and forge the parts anyway, because both are in the same store.
"""

from __future__ import annotations

import contextlib
import itertools
import secrets
import threading

import msgspec

from rse_pf.batch.cluster import ClusterKey
from rse_pf.batch.parts import PREFIX
from rse_pf.errors import StoreError
from rse_pf.object_store import ObjectStore

__all__ = ["EXPIRES_S", "Invitation", "Invited", "invitations"]

_FOLDER = f"{PREFIX}/schedulers/"
RENEW_S = 15.0
"""Time between two renewals."""
EXPIRES_S = 90.0
"""An invitation that a job server saw unchanged for this long is one of a process that ended."""


class Invited(msgspec.Struct, frozen=True, kw_only=True):
    """A scheduler that wants workers."""

    address: str
    certificate: str
    key: str
    beat: int = 0
    """Counts renewals."""


class Invitation:
    """The invitation of one run; a thread renews it, so that it ends with the process."""

    def __init__(
        self, store: ObjectStore, key: ClusterKey, name: str = "", *, renew_s: float = RENEW_S
    ) -> None:
        """Announce nothing yet; *name* is unique, by default by chance."""
        self._store = store
        self._key = key
        self._name = f"{_FOLDER}{name or secrets.token_hex(8)}"
        self._renew_s = renew_s
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def announce(self, address: str) -> None:
        """Invite workers to the scheduler at *address*, and no longer to one before; raises StoreError."""
        self._end_thread()
        invited = Invited(address=address, certificate=self._key.certificate, key=self._key.key)
        self._store.put(self._name, msgspec.json.encode(invited))
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._renew, args=(invited, self._over), daemon=True)
        self._thread.start()

    def withdraw(self) -> None:
        """Invite nobody any more; raises StoreError."""
        self._end_thread()
        self._store.delete(self._name)

    def _renew(self, invited: Invited, over: threading.Event) -> None:
        for beat in itertools.count(1):
            if over.wait(self._renew_s):
                return
            with contextlib.suppress(StoreError):  # the next renewal is soon enough
                self._store.put(self._name, msgspec.json.encode(msgspec.structs.replace(invited, beat=beat)))

    def _end_thread(self) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None


def invitations(store: ObjectStore) -> dict[str, Invited]:
    """Return the invitations by name; raises StoreError."""
    found = {}
    for info in store.list(_FOLDER):
        try:
            found[info.name] = msgspec.json.decode(store.get(info.name), type=Invited)
        except msgspec.MsgspecError as error:
            raise StoreError(f"{info.name!r} is no invitation", hint="delete it") from error
    return found
