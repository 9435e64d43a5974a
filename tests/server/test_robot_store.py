"""What services make for a robot counts as what it stores itself."""

from __future__ import annotations

import pytest

from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings, PlatformSettings
from rse_pf.errors import QuotaExceeded
from rse_pf.identity import RobotId, object_name
from rse_pf.server.jobs.process import JobRequest, store_reply
from rse_pf.server.object_refs import ObjectRefs
from rse_pf.server.robot_store import store_within_quota
from rse_pf.storage.object_store import DirectoryStore, MemoryStore
from rse_pf.storage.quotas import Accounts, charge_name
from rse_pf.wire import Failure, Result

ROBOT = RobotId("default", "robot-1")

REQUEST = JobRequest(service="long", payload={}, robot=ROBOT, key="k", quota_bytes=4100.0)


def of(store: str, max_message_bytes: int = 2000) -> PlatformSettings:
    return PlatformSettings.from_dict(
        {
            "data": {"store": store, "max_object_bytes": 4900},
            "session": {"max_message_bytes": max_message_bytes},
        }
    )


ROBOT = RobotId("default", "robot-1")


def claims(**quotas: float) -> Claims:
    return Claims(
        robot=ROBOT, token_id="t", issued_s=0.0, expires_s=1.0, key_id="k", quotas=tuple(quotas.items())
    )


def accounts(store: MemoryStore) -> Accounts:
    return Accounts(store, DataSettings())


def test_an_object_that_fits_exactly_is_stored_and_one_byte_more_is_not():
    store = MemoryStore()
    store.put(object_name(RobotId("default", "robot-2"), "other"), bytes(50_000))
    store.put(object_name(ROBOT, "own"), bytes(6000))

    with pytest.raises(QuotaExceeded):
        store_within_quota(store, accounts(store), ROBOT, bytes(4001), 10_000)
    with pytest.raises(QuotaExceeded):
        store_within_quota(store, accounts(store), ROBOT, bytes(5001), 11_000)
    digest = store_within_quota(store, accounts(store), ROBOT, bytes(5000), 11_000)

    assert store.get(object_name(ROBOT, digest)) == bytes(5000)
    assert store_within_quota(store, accounts(store), ROBOT, bytes(5000), 11_000) == digest
    with pytest.raises(QuotaExceeded):
        accounts(store).check_room(ROBOT, 1, 11_000)


def test_short_objects_and_committed_maps_count():
    store = MemoryStore()
    store.put(object_name(ROBOT, "own"), b"x")
    store.put(charge_name(ROBOT, "kitchen", "a" * 64, 5000), b"")
    store.put(charge_name(RobotId("default", "robot-2"), "kitchen", "b" * 64, 5000), b"")

    accounts(store).check_room(ROBOT, 1, 4096 + 5000 + 4096)
    with pytest.raises(QuotaExceeded, match="9096"):
        accounts(store).check_room(ROBOT, 1, 4096 + 5000 + 4095)


def test_a_large_reply_beyond_the_quota_is_refused_with_the_reason():
    store = MemoryStore()
    gate = ObjectRefs(store, DataSettings(quota_bytes=4000))
    answer, sent = Result(id=1, reply=bytes(500)), Failure(id=1, code="too-large", message="too large")

    refused = gate.store_large_reply(answer, sent, ROBOT, None)
    stored = gate.store_large_reply(answer, sent, ROBOT, claims(data_bytes=5000.0))

    assert isinstance(refused, Failure)
    assert (refused.id, refused.code) == (1, "quota")
    assert isinstance(stored, Result)
    assert [info.name for info in store.list("objects/")] == [object_name(ROBOT, stored.object)]


def test_a_jobs_process_refuses_what_is_too_large_or_beyond_the_quota(tmp_path):
    settings = of(f"dir:{tmp_path}")

    assert store_reply(["done", 5.0, bytes(5000)], REQUEST, settings)[:2] == ["failed", "too-large"]
    assert store_reply(["done", 5.0, bytes(4101)], REQUEST, settings)[:2] == ["failed", "quota"]
    assert list(DirectoryStore(tmp_path).list()) == []
