"""The queue of jobs that wait: objects of the store, from which job servers take them.

A server offers a job before it waits for a slot of its own; the first with a free slot takes the job's
lease.  An offer is no lease: the same offer may be read by many, and the lease decides.  It stays until the
job has an outcome, so that a job whose server died is found again.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.accounts import Accounts
from rse_pf.backend.jobs.lease import decode_record, record_name
from rse_pf.backend.jobs.process import JobRequest
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, NotFound, RsePfError, StoreError
from rse_pf.identity import RobotId
from rse_pf.object_store import ObjectStore
from rse_pf.wire.arrays import binary_encode_hook, extension_hook

__all__ = ["JobOffer", "JobQueue", "has_jobs", "interleave", "settings_digest_of"]

_PREFIX = "job-queue/"
_MAX_NAMES = 10_000
"""Offers that take turns; those after them in the order of names wait until some of these are gone."""
_MAX_READ = 200
"""Offers that are read, or whose records are counted, at once."""


class _Stored(msgspec.Struct, frozen=True, kw_only=True):
    service: str
    payload: msgspec.Raw
    robot: tuple[str, str, str]
    key: str
    quota_bytes: float
    trace: str = ""
    settings: str


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOffer:
    """A job that waits, and the digest of the settings on which its result depends."""

    request: JobRequest
    settings: str


def has_jobs(settings: PlatformSettings) -> bool:
    """Return whether long services are on: they run here, or job servers run them."""
    return settings.serving.max_running_jobs > 0 or settings.serving.offer_jobs


def settings_digest_of(settings: PlatformSettings) -> str:
    """Return the digest of the settings that the result of a job depends on."""
    plain = settings.to_dict()
    chosen = json.dumps([plain["services"], plain["pnp"]], sort_keys=True)
    return hashlib.sha256(chosen.encode()).hexdigest()


def interleave(names: Sequence[str], served: Mapping[str, int]) -> list[str]:
    """Return *names*, ``job-queue/TENANT/ROBOT/KEY``: one of each robot, then the second of each, and so on.

    A robot that was served longer ago comes first.
    """
    of_folder: dict[str, list[str]] = {}
    for name in names:
        of_folder.setdefault(name.removeprefix(_PREFIX).rpartition("/")[0], []).append(name)
    folders = sorted(of_folder, key=lambda folder: (served.get(folder, 0), folder))
    rounds = max(map(len, of_folder.values()), default=0)
    return [
        of_folder[folder][turn]
        for turn in range(rounds)
        for folder in folders
        if turn < len(of_folder[folder])
    ]


class JobQueue:
    """The jobs that wait in one store."""

    def __init__(
        self,
        store: ObjectStore,
        settings: PlatformSettings,
        on_damaged: Callable[[str], None] = lambda name: None,
    ) -> None:
        """Read nothing yet.

        Args:
            store: Shared by all servers.
            settings: Those of this server.
            on_damaged: Called once with the name of an object that is no offer.
        """
        self._store = store
        self._on_damaged = on_damaged
        self._others: set[str] = set()
        self._damaged: set[str] = set()
        self._settings = settings_digest_of(settings)
        self._accounts = Accounts(store, settings.data)

    def offer(self, request: JobRequest) -> None:
        """Store that *request* waits; again is no error.

        Raises:
            BadRequest: The payload cannot be encoded.
            QuotaExceeded: The robot's tenant stores too much.
            StoreError: The store failed, or is full.
        """
        name = _name(request.robot, request.key)
        try:
            payload = msgspec.msgpack.encode(request.payload, enc_hook=binary_encode_hook)
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise BadRequest(
                "the request cannot be encoded", hint="send numbers, strings and lists"
            ) from error
        stored = _Stored(
            service=request.service, payload=msgspec.Raw(payload),
            robot=(request.robot.tenant, request.robot.name, request.robot.enrolment),
            key=request.key, quota_bytes=request.quota_bytes, settings=self._settings, trace=request.trace,
        )  # fmt: skip
        data = msgspec.msgpack.encode(stored)
        self._accounts.tenant(request.robot.tenant).reserve(len(data))
        self._store.put(name, data)

    def withdraw(self, request: JobRequest) -> None:
        """Remove the offer of *request*, if there is one."""
        self._store.delete(_name(request.robot, request.key))

    def offers(self, served: Mapping[str, int] | None = None) -> Iterator[JobOffer]:
        """Yield the jobs that servers with the same settings offer, so that robots take turns.

        An object that is no offer is skipped.

        Args:
            served: When each robot's folder was served last, as a number that grows.

        Raises:
            StoreError: The store failed.
        """
        names = self._names(_MAX_NAMES)
        self._others.intersection_update(names)
        self._damaged.intersection_update(names)
        ours = [name for name in interleave(names, served or {}) if name not in self._others]
        for name in ours[:_MAX_READ]:
            offer = self._read(name)
            if offer is not None and offer.settings == self._settings:
                yield offer
            elif offer is not None:
                self._others.add(name)  # its key depends on the settings, so it stays one of others

    def waiting(self) -> int:
        """Return how many of the first 200 offered jobs run nowhere; raises StoreError."""
        return sum(not self._is_running(name) for name in self._names(_MAX_READ))

    def _names(self, most: int) -> list[str]:
        return [info.name for info in itertools.islice(self._store.list(_PREFIX), most)]

    def _read(self, name: str) -> JobOffer | None:
        """Return the offer *name*; None if it was withdrawn meanwhile, or is damaged."""
        try:
            data = self._store.get(name)
        except NotFound:
            return None
        try:
            stored = msgspec.msgpack.decode(data, type=_Stored)
            payload: Any = msgspec.msgpack.decode(stored.payload, ext_hook=extension_hook)
            request = JobRequest(
                service=stored.service, payload=payload, robot=RobotId(*stored.robot), key=stored.key,
                quota_bytes=stored.quota_bytes, trace=stored.trace,
            )  # fmt: skip
        except (msgspec.MsgspecError, RsePfError, TypeError, ValueError):
            if name not in self._damaged:
                self._damaged.add(name)
                self._on_damaged(name)
            return None
        return JobOffer(request=request, settings=stored.settings)

    def _is_running(self, name: str) -> bool:
        record = f"jobs/{name.removeprefix(_PREFIX)}"
        try:
            data = self._store.get(record)
        except NotFound:
            return False
        try:
            return decode_record(record, data).state == "running"
        except StoreError:  # it is no record: nobody runs the job
            return False


def _name(robot: RobotId, key: str) -> str:
    return f"{_PREFIX}{record_name(robot, key).partition('/')[2]}"
