"""The data service trusts what the control room says: keys of robots, denials, rights on one map, quotas."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_data_service import KEY, Service, small_settings

from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.data_server import DataServer
from rse_pf.data_server.server import KeysFile
from rse_pf.object_store import DirectoryStore, MemoryStore, digest_of

ROBOT = SigningKey.of_robot(b"r" * 32)
PAUSE_S = 0.5


class Governed(Service):
    """A data service whose keys lie in a folder with a control room."""

    def __init__(self, folder: Path) -> None:
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        self.room = AccessControlStore(DirectoryStore(folder))
        self.folder = folder
        super().__init__(small_settings(), MemoryStore())

    def restart(self) -> None:
        keys = KeysFile(self.folder / "keys.json", PAUSE_S, lambda: self.now)
        self.app = DataServer(
            self.settings, self.store, keys=keys, log=self.lines.append, clock=lambda: self.now,
            wall_clock=lambda: self.wall,
        )  # fmt: skip


@pytest.fixture
def governed(tmp_path: Path) -> Governed:
    return Governed(tmp_path)


def put(service: Service, data: bytes, token: str) -> int:
    return service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, token=token).status


def test_a_disabled_robot_is_refused_after_the_next_look_and_after_a_restart(governed: Governed) -> None:
    token = governed.token()
    assert put(governed, b"a", token) == 201

    governed.room.change_denied(lambda denied: denied.with_robot("default", "robot-1", 0.0))
    governed.now += PAUSE_S

    assert put(governed, b"b", token) == 401
    assert governed.lines[-1]["reason"] == "disabled"
    governed.restart()
    assert put(governed, b"b", token) == 401
    assert put(governed, b"b", governed.token("robot-2")) == 201


def test_an_enrolled_robot_stores_under_the_tenant_and_the_quota_of_the_roster(governed: Governed) -> None:
    robot = EnrolledRobot(
        robot="own", tenant="lab", x=public_key_of(ROBOT.public_json()), quotas={"data_bytes": 100.0}
    )
    governed.room.change_roster(lambda roster: roster.enrolled(robot))
    token = ROBOT.issue(
        "own", now=governed.wall, token_id="t", settings=governed.settings.auth, tenant="other"
    )

    assert put(governed, b"x" * 60, token) == 201
    assert put(governed, b"y" * 60, token) == 413
    assert [info.name.split("/")[1] for info in governed.store.list("objects/")] == ["lab"]


def test_a_right_on_one_map_is_none_on_another(governed: Governed) -> None:
    token = governed.token(scopes=("maps:read/kitchen",))

    def status(name: str) -> int:
        return governed.ask("GET", f"/data/v1/maps/{name}/versions", token=token).status

    assert status("kitchen") in (200, 404)
    assert status("garage") == 403
    assert governed.ask("GET", "/data/v1/maps", token=token).status == 403
