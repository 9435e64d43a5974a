"""A machine that cannot become a server says why and leaves; one whose role is late becomes one."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from system.boot.test_boot import LAUNCH, SETTINGS, kept, package
from system.boot.world import World

from rse_pf.config.resource_names import READY_PATH
from rse_pf.scaling.boot_time import ready_within_s

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(1800)]

__all__ = ["kept", "package"]
LATE_S = 20.0


@pytest.fixture
def world(kept: Path, tmp_path: Path) -> Iterator[World]:
    """A machine that is switched off."""
    with World(tmp_path, kept) as made:
        yield made
    shutil.rmtree(made.root, ignore_errors=True)


def damaged(package: Path, folder: Path) -> Path:
    copy = folder / "damaged"
    shutil.copytree(package, copy)
    return copy


def test_a_package_that_was_changed_ends_the_launch_and_the_console_says_which_file(
    world: World, package: Path, tmp_path: Path
) -> None:
    from stacks.assets import sums_digest

    copy = damaged(package, tmp_path)
    data = bytearray((copy / "platform.tar.gz").read_bytes())
    data[len(data) // 2] ^= 1
    (copy / "platform.tar.gz").write_bytes(data)

    world.boot(copy, sums_digest(copy))

    world.wait(lambda: "user-data ended with" in world.text(), 120, "end of the boot")
    assert world.completed() == [(LAUNCH, "ABANDON")]
    assert "platform.tar.gz is not what the package's list says" in world.console()
    assert not (world.root / "opt/rse-pf/venv").exists(), "it was unpacked all the same"


def test_an_install_that_fails_ends_the_launch_and_the_console_has_its_last_lines(
    world: World, package: Path, tmp_path: Path
) -> None:
    from stacks.assets import SUMS_FILE, sums_digest, sums_text

    copy = damaged(package, tmp_path)
    about = copy / "environment.json"
    about.write_text(about.read_text().replace('"3.11"', '"3.12"'))
    (copy / SUMS_FILE).write_text(sums_text(copy))

    world.boot(copy, sums_digest(copy))

    world.wait(lambda: "user-data ended with" in world.text(), 120, "end of the boot")
    assert world.completed() == [(LAUNCH, "ABANDON")]
    assert "the environment is for Python 3.12" in world.console()
    assert "cloud.image_parameter" in world.console()


def test_a_release_whose_server_never_gets_ready_ends_the_launch(
    world: World, package: Path, tmp_path: Path
) -> None:
    from stacks.assets import SUMS_FILE, sums_digest, sums_text

    copy = damaged(package, tmp_path)
    unit = copy / "rse-pf.service"
    unit.write_text(unit.read_text().replace("/bin/rse-pf serve", "/bin/rse-pf serve --no-such-option"))
    (copy / SUMS_FILE).write_text(sums_text(copy))

    world.boot(copy, sums_digest(copy))

    world.wait(lambda: bool(world.completed()), 120 + ready_within_s(), "completed hook")
    assert world.completed() == [(LAUNCH, "ABANDON")]
    world.wait(lambda: "agent-not-ready" in world.text(), 30, "line of the agent after its call")
    assert "--no-such-option" in world.text(), "the reason is in the unit's own lines"


def test_a_role_that_comes_twenty_seconds_late_delays_the_boot_and_no_more(
    world: World, package: Path
) -> None:
    from stacks.assets import sums_digest

    world.role.write_text("")
    began_s = time.monotonic()
    world.boot(package, sums_digest(package))
    world.wait(lambda: time.monotonic() - began_s >= LATE_S, LATE_S + 30, "time")
    assert "first boot: HTTP Error 404" in world.text() or "first boot: list index" in world.text()
    world.role.write_text("server-role")

    world.wait(lambda: bool(world.completed()), 120, "completed hook")
    assert world.completed() == [(LAUNCH, "CONTINUE")]
    assert world.status(SETTINGS.serving.control_port, READY_PATH) == 200
