"""What a process of limited services does with one command; here without a process."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import LimitExceeded, MissingExtra
from rse_pf.identity import RobotId, object_name
from rse_pf.server.compute.process import configuration_of, decode_reply, encode_request, make_handler
from rse_pf.service import Registry
from rse_pf.storage.object_store import digest_of, open_store
from rse_pf.wire import Command, Failure, Result

ALICE, BOB = RobotId("default", "alice"), RobotId("default", "bob")
warmed: list[str] = []


class Work(msgspec.Struct, frozen=True, kw_only=True):
    what: str = ""
    map: bytes = b""


class Done(msgspec.Struct, frozen=True, kw_only=True):
    size: int = 0
    filling: str = ""
    odd: Any = None


def make(settings: PlatformSettings) -> Registry:
    registry = Registry()

    def warm_up() -> None:
        warmed.append("work")
        raise MissingExtra("small_gicp", "maps")

    @registry.service("work", limited=True, warm_up=warm_up)
    def work(request: Work) -> Done:
        if request.what == "memory":
            raise MemoryError
        if request.what == "defect":
            raise ZeroDivisionError("secret")
        if request.what == "refuse":
            raise LimitExceeded("too much", hint="send less")
        if request.what == "odd":
            return Done(odd=object())
        return Done(size=len(request.map), filling="x" * (1 << 21) if request.what == "long" else "")

    return registry


Ask = Callable[..., tuple[Result | Failure, str]]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ask:
    """Return a function that sends a payload of a robot through the handler of a store with one object."""
    module = types.ModuleType("made_in_this_test")
    module.make = make  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "made_in_this_test", module)
    settings = PlatformSettings().replace(data={"store": f"dir:{tmp_path}"})
    open_store(f"dir:{tmp_path}").put(object_name(ALICE, digest_of(b"a map")), b"a map")
    warmed.clear()
    handle = make_handler(configuration_of("made_in_this_test:make", settings))

    def send(payload: dict[str, Any], robot: RobotId = ALICE) -> tuple[Result | Failure, str]:
        command = Command(id=5, service="work", payload=payload, trace="t")
        return decode_reply(handle(encode_request(command, robot)), command, server="s-1")

    return send


def test_it_reads_the_objects_of_its_robot_and_of_no_other(ask: Ask):
    named = {"map": {"object": digest_of(b"a map")}}

    mine, _ = ask(named)
    of_another, _ = ask(named, BOB)

    assert isinstance(mine, Result)
    assert (mine.id, mine.server, mine.reply["size"]) == (5, "s-1", 5)
    assert isinstance(of_another, Failure)
    assert of_another.code == "not-found"


@pytest.mark.parametrize("what", ["defect", "odd"])
def test_a_defect_goes_to_the_log_and_not_to_the_robot(ask: Ask, what: str):
    answer, defect = ask({"what": what})

    assert isinstance(answer, Failure)
    assert answer.code == "internal"
    assert "secret" not in answer.message
    assert defect


def test_a_service_without_memory_ends_the_process(ask: Ask):
    with pytest.raises(MemoryError):
        ask({"what": "memory"})
