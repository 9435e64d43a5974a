"""Names of objects in a payload become the robot's own bytes, and nobody else's."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rse_pf.config import DataSettings, PlatformSettings
from rse_pf.errors import BadRequest, LimitExceeded, NotFound, RsePfError, StoreError
from rse_pf.identity import RobotId, object_name
from rse_pf.server.object_refs import ObjectRefs, named_in, resolve, takes_objects
from rse_pf.service import Registry
from rse_pf.services.mapping.localise import LocaliseRequest
from rse_pf.services.mapping.merge import MergeRequest
from rse_pf.services.pnp import PnpRequest
from rse_pf.storage.object_store import MemoryStore, ObjectInfo, digest_of
from rse_pf.wire import Command

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


@pytest.fixture
def store() -> Counting:
    """What robot-1 of the tenant lab has stored: two objects."""
    made = Counting()
    for data in (MAP, OTHER):
        made.put(object_name(ROBOT, digest_of(data)), data)
    return made


def name(data: bytes) -> dict[str, str]:
    return {"object": digest_of(data)}


def resolved(payload: Any, store: MemoryStore, kind: type[Any] = Asked, *, robot: RobotId = ROBOT) -> Any:
    return resolve(kind, payload, robot, store)


def test_references_become_bytes_wherever_the_request_declares_bytes(store: Counting) -> None:
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


def test_a_reference_elsewhere_stays_data(store: Counting) -> None:
    payload = {"free": name(MAP), "part": {"name": name(MAP)}}

    assert resolved(payload, store) == payload
    assert store.heads == store.gets == 0


def test_each_object_is_read_once_however_often_it_is_referred_to(store: Counting) -> None:
    found = resolved({"many": [name(MAP)] * 200}, store)

    assert found["many"] == [MAP] * 200
    assert (store.heads, store.gets) == (1, 1)


@pytest.mark.parametrize(("tenant", "robot"), [("lab", "robot-2"), ("other", "robot-1")])
def test_an_object_of_another_robot_is_reported_as_missing(store: Counting, tenant: str, robot: str) -> None:
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
def test_a_reference_that_is_no_digest_is_refused(store: Counting, wrong: dict[str, Any]) -> None:
    with pytest.raises(BadRequest):
        resolved({"one": wrong}, store)

    assert store.heads == store.gets == 0


@pytest.mark.parametrize(("objects", "limit_bytes", "reads"), [(1, 4 * len(MAP), 0), (2, len(MAP), 2)])
def test_more_than_a_command_may_refer_to_is_refused_before_it_is_read(
    store: Counting, objects: int, limit_bytes: int, reads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rse_pf.server.object_refs.MAX_OBJECTS_PER_COMMAND", objects)
    monkeypatch.setattr("rse_pf.server.object_refs.MAX_OBJECT_BYTES_PER_COMMAND", limit_bytes)
    payload = {"many": [name(MAP), name(OTHER)]}

    with pytest.raises(LimitExceeded):
        resolve(Asked, payload, ROBOT, store)

    assert (store.heads, store.gets) == (reads, 0)


def test_an_object_that_changed_in_the_store_reaches_no_service(store: Counting) -> None:
    store.put(object_name(ROBOT, digest_of(MAP)), b"rotten")

    with pytest.raises(StoreError, match="digest"):
        resolved({"one": name(MAP)}, store)


def test_a_store_that_fails_is_a_typed_failure() -> None:
    class Broken(MemoryStore):
        def head(self, name: str) -> ObjectInfo:
            raise StoreError("no answer")

    with pytest.raises(RsePfError, match="no answer"):
        resolved({"one": name(MAP)}, Broken())


def test_the_map_services_take_objects_and_pnp_takes_none(store: Counting) -> None:
    assert resolved({"maps": [name(MAP), name(OTHER)]}, store, MergeRequest)["maps"] == [MAP, OTHER]
    assert named_in(LocaliseRequest, {"map": name(MAP)}) == [digest_of(MAP)]
    assert not takes_objects(PnpRequest)


def test_an_invalid_payload_is_left_to_the_service_to_refuse(store: Counting) -> None:
    gate, registry = ObjectRefs(store, DataSettings()), Registry()

    @registry.service("asked")
    def asked(request: Asked) -> Asked:
        return request

    def looks_into_the_store(payload: Any) -> bool:
        return gate.has_references(Command(id=1, service="asked", payload=payload), registry.get("asked"))

    wrong: list[Any] = [None, 7, [], {"one": [name(MAP)]}, {"many": name(MAP)}, {"part": [1]}]

    for nonsense in wrong:
        assert not looks_into_the_store(nonsense)
        assert resolved(nonsense, store) == nonsense
    assert looks_into_the_store({"many": [b"", name(MAP)]})
