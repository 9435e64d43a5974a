"""The record of a live map, and who may own it: what a lease (`rse_pf.lease`) means for live maps."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Literal

import msgspec

from rse_pf.errors import BadRequest, StoreError
from rse_pf.lease import Lease
from rse_pf.object_store import ObjectStore, name_segment

__all__ = [
    "INTERNAL_KEY",
    "LeaseRecord",
    "LeaseState",
    "LeaseVerdict",
    "OwnerLease",
    "decode_lease",
    "lease_name",
    "map_folder",
    "renewal_s",
    "tenant_folder",
    "verdict_on",
]

INTERNAL_KEY = "live/key=internal"
"""Object with the key of the tokens between servers; no tenant's folder has an equals sign without x."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_RENEWALS_PER_LEASE = 3
"""Two renewals may fail or come late before another server takes the map over."""
_FREE_TRIES = 2
"""So many owners may die one after the other before the next one waits longer than the lease."""
_MAX_WAIT_S = 60.0

LeaseState = Literal["starting", "serving", "released", "stopped"]
LeaseVerdict = Literal["claim", "connect", "wait"]


class LeaseRecord(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Who owns a live map, and where.  ``beat`` counts renewals; ``epoch`` counts owners.

    Attributes:
        certificate: The sha256 of the certificate that the owner shows.
        base: Position of the log before which nothing belongs to the map: it was stopped there.
        tries: Owners that ended before they had served for a while, one after the other.
    """

    state: LeaseState
    owner: str
    epoch: int
    server: str
    address: str = ""
    port: int = 0
    certificate: str = ""
    beat: int = 0
    base: int = 0
    tries: int = 0


_decode = msgspec.json.Decoder(LeaseRecord).decode


def decode_lease(name: str, data: bytes) -> LeaseRecord:
    """Return the record in *data*, the object *name*; raises StoreError."""
    try:
        return _decode(data)
    except msgspec.MsgspecError as error:
        raise StoreError(f"{name!r} is no lease of a live map", hint="delete it") from error


def tenant_folder(tenant: str) -> str:
    """Return the folder of a tenant's live maps, with a slash at its end."""
    return f"live/{name_segment(tenant)}/"


def map_folder(tenant: str, map_name: str) -> str:
    """Return the folder of one live map, with a slash at its end; raises BadRequest."""
    if not _NAME.fullmatch(map_name):
        raise BadRequest(
            f"{map_name[:80]!r} is not a valid name of a map",
            hint="use 1 to 64 lower-case letters, digits and hyphens",
        )
    return f"{tenant_folder(tenant)}{map_name}/"


def lease_name(tenant: str, map_name: str) -> str:
    """Return the object name of the lease of a map; raises BadRequest."""
    return f"{map_folder(tenant, map_name)}lease"


def renewal_s(lease_s: float) -> float:
    """Return the time between two renewals of a lease that ends after *lease_s* without one, in seconds."""
    return lease_s / _RENEWALS_PER_LEASE


def verdict_on(record: LeaseRecord | None, *, unchanged_s: float, lease_s: float) -> LeaseVerdict:
    """Decide how a process that needs a map treats its lease.

    Args:
        record: As it stands in the store; None if there is none.
        unchanged_s: For how long this process has known it unchanged.
        lease_s: After this time without a renewal the owner is considered dead; longer after owners that
            died soon after their start, so that a map that ends its owners does not load every server.
    """
    if record is None or record.state in ("released", "stopped"):
        return "claim"
    waits = max(0, record.tries - _FREE_TRIES)
    if unchanged_s >= lease_s and unchanged_s >= min(_MAX_WAIT_S, lease_s * 2**waits):
        return "claim"
    return "connect" if record.state == "serving" and unchanged_s < lease_s else "wait"


class OwnerLease:
    """The lease in the hands of the process that claims it.  Blocking; for one thread at a time."""

    def __init__(
        self, store: ObjectStore, name: str, *, owner: str, server: str, clock: Callable[[], float]
    ) -> None:
        """Read nothing yet.

        Args:
            store: Shared by all servers.
            name: Of the record.
            owner: Name that is unique to this process and this claim.
            server: Id of the server on which it runs.
            clock: Seconds, monotonic.
        """
        self.record = LeaseRecord(state="starting", owner=owner, epoch=0, server=server)
        """As it was written last; also after another owner replaced it."""
        self._lease = Lease(store, name, decode_lease, clock)

    @property
    def age_s(self) -> float:
        """Seconds since the begin of the last write that succeeded: nobody took the map before that."""
        return self._lease.age_s

    def claim(self, known: bytes | None) -> bool:
        """Become the owner if the record is still *known*; False if another process was first."""
        before = self._lease.note(known)
        if before is None:
            return self._put(msgspec.structs.replace(self.record, epoch=1))
        has_ended = before.state in ("released", "stopped")
        tries = 0 if has_ended else before.tries + 1
        return self._put(
            msgspec.structs.replace(self.record, epoch=before.epoch + 1, base=before.base, tries=tries)
        )

    def serve(self, address: str, port: int, certificate: str) -> bool:
        """Tell where the owner listens; False if the map was taken over."""
        return self._write(
            msgspec.structs.replace(
                self.record, state="serving", address=address, port=port, certificate=certificate
            )
        )

    def renew(self, *, is_settled: bool = False) -> bool:
        """Renew the lease; False if the map was taken over.

        Args:
            is_settled: The owner has served for a while: earlier crashes no longer count.
        """
        tries = 0 if is_settled else self.record.tries
        return self._write(msgspec.structs.replace(self.record, beat=self.record.beat + 1, tries=tries))

    def release(self) -> bool:
        """Let any server take the map at once; False if one has."""
        return self._write(msgspec.structs.replace(self.record, state="released", tries=0))

    def stop(self, base: int) -> bool:
        """End the map: what the log holds up to position *base* belongs to it no longer."""
        return self._write(msgspec.structs.replace(self.record, state="stopped", base=base, tries=0))

    def _write(self, record: LeaseRecord) -> bool:
        """Replace our record; False if it is another's; raises StoreError if nothing is known."""
        return self._is_ours and self._put(record)

    def _put(self, record: LeaseRecord) -> bool:
        """Replace the record that is known; False if there is another's."""
        while not self._lease.write(record):
            if not self._is_ours:
                return False
            # The answer to an earlier write was lost: nobody else writes a record with this owner.
        self.record = record
        return True

    @property
    def _is_ours(self) -> bool:
        return self._lease.record is not None and self._lease.record.owner == self.record.owner
