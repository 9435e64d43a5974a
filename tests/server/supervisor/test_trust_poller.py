"""What the supervisor learns from the access control store reaches every worker."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import TrustStore
from rse_pf.server.supervisor.orders import TrustOrder, WorkerOrder
from rse_pf.server.supervisor.trust_poller import update_workers
from tests.kit.fakes import FakeLog

KEYS = SigningKey.from_seed(b"t" * 32, "k1").key_set()
OTHER_KEYS = SigningKey.from_seed(b"o" * 32, "k2").key_set()


class Worker:
    def __init__(self) -> None:
        self.orders: list[WorkerOrder] = []

    def order(self, order: WorkerOrder) -> None:
        self.orders.append(order)


def loaded(folder: Path) -> tuple[TrustStore, list[Worker], FakeLog]:
    (folder / "keys.json").write_text(KEYS.to_json())
    trust, workers, log = TrustStore(folder / "keys.json"), [Worker(), Worker()], FakeLog()
    trust.load()
    return trust, workers, log


def test_what_is_new_goes_to_every_worker(tmp_path: Path) -> None:
    trust, workers, log = loaded(tmp_path)
    asyncio.run(update_workers(trust, workers, log))
    assert [worker.orders for worker in workers] == [[], []]

    (tmp_path / "keys.json").write_text(OTHER_KEYS.to_json())
    asyncio.run(update_workers(trust, workers, log))

    assert [worker.orders for worker in workers] == 2 * [[TrustOrder(trust.snapshot)]]
    assert json.loads(trust.snapshot)["keys"]


def test_a_problem_is_logged_once_and_changes_nothing(tmp_path: Path) -> None:
    trust, workers, log = loaded(tmp_path)
    (tmp_path / "keys.json").unlink()

    for _ in range(2):
        asyncio.run(update_workers(trust, workers, log))

    assert log.names().count("access-control-unread") == 1
    assert [worker.orders for worker in workers] == [[], []]
