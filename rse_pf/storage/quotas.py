"""Limit the bytes that robots and tenants store, in one account for all servers.

What is charged:

- to a robot: its objects, its unfinished uploads, and the versions of maps that it committed
- to its tenant: all objects and unfinished uploads of its robots, all versions of maps, the logs, snapshots
  and features of live maps, the states of services, and waiting jobs

Bytes are reserved before they are written.  Nothing is removed to make other data fit; reading and removing
are never refused.

How the bytes are counted:

1. The object ``accounts/TENANT`` holds the bytes of the tenant that were counted last, and the bytes that
   were granted to processes since then.  It is changed by compare-and-swap, so it is valid for all processes.
2. A process draws a few MiB from this account at a time, and charges new objects to them in its memory.
3. Each process counts the bytes of a robot for itself.  To include what other processes stored, it counts
   again: every `_RECOUNT_S` in a folder (only folders that changed are read), every `_SLOW_RECOUNT_S` in
   other stores.
4. The object ``quotas/TENANT`` holds the quota that an operator gave to one tenant; without this object the
   setting ``data.tenant_quota_bytes`` applies.
5. ``charges/TENANT/ROBOT/MAP/VERSION.SIZE`` is an empty object, by which one version of a map, of SIZE bytes,
   is charged to the robot that committed it.  Versions of live maps have none: no robot commits them.

While the disk has little free space, a tenant may store at most an equal part: the bytes of all tenants and
the free bytes together, divided by the number of tenants.  So a tenant that fills the disk is refused, while
others can still store data.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

import msgspec

from rse_pf.config import DataSettings
from rse_pf.errors import Busy, Conflict, NotFound, QuotaExceeded, StoreError, StoreFull
from rse_pf.identity import RobotId, name_segment
from rse_pf.storage.object_store import (
    MIN_CHARGE_BYTES,
    DirectoryStore,
    ObjectStore,
    Usage,
    charge_of,
)

__all__ = [
    "Accounts", "TenantAccount", "charge_name", "own_quota_bytes", "remove_charges", "set_own_quota",
    "stored_by_tenant", "sum_charges", "tenant_folders",
]  # fmt: skip

_K = TypeVar("_K")
_T = TypeVar("_T")
_RECOUNT_S = 10.0  # seconds between two counts of a folder, of which only changed subfolders are read
_SLOW_RECOUNT_S = 600.0  # seconds between two counts of another store, for which all objects are listed
_REFUSED_RECOUNT_SHARE = 0.1
"""Fraction of `_RECOUNT_S` or `_SLOW_RECOUNT_S` after which a tenant is counted again before it is refused,
because it may have deleted objects."""
_MAX_ACCOUNTS = 10_000  # most robots, and most tenants, whose counts a process remembers
_MAX_DRAWN_BYTES = 16 << 20  # most bytes that a process draws from the account of a tenant at once
_DRAWN_DIVISOR = 64  # a process draws 1/64 of the bytes left, so that several can use a nearly full account
_DRAWN_S = 5.0  # seconds after which drawn bytes expire, so that a process that exited holds none for long
_WRITTEN_S = 15.0  # longest time in seconds from the drawing of an object's bytes to the end of its writing
_MAX_SWAPS = 50  # attempts to change an account that other processes change at the same time
_DISK_SHARE_S = 1.0  # seconds for which an equal part of the disk is remembered, which counts all tenants
_RESERVE_SHARE = 0.1
"""Free fraction of the disk below which a tenant that stores more than an equal part is refused."""
_NEVER = float("-inf")  # the time of an event that has not happened yet
_OF_TENANT = ("objects", "maps", "live", "states", "jobs")
"""First segments of the names of objects that are charged to the tenant in the second segment."""


class _Ledger(msgspec.Struct, frozen=True, array_like=True):
    """The object ``accounts/TENANT``: the bytes that were counted at the Unix time *counted_s*.

    *granted* are the Unix time and the bytes of each grant to a process since then.
    """

    counted_s: float
    charged_bytes: int
    granted: tuple[tuple[float, int], ...] = ()

    @property
    def used_bytes(self) -> int:
        """The counted bytes and all granted bytes."""
        return self.charged_bytes + sum(size for _, size in self.granted)


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(_Ledger).decode


class TenantAccount:
    """The account of one tenant in one process.  Its methods block; several threads may call them."""

    def __init__(
        self,
        store: ObjectStore,
        tenant: str,
        settings: DataSettings,
        *,
        wall_clock: Callable[[], float] = time.time,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Create the account; nothing is counted yet.

        Args:
            store: The store that all processes share.
            tenant: Name of the tenant.
            settings: Hold the quota of tenants that have no quota of their own.
            wall_clock: Returns Unix seconds.
            check: Called between two reads of the store; an error that it raises ends the count.
        """
        self._store, self._settings, self._wall_clock, self._check = store, settings, wall_clock, check
        self._tenant, self._folder = tenant, name_segment(tenant)
        self._name = f"accounts/{self._folder}"
        self._recount_s = _recount_s(store)
        self._lock = threading.Lock()
        self._drawn_bytes, self._drawn_s = 0, _NEVER
        self._share_bytes, self._share_s = 0.0, _NEVER

    def quota_bytes(self) -> int:
        """Return how many bytes the tenant may store now; raises StoreError.

        It is the tenant's own quota, which an operator may change at any time, or the setting.
        """
        own = own_quota_bytes(self._store, self._folder)
        return self._settings.tenant_quota_bytes if own is None else own

    def try_charge(self, size: int) -> bool:
        """Charge an object of *size* bytes to the drawn bytes, if that needs neither the store nor a wait.

        Returns whether the object was charged; if not, call `reserve`.
        """
        charge = charge_of(size)
        if not self._lock.acquire(blocking=False):
            return False
        try:
            return self._spend_drawn(charge)
        finally:
            self._lock.release()

    def reserve(self, size: int, *, margin: int = 0, freed: int = 0) -> None:
        """Charge an object of *size* bytes, which the caller writes now.

        Args:
            size: Size of the object.
            margin: Bytes that must stay free in addition, for data that will be written because of it.
            freed: Bytes that are removed when the object is written.

        Raises:
            QuotaExceeded: The tenant would store more than its own quota, or ``data.tenant_quota_bytes``.
            StoreFull: The disk is nearly full, and the tenant would store more than an equal part of it.
            Busy: Other processes changed the account at each of `_MAX_SWAPS` attempts.
            StoreError: The store fails.
        """
        charge = charge_of(size)
        with self._lock:
            if not self._spend_drawn(charge):
                drawn = self._draw(charge, margin - freed)
                self._drawn_bytes += drawn - charge
                self._drawn_s = self._wall_clock()

    def release(self, size: int) -> None:
        """Take back the charge for an object of *size* bytes, which was removed or not written.

        The bytes are added to the drawn ones; if those have expired, the next count of the tenant finds them.
        """
        with self._lock:
            if self._is_drawn():
                self._drawn_bytes += charge_of(size)

    def _is_drawn(self) -> bool:
        """Return whether the drawn bytes have not expired; if they have, forget them."""
        is_drawn = 0.0 <= self._wall_clock() - self._drawn_s < _DRAWN_S
        if not is_drawn:
            self._drawn_bytes = 0
        return is_drawn

    def _spend_drawn(self, charge: int) -> bool:
        """Subtract *charge* from the drawn bytes; return False, without a change, if there are fewer."""
        if not self._is_drawn() or self._drawn_bytes < charge:
            return False
        self._drawn_bytes -= charge
        return True

    def _draw(self, charge: int, margin: int) -> int:
        """Draw *charge* bytes and some more from the account for this process; return how many.

        Raises as `reserve`.
        """
        for _ in range(_MAX_SWAPS):
            known = self._read()
            now = self._wall_clock()
            ledger = _ledger(known)
            if ledger is None or not 0.0 <= now - ledger.counted_s < self._recount_s:
                ledger = self._recount(ledger)
            refused = self._refusal(ledger, charge, margin)
            if refused and now - ledger.counted_s >= _REFUSED_RECOUNT_SHARE * self._recount_s:
                ledger = self._recount(ledger)
                refused = self._refusal(ledger, charge, margin)
            if refused is not None:
                with contextlib.suppress(StoreError):  # the stored count saves other processes the same work
                    if ledger != _ledger(known):
                        self._store.compare_and_swap(self._name, known, _encode(ledger))
                raise refused
            free_bytes = min(self.quota_bytes() - ledger.used_bytes - margin, self._free_bytes())
            drawn = max(charge, min(_MAX_DRAWN_BYTES, int(free_bytes // _DRAWN_DIVISOR)))
            try:
                self._store.compare_and_swap(self._name, known, _encode(_with_grant(ledger, now, drawn)))
            except Conflict:
                continue
            return drawn
        raise Busy(
            f"other processes changed the account of tenant {self._tenant!r} {_MAX_SWAPS} times meanwhile",
            retry_after_ms=500.0,
        )

    def _read(self) -> bytes | None:
        try:
            return self._store.get(self._name)
        except NotFound:
            return None

    def _recount(self, before: _Ledger | None) -> _Ledger:
        """Count the bytes in the store; keep the grants whose objects may not have been written yet."""
        begun_s = self._wall_clock()
        charged = stored_by_tenant(self._store, self._folder, self._check).charged_bytes
        granted = () if before is None else before.granted
        return _Ledger(begun_s, charged, tuple(grant for grant in granted if grant[0] > begun_s - _WRITTEN_S))

    def _refusal(self, ledger: _Ledger, charge: int, margin: int) -> QuotaExceeded | StoreFull | None:
        """Return the error if *charge* bytes, with *margin* bytes left free, do not fit; None if they do."""
        used, own = ledger.used_bytes, own_quota_bytes(self._store, self._folder)
        most, name = self._settings.tenant_quota_bytes, "data.tenant_quota_bytes"
        if own is not None:
            most, name = own, "its own quota"
        if used + charge + margin > most:
            more = charge + max(0, margin)
            return QuotaExceeded(
                f"the tenant {self._tenant!r} stores {used} bytes; {more} more are above {name} {most}",
                hint="delete objects, remove old versions of maps (rse-pf map prune), or raise the quota: "
                f"rse-pf tenant quota {self._tenant} --quota data_bytes=N",
            )
        free = self._free_bytes()
        if free >= charge:
            return None
        share, held = self._share(), ledger.used_bytes
        if held + charge + margin <= share:
            return None
        return StoreFull(
            f"the disk is nearly full, and the tenant {self._tenant!r} holds {held} bytes; an equal part of "
            f"the disk is {share:.0f}",
            hint="delete objects or maps of this tenant, or use a larger disk",
        )

    def _free_bytes(self) -> float:
        """Return how many bytes of the disk are free above `_RESERVE_SHARE`; infinite for other stores."""
        if not isinstance(self._store, DirectoryStore):
            return float("inf")
        free, total = self._store.space()
        return free - int(total * _RESERVE_SHARE)

    def _share(self) -> float:
        """Return how many bytes a tenant may store while the disk is nearly full; infinite for other stores.

        The disk is divided by at least two, so that a single tenant cannot fill it.
        """
        if not isinstance(self._store, DirectoryStore):
            return float("inf")
        now = self._wall_clock()
        if 0.0 <= now - self._share_s < _DISK_SHARE_S:
            return self._share_bytes
        folders = {self._folder, *tenant_folders(self._store)}
        held = sum(stored_by_tenant(self._store, folder, self._check).charged_bytes for folder in folders)
        self._share_s, self._share_bytes = now, (held + self._store.space()[0]) / max(2, len(folders))
        return self._share_bytes


def _ledger(data: bytes | None) -> _Ledger | None:
    """Return the ledger in *data*; None without data and for damaged data, so that the caller counts."""
    with contextlib.suppress(msgspec.MsgspecError):
        return None if data is None else _decode(data)
    return None


def _with_grant(ledger: _Ledger, now: float, size: int) -> _Ledger:
    """Return *ledger* with a grant of *size* bytes at *now*.

    The grants of each period of `_RECOUNT_S` are added to one grant with the time of the period's end.
    """
    at = now // _RECOUNT_S * _RECOUNT_S + _RECOUNT_S
    before = ledger.granted
    if before and before[-1][0] == at:
        before, size = before[:-1], before[-1][1] + size
    return msgspec.structs.replace(ledger, granted=(*before, (at, size)))


def own_quota_bytes(store: ObjectStore, folder: str) -> int | None:
    """Return the quota in bytes that an operator gave to the tenant; None if the setting applies.

    *folder* is `rse_pf.identity.name_segment` of the tenant's name.

    Raises:
        StoreError: The store fails, or the stored quota is damaged.
    """
    try:
        return int(store.get(_quota_name(folder)))
    except NotFound:
        return None
    except ValueError as error:
        raise StoreError("the quota of the tenant is damaged", hint="set it: rse-pf tenant quota") from error


def set_own_quota(store: ObjectStore, folder: str, quota_bytes: int | None) -> None:
    """Give the tenant with this *folder* a quota of its own; None removes it, so that the setting applies.

    The other processes use the new quota when they draw bytes next, at most `_DRAWN_S` seconds later.
    """
    if quota_bytes is None:
        store.delete(_quota_name(folder))
    else:
        store.put(_quota_name(folder), str(quota_bytes).encode())


def _quota_name(folder: str) -> str:
    return f"quotas/{folder}"


def tenant_folders(store: ObjectStore) -> set[str]:
    """Return the folders of all tenants that have stored anything: the segments of their names."""
    return {folder for area in _OF_TENANT for folder in store.folders(f"{area}/")}


def stored_by_tenant(store: ObjectStore, folder: str, check: Callable[[], None] = lambda: None) -> Usage:
    """Count and return the usage that is charged to the tenant with this *folder*.

    *check* is called between two reads of the store; an error that it raises ends the count.
    """
    total = Usage()
    for area in _OF_TENANT:
        check()
        total += store.usage(f"{area}/{folder}/")
    for robot in store.folders(f"uploads/{folder}/"):
        total += _uploads(store, f"{folder}/{robot}/", check)
    return total


def _uploads(store: ObjectStore, folder: str, check: Callable[[], None]) -> Usage:
    """Return the usage of the unfinished uploads of a robot, each with its final size.

    *folder* is that of the robot, and ends with a slash.
    """
    total = Usage()
    for upload in store.folders(f"uploads/{folder}"):
        check()
        with contextlib.suppress(NotFound):  # the upload has just been completed
            total += Usage(1, charge_of(int(store.get(f"uploads/{folder}{upload}/size").split()[0])))
    return total


def charge_name(robot: RobotId, map_name: str, version: str, size: int) -> str:
    """Return the name of the empty object by which a version of a map is charged to *robot*.

    Args:
        robot: The robot that committed the version.
        map_name: Name of the map.
        version: Id of the version.
        size: Bytes that the version added to the store.
    """
    return f"charges/{robot.folder}/{map_name}/{version}.{size}"


def sum_charges(store: ObjectStore, robot: RobotId, check: Callable[[], None] = lambda: None) -> Usage:
    """Return the number and the bytes of all versions of maps that are charged to *robot*.

    Args:
        store: The store of the maps.
        robot: The robot.
        check: Called for each version; an error that it raises ends the count.
    """
    objects = charged_bytes = 0
    for info in store.list(f"charges/{robot.folder}/"):
        check()
        objects += 1
        charged_bytes += charge_of(int(info.name.rpartition(".")[2]))
    return Usage(objects, charged_bytes)


def remove_charges(store: ObjectStore, tenant: str, map_name: str, versions: Collection[str]) -> None:
    """Delete the objects by which *versions* of a map are charged to robots.

    Args:
        store: The store of the maps.
        tenant: Folder of the tenant.
        map_name: Name of the map.
        versions: Ids of the versions that are not charged any more.
    """
    for robot in store.folders(f"charges/{tenant}/"):
        prefix = f"charges/{tenant}/{robot}/{map_name}/"
        for info in store.list(prefix):
            if info.name.removeprefix(prefix).partition(".")[0] in versions:
                store.delete(info.name)


@dataclass(slots=True)
class _RobotAccount:
    """The account of one robot in this process; *lock* guards the other fields.

    *stored* is the usage that was counted at *counted_s* (monotonic seconds), with what this process has
    stored since; *writing* is the usage of objects that this process writes now.
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    counted_s: float = _NEVER
    stored: Usage = field(default_factory=Usage)
    writing: Usage = field(default_factory=Usage)


class Accounts:
    """The accounts of all robots and tenants in one process.

    The methods block; several threads may call them.
    """

    def __init__(
        self,
        store: ObjectStore,
        settings: DataSettings,
        *,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Create empty accounts; nothing is counted yet.

        Args:
            store: The store of the platform.
            settings: Hold the quotas of robots and tenants that have no quota of their own.
            clock: Returns monotonic seconds.
            wall_clock: Returns Unix seconds.
            check: Called between two reads of the store; an error that it raises ends the count.
        """
        self._store, self._settings = store, settings
        self._clock, self._wall_clock, self._check = clock, wall_clock, check
        self._recount_s = _recount_s(store)
        self._lock = threading.Lock()  # guards the dictionaries; never held while the store is read
        self._robots: OrderedDict[RobotId, _RobotAccount] = OrderedDict()
        self._tenants: OrderedDict[str, TenantAccount] = OrderedDict()

    @contextlib.contextmanager
    def reservation(self, robot: RobotId, size: int, max_bytes: float | None = None) -> Iterator[None]:
        """Charge one object of *size* bytes to a robot and its tenant while the body writes it.

        If the body raises an error, the charge is taken back.

        Args:
            robot: The robot that stores the object.
            size: Size of the object.
            max_bytes: Own quota of the robot; None means ``data.quota_bytes``.

        Raises:
            QuotaExceeded: The robot or its tenant would store more than its quota, or the robot would have
                more than ``data.max_objects``.
            StoreFull: As for `TenantAccount.reserve`.
        """
        account, charge = self._account(robot), Usage(1, charge_of(size))
        tenant = self.tenant(robot.tenant)
        with account.lock:
            self._count_if_old(account, robot)
            self._check_robot(robot, account.stored + account.writing, charge, max_bytes)
            account.writing += charge
            counted_s = account.counted_s
        is_stored = is_charged = False
        try:
            tenant.reserve(size)
            is_charged = True
            yield
            is_stored = True
        finally:
            if is_charged and not is_stored:
                tenant.release(size)
            with account.lock:
                account.writing = _subtract(account.writing, charge)
                if account.counted_s != counted_s:
                    account.counted_s = _NEVER  # a count meanwhile may have included the object, or not
                elif is_stored:
                    account.stored += charge

    def check_room(self, robot: RobotId, size: int, max_bytes: float | None = None) -> None:
        """Raise QuotaExceeded if the robot's own limits do not allow one more object of *size* bytes.

        Nothing is reserved, and the account of the tenant is not checked.
        """
        account = self._account(robot)
        with account.lock:
            self._count_if_old(account, robot)
            used, charge = account.stored + account.writing, Usage(1, charge_of(size))
            self._check_robot(robot, used, charge, max_bytes)

    def release(self, robot: RobotId, size: int) -> None:
        """Take back the charge of one object of *size* bytes, which was removed, for robot and tenant."""
        account = self._account(robot)
        with account.lock:
            account.stored = _subtract(account.stored, Usage(1, charge_of(size)))
        self.tenant(robot.tenant).release(size)

    def forget(self, robot: RobotId) -> None:
        """Forget the count of *robot*: its objects are counted again when it stores one next."""
        account = self._account(robot)
        with account.lock:
            account.counted_s = _NEVER

    def forget_all(self, tenant: str) -> None:
        """Forget the counts of all robots of *tenant*, as `forget` does."""
        with self._lock:
            robots = [robot for robot in self._robots if robot.tenant == tenant]
        for robot in robots:
            self.forget(robot)

    def tenant(self, tenant: str) -> TenantAccount:
        """Return the account of *tenant* in this process; make one if there is none."""
        return self._get_or_make(
            self._tenants, tenant,
            lambda: TenantAccount(
                self._store, tenant, self._settings, wall_clock=self._wall_clock, check=self._check
            ),
        )  # fmt: skip

    def _account(self, robot: RobotId) -> _RobotAccount:
        return self._get_or_make(self._robots, robot, _RobotAccount)

    def _get_or_make(self, accounts: OrderedDict[_K, _T], key: _K, make: Callable[[], _T]) -> _T:
        with self._lock:
            account = accounts.get(key)
            if account is None:
                account = accounts[key] = make()
            accounts.move_to_end(key)
            if len(accounts) > _MAX_ACCOUNTS:
                accounts.popitem(last=False)
            return account

    def _count_if_old(self, account: _RobotAccount, robot: RobotId) -> None:
        """Count the usage of *robot* in the store, if the last count is older than `_recount_s` allows."""
        now = self._clock()
        if now - account.counted_s >= self._recount_s:
            total = self._store.usage(f"objects/{robot.folder}/")
            total += _uploads(self._store, f"{robot.folder}/", self._check)
            account.stored = total + sum_charges(self._store, robot, self._check)
            account.counted_s = now

    def _check_robot(self, robot: RobotId, used: Usage, charge: Usage, max_bytes: float | None) -> None:
        """Raise QuotaExceeded if *robot*, which uses *used*, may not store *charge* more."""
        most, name = self._settings.quota_bytes, "data.quota_bytes"
        if max_bytes is not None:
            most, name = int(max_bytes), "its own quota"
        if used.objects + charge.objects > self._settings.max_objects:
            raise QuotaExceeded(
                f"this robot has {used.objects} objects, the limit is {self._settings.max_objects}",
                hint="delete objects, or raise data.max_objects",
            )
        if used.charged_bytes + charge.charged_bytes > most:
            raise QuotaExceeded(
                f"this robot stores {used.charged_bytes} bytes; {charge.charged_bytes} more are above {name} "
                f"{most}; a short object counts as {MIN_CHARGE_BYTES}",
                hint=f"delete objects, or raise the quota: rse-pf robot quota {robot.name} "
                f"--tenant {robot.tenant} --quota data_bytes=N",
            )


def _recount_s(store: ObjectStore) -> float:
    """Return the seconds between two counts of a store of this type."""
    return _RECOUNT_S if isinstance(store, DirectoryStore) else _SLOW_RECOUNT_S


def _subtract(usage: Usage, charge: Usage) -> Usage:
    """Return *usage* less *charge*, but not below 0."""
    return Usage(max(0, usage.objects - charge.objects), max(0, usage.charged_bytes - charge.charged_bytes))
