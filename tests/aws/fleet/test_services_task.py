"""The task that follows the list of published services: what it refuses, and where it does nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.task import Task
from rse_pf.aws.fleet.tasks import services
from rse_pf.services.custom.publishing import LIST_NAME, PublishedList, PublishedService, archive_name
from rse_pf.storage.object_store import MemoryStore
from tests.kit.fake_machine import FakeMachine, agent_context


class Setup:
    """The task of an instance of *group*, and what it logged."""

    def __init__(self, folder: Path, group: str = "rse-pf") -> None:
        self.machine, self.store = FakeMachine(), MemoryStore()
        self.log: list[tuple[str, dict[str, Any]]] = []
        self.context = agent_context(
            self.machine, folder, group=group, artifacts=self.store,
            log=lambda event, **fields: self.log.append((event, fields)),
        )  # fmt: skip
        self.agent = Agent(self.context, (services.task,))

    def attempt(self) -> None:
        self.agent.attempt("services")


def test_an_archive_of_another_size_than_the_list_says_is_refused_before_it_is_read(tmp_path: Path) -> None:
    setup, digest = Setup(tmp_path), "ab" * 32
    entry = PublishedService(
        name="adder", language="lua", archive=digest, size=3, identity="", published_s=0.0
    )
    setup.store.put(LIST_NAME, msgspec.json.encode(PublishedList(services=(entry,))))
    setup.store.put(archive_name(digest), b"more than three")

    setup.attempt()

    assert "the list says 3" in setup.log[0][1]["error"]


def test_a_defect_of_a_task_is_logged_and_the_task_is_repeated(tmp_path: Path) -> None:
    setup, calls = Setup(tmp_path), []

    def broken() -> None:
        calls.append(1)
        raise ValueError("a defect")

    agent = Agent(setup.context, (lambda context: Task(name="broken", period_s=0.0, call=broken),))

    agent.step()
    agent.step()

    assert len(calls) == 2
    assert setup.log[0] == ("failed", {"task": "broken", "error": "ValueError('a defect')"})
