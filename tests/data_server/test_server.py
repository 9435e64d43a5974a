"""The process of the data service: its keys, roster and deny list, and what it imports at its start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import REFRESH_S, AccessControlStore
from rse_pf.data_server import DataServer
from rse_pf.data_server.server import KeysFile
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, digest_of
from tests.kit.fake_data_service import KEY, Service, small_settings

ROBOT = SigningKey.of_robot(b"r" * 32)


class RosterService(Service):
    """A data service whose keys lie in a folder with roster and deny list."""

    def __init__(self, folder: Path) -> None:
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        self.access = AccessControlStore(DirectoryStore(folder))
        self.folder = folder
        super().__init__(small_settings(), MemoryStore())

    def restart(self) -> None:
        keys = KeysFile(self.folder / "keys.json", lambda: self.now)
        self.app = DataServer(
            self.settings, self.store, keys=keys, log=self.lines.append, clock=lambda: self.now,
            wall_clock=lambda: self.wall, describe=self.describe,
        )  # fmt: skip


@pytest.fixture
def service(tmp_path: Path) -> RosterService:
    return RosterService(tmp_path)


def put(service: Service, data: bytes, token: str) -> int:
    return service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data, token=token).status


def test_a_disabled_robot_is_refused_after_the_next_refresh_and_after_a_restart(
    service: RosterService,
) -> None:
    token = service.token()
    assert put(service, b"a", token) == 201

    service.access.change_deny_list(lambda denied: denied.with_robot("default", "robot-1", 0.0))
    service.now += REFRESH_S

    assert put(service, b"b", token) == 401
    assert service.lines[-1]["reason"] == "disabled"
    service.restart()
    assert put(service, b"b", token) == 401
    assert put(service, b"b", service.token("robot-2")) == 201


def test_an_enrolled_robot_has_the_tenant_and_the_quota_of_the_roster(
    service: RosterService,
) -> None:
    robot = EnrolledRobot(
        robot="own", tenant="lab", x=public_key_of(ROBOT.public_json()), quotas={"data_bytes": 8192.0}
    )
    service.access.change_roster(lambda roster: roster.enrolled(robot))
    token = ROBOT.issue(
        "own",
        now=service.wall,
        token_id="t",
        settings=service.settings.auth,
        tenant="other",
    )

    assert put(service, b"x" * 3000, token) == 201
    assert put(service, b"y" * 4096, token) == 201
    assert put(service, b"z", token) == 413
    assert [info.name.split("/")[1] for info in service.store.list("objects/")] == ["lab", "lab"]


def test_a_scope_for_one_map_does_not_cover_another(service: RosterService) -> None:
    token = service.token(scopes=("maps:read/kitchen",))

    def status(name: str) -> int:
        return service.ask("GET", f"/data/v1/maps/{name}/versions", token=token).status

    assert status("kitchen") in (200, 404)
    assert status("garage") == 403
    assert service.ask("GET", "/data/v1/maps", token=token).status == 403


def test_the_service_starts_without_numpy() -> None:
    """Importing numpy would take a third of the start; only the first commit of a map needs it."""
    check = "import sys, rse_pf.data_server.server; sys.exit('numpy' in sys.modules)"

    assert subprocess.run([sys.executable, "-c", check], check=False, timeout=60).returncode == 0
