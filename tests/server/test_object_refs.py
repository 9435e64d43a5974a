"""Names of objects in a payload become the robot's own bytes, and nobody else's."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, LimitExceeded, NotFound, StoreError
from rse_pf.identity import RobotId, object_name
from rse_pf.server.object_refs import resolve
from rse_pf.storage.object_store import MemoryStore, ObjectInfo, digest_of
from tests.kit.fake_store import FakeStore


class Counting(MemoryStore):
    """A store that counts what is asked of it."""

    def __init__(self) -> None:
        super().__init__()
        self.heads = self.gets = 0

    def head(self, name: str) -> ObjectInfo:
        self.heads += 1
        return ObjectInfo(name=name, size=len(super().get(name)))

    def get(self, name: str) -> bytes:
        self.gets += 1
        return super().get(name)


ROBOT = RobotId("lab", "robot-1")
SERVING = PlatformSettings().serving
MAP, OTHER = b"a map" * 400, b"another"


class Part(msgspec.Struct):
    """A struct inside."""

    data: bytes | None = None
    name: str = ""


class Asked(msgspec.Struct):
    """Bytes in every place that they can have."""

    one: bytes = b""
    many: list[bytes] = []
    named: dict[str, bytes] = {}
    part: Part | None = None
    free: Any = None


@pytest.fixture
def store() -> FakeStore:
    """What robot-1 of the tenant lab has stored: two objects."""
    made = FakeStore()
    for data in (MAP, OTHER):
        made.put(object_name(ROBOT, digest_of(data)), data)
    made.calls.clear()
    return made


def name(data: bytes) -> dict[str, str]:
    return {"object": digest_of(data)}


def resolved(payload: Any, store: MemoryStore, kind: type[Any] = Asked, *, robot: RobotId = ROBOT) -> Any:
    return resolve(kind, payload, robot, store)


def test_references_become_bytes_wherever_the_request_declares_bytes(store: FakeStore) -> None:
    payload = {
        "one": name(MAP),
        "many": [b"inline", name(OTHER)],
        "named": {"left": name(MAP)},
        "part": {"data": name(OTHER), "name": "x"},
    }

    found = msgspec.convert(resolved(payload, store), Asked)

    assert found == Asked(
        one=MAP, many=[b"inline", OTHER], named={"left": MAP}, part=Part(data=OTHER, name="x")
    )
    assert payload["one"] == name(MAP), "the payload of the robot is not changed"


@pytest.mark.parametrize(("tenant", "robot"), [("lab", "robot-2"), ("other", "robot-1")])
def test_an_object_of_another_robot_is_reported_as_missing(store: FakeStore, tenant: str, robot: str) -> None:
    with pytest.raises(NotFound) as foreign:
        resolved({"one": name(MAP)}, store, robot=RobotId(tenant, robot))
    with pytest.raises(NotFound) as missing:
        resolved({"one": name(MAP)}, MemoryStore())

    assert (foreign.value.message, foreign.value.hint) == (missing.value.message, missing.value.hint)


@pytest.mark.parametrize(
    "wrong",
    [
        {"object": "../robot-2/" + digest_of(MAP)}, {"object": digest_of(MAP).upper()}, {"object": 7},
        {"object": digest_of(MAP) + "\n"}, {"object": digest_of(MAP), "robot": "robot-2"},
    ],
)  # fmt: skip
def test_a_reference_that_is_no_digest_is_refused(store: FakeStore, wrong: dict[str, Any]) -> None:
    with pytest.raises(BadRequest):
        resolved({"one": wrong}, store)

    assert store.calls["head"] == store.calls["get"] == 0


@pytest.mark.parametrize(("objects", "limit_bytes", "reads"), [(1, 4 * len(MAP), 0), (2, len(MAP), 2)])
def test_more_than_a_command_may_refer_to_is_refused_before_it_is_read(
    store: FakeStore, objects: int, limit_bytes: int, reads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rse_pf.server.object_refs.MAX_OBJECTS_PER_COMMAND", objects)
    monkeypatch.setattr("rse_pf.server.object_refs.MAX_OBJECT_BYTES_PER_COMMAND", limit_bytes)
    payload = {"many": [name(MAP), name(OTHER)]}

    with pytest.raises(LimitExceeded):
        resolve(Asked, payload, ROBOT, store)

    assert (store.calls["head"], store.calls["get"]) == (reads, 0)


def test_an_object_that_changed_in_the_store_reaches_no_service(store: Counting) -> None:
    store.put(object_name(ROBOT, digest_of(MAP)), b"rotten")

    with pytest.raises(StoreError, match="digest"):
        resolved({"one": name(MAP)}, store)
