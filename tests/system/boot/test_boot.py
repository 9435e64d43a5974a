"""A bare Debian machine becomes a healthy backend server, and asks nobody but AWS."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from system.boot.world import World, debian_root, missing

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import READY_PATH
from rse_pf.config.server_settings import server_settings

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(1800)]

SETTINGS = PlatformSettings.from_dict(
    {
        "scaling": {"period_s": 10},
        "serving": {"workers": 1},
    }
)
KEY = SigningKey.from_seed(b"k" * 32, "boot-key")
TOLERANCE = 0.02
"""Metres and radians: ten times what half a pixel of noise moves a pose by."""


LAUNCH = "rse-pf-launch"


@pytest.fixture(scope="module")
def kept(repository: Path) -> Path:
    """A bare Debian, and the packages; skips where one of them cannot be had."""
    if missing():
        pytest.skip(missing())
    pytest.importorskip("flask", reason="run make setup: moto's server")
    from stacks.assets import ENVIRONMENT_FILE, SERVERS

    if not (repository / "build" / SERVERS / ENVIRONMENT_FILE).is_file():
        pytest.skip("no packages in build: run make assets")
    kept = repository / "build" / "debian12"
    if not (kept / "made").is_file() and not shutil.which("debootstrap"):
        pytest.skip("needs debootstrap, to make a bare Debian once")
    return debian_root(kept)


@pytest.fixture(scope="module")
def package(repository: Path, kept: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of a server, as it is deployed."""
    from stacks.assets import SERVERS, staged

    return staged(repository / "build", SERVERS, SETTINGS, tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def world(kept: Path, package: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The machine, switched on, without keys in the bucket."""
    from stacks.assets import sums_digest

    with World(tmp_path_factory.mktemp("boot"), kept) as made:
        made.boot(package, sums_digest(package))
        yield made
    shutil.rmtree(made.root, ignore_errors=True)


def token() -> str:
    return KEY.issue("robot-1", now=time.time(), token_id="t-1", settings=SETTINGS.auth)


def ask_for_a_pose(world: World) -> dict:
    serving = SETTINGS.serving
    return world.inside("pose", token(), f"ws://127.0.0.1:{serving.port}/ws")


def test_the_machine_becomes_healthy_in_every_attached_target_group(world: World) -> None:
    serving = SETTINGS.serving

    world.wait(lambda: world.status(serving.control_port, READY_PATH) == 200, 120, "healthy server")

    assert "user-data ended with 0" in world.text()


def test_the_machine_joins_its_group_once_it_is_ready(world: World) -> None:
    world.wait(lambda: bool(world.completed()), 30, "completed launch hook")

    assert world.completed() == [(LAUNCH, "CONTINUE")]


def test_without_keys_robots_are_refused_and_one_line_says_why(world: World) -> None:
    assert ask_for_a_pose(world) == {"failed": "unauthorized"}
    assert world.text().count("agent-no-keys") == 1


def test_once_the_keys_appear_a_robot_gets_a_right_pose(world: World) -> None:
    world.inside("keys", KEY.key_set().to_json())
    starts = world.text().count("server-ready")
    assert starts >= 1
    answers = []

    world.wait(lambda: "verdict" in (answers.append(ask_for_a_pose(world)) or answers[-1]), 60, "answer")

    answer = answers[-1]
    assert world.text().count("server-ready") == starts, "new keys need no restart"
    assert answer["server"] == "i-0123456789abcdef0"
    assert answer["verdict"] == "ok"
    assert answer["off"] < TOLERANCE


def test_every_service_of_maps_answers_on_the_machine(world: World) -> None:
    serving = SETTINGS.serving

    said = world.inside("services", token(), f"ws://127.0.0.1:{serving.port}/ws")

    assert said == {"icp": "", "optimise": "", "live-start": ""}


def test_the_agent_publishes_what_the_alarms_read(world: World) -> None:
    ask_for_a_pose(world)

    world.wait(lambda: world.inside("numbers")["Sum"] >= 1, 60, "published request")

    assert world.inside("numbers")["SampleCount"] >= 2


def test_the_server_runs_as_its_own_user_with_the_settings_of_the_template(world: World) -> None:
    owner = (world.root / "var/lib/rse-pf").stat().st_uid
    settings = json.loads((world.root / "opt/rse-pf/package/settings.json").read_text())["context"]["rse-pf"]

    assert owner != 0
    assert settings == server_settings(SETTINGS)
    assert (world.root / "run/rse-pf/keys.json").read_text() == KEY.key_set().to_json()


def test_systemd_itself_finds_the_units_sound(world: World) -> None:
    units = ["rse-pf.service", "rse-pf-agent.service", "rse-pf-data.service"]
    shutil.copyfile(
        world.root / "opt/rse-pf/package/rse-pf-data.service",
        world.root / "etc/systemd/system/rse-pf-data.service",
    )
    told = world.run(
        ["sh", "-c", f"chroot {world.root} /usr/bin/systemd-analyze verify {' '.join(units)} 2>&1"]
    )

    assert [line for line in told.splitlines() if "rse-pf" in line] == []


def test_a_leaving_instance_drains_and_its_server_stays_down(world: World) -> None:
    world.lifecycle.write_text("Terminated")

    world.wait(lambda: "rse-pf.service ended with 0" in world.text(), 90, "drained server")

    world.wait(lambda: len(world.completed()) == 2, 30, "completed drain hook")
    assert world.completed()[1] == ("rse-pf-drain", "CONTINUE")
    assert "agent-leaving" in world.text()
    assert world.status(SETTINGS.serving.control_port, "/healthz") == 0


def test_no_packet_left_the_machine_and_one_would_have_been_seen(world: World) -> None:
    assert world.packets_to_the_outside() == 0

    world.run(["python3", "-c", "import socket; socket.socket(2, 2).sendto(b'x', ('198.51.100.1', 9))"])
    assert world.packets_to_the_outside() == 1
