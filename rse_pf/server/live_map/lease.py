"""Read and write the lease of a live map: which process is its map server, and where that process listens.

The compare-and-swap and the clocks of a lease are in `rse_pf.storage.lease`; here are the record of live
maps, its name in the object store, and the rule by which a process claims a map, connects to its map server
or waits."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Literal

import msgspec

from rse_pf.errors import BadRequest, StoreError
from rse_pf.identity import name_segment
from rse_pf.storage.lease import Lease
from rse_pf.storage.object_store import ObjectStore

__all__ = [
    "LeaseAction",
    "LeaseRecord",
    "LeaseState",
    "MapLease",
    "decode_lease",
    "lease_name",
    "map_folder",
    "next_action",
    "renewal_s",
    "tenant_folder",
]

_MAP_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_RENEWALS_PER_LEASE = 3
"""Number of renewals of a lease within ``live.lease_s``: one renewal may fail, and the next one still comes
before the lease expires."""
_FAILED_STARTS_BEFORE_BACKOFF = 2
"""Number of takeovers in a row (`LeaseRecord.tries`) up to which a failed map server is replaced
``live.lease_s`` after its last renewal; each takeover beyond this number doubles the wait."""
_MAX_TAKEOVER_WAIT_S = 60.0
"""Longest wait in seconds before the takeover of a map whose map servers fail again and again, unless
``live.lease_s`` is longer: a map whose data crash its map servers is tried once a minute."""

LeaseState = Literal["starting", "serving", "released", "stopped"]
LeaseAction = Literal["claim", "connect", "wait"]


class LeaseRecord(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Describe the map server of a live map, as stored in JSON in the object ``live/TENANT/MAP/lease``.

    The record stays in the store when its map server has exited.

    Attributes:
        state: ``starting`` while the map server restores the map, ``serving`` while it accepts connections,
            ``released`` when any server may claim the map, ``stopped`` when an operator has ended the map.
        owner: Name of the map server's process, unique to this claim of the lease.
        epoch: Number of this claim: 1 for the first map server of the map, 2 for the next, and so on.
        server: Id of the backend server on which the map server runs.
        address: Host at which the map server listens; empty before it serves.
        port: TCP port at which the map server listens; 0 before it serves.
        certificate: SHA-256 in hex of the map server's TLS certificate, which workers pin.
        beat: Number of renewals by this map server.
        base: Position in the log at which a map of this name was stopped last; a later map of the same name
            begins with the next entry.  0 if no map of this name was stopped.
        tries: Number of takeovers in a row from a failed map server; 0 again when a map server has renewed
            the lease with ``is_settled``, or has given the map up.
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
    """Decode the lease record of a live map from the content *data* of the object *name*.

    Raises:
        StoreError: The content is not a lease record.
    """
    try:
        return _decode(data)
    except msgspec.MsgspecError as error:
        raise StoreError(
            f"the object {name!r} is not a valid lease of a live map",
            hint="delete this object; a server then restores the map from its log and writes a new lease",
        ) from error


def tenant_folder(tenant: str) -> str:
    """Return the prefix of the object names of all live maps of *tenant*, ending with a slash."""
    return f"live/{name_segment(tenant)}/"


def map_folder(tenant: str, map_name: str) -> str:
    """Return the prefix of the object names of one live map, ending with a slash.

    Raises:
        BadRequest: *map_name* is not 1 to 64 lower-case letters, digits and hyphens.
    """
    if not _MAP_NAME.fullmatch(map_name):
        raise BadRequest(
            f"{map_name[:80]!r} is not a valid name of a map",
            hint="use 1 to 64 lower-case letters, digits and hyphens",
        )
    return f"{tenant_folder(tenant)}{map_name}/"


def lease_name(tenant: str, map_name: str) -> str:
    """Return the object name of the lease of a live map; raises BadRequest for an invalid *map_name*."""
    return f"{map_folder(tenant, map_name)}lease"


def renewal_s(lease_s: float) -> float:
    """Return the seconds between two renewals of a lease that expires *lease_s* seconds after a renewal.

    It is a third of *lease_s*.
    """
    return lease_s / _RENEWALS_PER_LEASE


def next_action(record: LeaseRecord | None, *, unchanged_s: float, lease_s: float) -> LeaseAction:
    """Decide what a process that needs a live map does, given the lease of the map.

    Args:
        record: The lease as it is stored; None if the map has no lease.
        unchanged_s: Seconds for which the calling process has seen no renewal, by its own clock.
        lease_s: Seconds without a renewal after which the map server counts as failed.

    Returns:
        ``claim``: become the map server, since there is none, or it gave the map up, or it has failed.  If
        ``record.tries`` is 3, 4, 5, ..., since map servers failed soon after their start, a failed one is
        replaced only after *lease_s* times 2, 4, 8, ..., at most 60 s (exponential back-off).
        ``connect``: the map server accepts connections.
        ``wait``: a map server is starting, or has failed and may not be replaced yet.
    """
    if record is None or record.state in ("released", "stopped"):
        return "claim"
    doublings = max(0, record.tries - _FAILED_STARTS_BEFORE_BACKOFF)
    if unchanged_s >= lease_s and unchanged_s >= min(_MAX_TAKEOVER_WAIT_S, lease_s * 2**doublings):
        return "claim"
    return "connect" if record.state == "serving" and unchanged_s < lease_s else "wait"


class MapLease:
    """The lease of a live map as its map server claims, renews and releases it.

    All methods block, and are called by one thread at a time.
    """

    def __init__(
        self, store: ObjectStore, name: str, *, owner: str, server: str, clock: Callable[[], float]
    ) -> None:
        """Prepare a claim; nothing is read or written before `claim`.

        Args:
            store: Object store that all servers share.
            name: Object name of the lease.
            owner: Name of the calling process, unique to this claim.
            server: Id of the backend server on which the process runs.
            clock: Returns monotonic time in seconds.
        """
        self.record = LeaseRecord(state="starting", owner=owner, epoch=0, server=server)
        """The lease record as this process wrote it last, also after another process has replaced it.

        Before the first claim, a record with epoch 0 that is not in the store.
        """
        self._lease = Lease(store, name, decode_lease, clock)

    @property
    def age_s(self) -> float:
        """Seconds since this process began its last successful write of the lease; infinity before the first.

        No other process can have taken the map before that time.
        """
        return self._lease.age_s

    def claim(self, known: bytes | None) -> bool:
        """Become the map server if the stored lease still has the content *known* (None: no lease).

        The new lease has the state ``starting`` and the next epoch.

        Returns:
            False if another process changed the lease first.

        Raises:
            StoreError: The store fails, so that the outcome is unknown; call again with the same *known*,
                which succeeds if this write did.
        """
        before = self._lease.note(known)
        if before is None:
            return self._write(msgspec.structs.replace(self.record, epoch=1))
        has_ended = before.state in ("released", "stopped")
        tries = 0 if has_ended else before.tries + 1
        return self._write(
            msgspec.structs.replace(self.record, epoch=before.epoch + 1, base=before.base, tries=tries)
        )

    def serve(self, address: str, port: int, certificate: str) -> bool:
        """Write into the lease where the map server listens, and the SHA-256 in hex of its certificate.

        The state of the lease is then ``serving``.

        Returns:
            False if another process has taken the map over.

        Raises:
            StoreError: The store fails, so that the outcome is unknown.
        """
        return self._write_if_held(
            msgspec.structs.replace(
                self.record, state="serving", address=address, port=port, certificate=certificate
            )
        )

    def renew(self, *, is_settled: bool = False) -> bool:
        """Renew the lease for another ``live.lease_s`` seconds.

        Args:
            is_settled: Whether the map server has served for a while; the count of map servers that failed
                soon after their start is then reset.

        Returns:
            False if another process has taken the map over.

        Raises:
            StoreError: The store fails, so that the outcome is unknown.
        """
        tries = 0 if is_settled else self.record.tries
        return self._write_if_held(
            msgspec.structs.replace(self.record, beat=self.record.beat + 1, tries=tries)
        )

    def release(self) -> bool:
        """Give the map up, so that any server may claim it at once.

        Returns:
            False if another process had taken the map over already.

        Raises:
            StoreError: The store fails, so that the outcome is unknown.
        """
        return self._write_if_held(msgspec.structs.replace(self.record, state="released", tries=0))

    def stop(self, base: int) -> bool:
        """End the map: the entries of its log up to position *base* no longer belong to it.

        Returns:
            False if another process had taken the map over already.

        Raises:
            StoreError: The store fails, so that the outcome is unknown.
        """
        return self._write_if_held(msgspec.structs.replace(self.record, state="stopped", base=base, tries=0))

    def _write_if_held(self, record: LeaseRecord) -> bool:
        """Replace the lease by *record*; return False if another process has taken or changed the lease."""
        return self._is_held and self._write(record)

    def _write(self, record: LeaseRecord) -> bool:
        """Replace the known lease by *record*; return False if another process changed the lease first.

        Raises:
            StoreError: The store fails, so that the outcome is unknown.
        """
        # `Lease.write` fails if the stored record is not the known one, and reads it.  If it has the name of
        # this process, an earlier write has succeeded although its reply was lost: replace it.
        while not self._lease.write(record):
            if not self._is_held:
                return False
        self.record = record
        return True

    @property
    def _is_held(self) -> bool:
        return self._lease.record is not None and self._lease.record.owner == self.record.owner
