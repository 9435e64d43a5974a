"""How much a robot may store: its objects, its unfinished uploads and the map versions that it committed.

What a robot has stored is counted when it first writes, and then kept by this ledger.  Other processes write
for it, too: another data server, or a worker that stores a large reply.  So the ledger counts again: in a
folder every `_RECOUNT_S`, reading only what changed, and in other stores every `_SLOW_RECOUNT_S`.  Of n data
servers with one store, all together can exceed a quota by at most what n - 1 of them accept in that time.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings
from rse_pf.data_server.fair_threads import check_wanted, while_wanted
from rse_pf.errors import NotFound, QuotaExceeded
from rse_pf.identity import RobotId
from rse_pf.maps.charges import charged_to
from rse_pf.object_store import MeasuringStore, ObjectStore, Usage, charge_of, usage_of

__all__ = ["QuotaLedger"]

_RECOUNT_S, _SLOW_RECOUNT_S = 10.0, 600.0
_MAX_ACCOUNTS = 10_000
_NEVER = float("-inf")


@dataclass(slots=True)
class _Account:
    """What is known about one robot; *lock* guards the rest."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    counted_s: float = _NEVER
    stored: Usage = field(default_factory=Usage)
    writing: Usage = field(default_factory=Usage)


class QuotaLedger:
    """The usage of all robots, as one data server sees it.  Blocking; used by several threads."""

    def __init__(self, store: ObjectStore, settings: DataSettings, clock: Callable[[], float]) -> None:
        self._store = store
        self._settings = settings
        self._clock = clock
        self._recount_s = _RECOUNT_S if isinstance(store, MeasuringStore) else _SLOW_RECOUNT_S
        self._lock = threading.Lock()  # of the dictionary, never held during work
        self._accounts: OrderedDict[RobotId, _Account] = OrderedDict()

    @contextlib.contextmanager
    def reserved(self, claims: Claims, size: int) -> Iterator[None]:
        """Count one object of *size* bytes for a robot while it is written; take it back if that fails.

        Raises:
            QuotaExceeded: The robot would store more than its quota, or more objects than it may.
        """
        account, charge = self._account(claims.robot), Usage(1, charge_of(size))
        with account.lock:
            self._count_if_old(account, claims.robot)
            self._check(account.stored + account.writing, charge, claims)
            account.writing += charge
            counted_s = account.counted_s
        is_stored = False
        try:
            yield
            is_stored = True
        finally:
            with account.lock:
                account.writing = _less(account.writing, charge)
                if account.counted_s != counted_s:
                    account.counted_s = _NEVER  # a count meanwhile may have seen the object, or not
                elif is_stored:
                    account.stored += charge

    def release(self, robot: RobotId, size: int) -> None:
        """Count one object of *size* bytes less."""
        account = self._account(robot)
        with account.lock:
            account.stored = _less(account.stored, Usage(1, charge_of(size)))

    def forget(self, robot: RobotId) -> None:
        """Count the robot's objects anew when it writes next."""
        account = self._account(robot)
        with account.lock:
            account.counted_s = _NEVER

    def _account(self, robot: RobotId) -> _Account:
        with self._lock:
            account = self._accounts.setdefault(robot, _Account())
            self._accounts.move_to_end(robot)
            if len(self._accounts) > _MAX_ACCOUNTS:
                self._accounts.popitem(last=False)
            return account

    def _count_if_old(self, account: _Account, robot: RobotId) -> None:
        now = self._clock()
        if now - account.counted_s >= self._recount_s:
            account.stored = self._count(robot)
            account.counted_s = now

    def _count(self, robot: RobotId) -> Usage:
        folder = f"{robot.folder}/"
        total = usage_of(self._store, f"objects/{folder}")
        for upload in while_wanted(self._store.folders(f"uploads/{folder}")):
            with contextlib.suppress(NotFound):  # it has just been completed
                size = int(self._store.get(f"uploads/{folder}{upload}/size").split()[0])
                total += Usage(1, charge_of(size))
        return total + charged_to(self._store, robot, check_wanted)

    def _check(self, used: Usage, charge: Usage, claims: Claims) -> None:
        max_bytes = claims.quota("data_bytes") or self._settings.quota_bytes
        if used.objects + charge.objects > self._settings.max_objects:
            raise QuotaExceeded(
                f"this robot has {used.objects} objects, the limit is {self._settings.max_objects}",
                hint="delete objects, or raise data.max_objects",
            )
        if used.charged_bytes + charge.charged_bytes > max_bytes:
            raise QuotaExceeded(
                f"{used.charged_bytes} + {charge.charged_bytes} bytes are more than the quota of "
                f"{max_bytes:.0f}; a short object counts as 4096",
                hint="delete objects, or raise data.quota_bytes",
            )


def _less(usage: Usage, charge: Usage) -> Usage:
    return Usage(max(0, usage.objects - charge.objects), max(0, usage.charged_bytes - charge.charged_bytes))
