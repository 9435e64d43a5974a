"""The state file: whole, without secrets, refused when broken; one control plane per folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.processes import ProcessMark
from rse_pf.local.state import (
    PlatformLock,
    PlatformState,
    ServerState,
    read_state,
    remove_state,
    state_folder,
)


def mark(pid: int) -> ProcessMark:
    return ProcessMark(pid=pid, began=f"{pid}@boot")


STATE = PlatformState(
    name="default",
    control_plane=mark(1),
    url="ws://127.0.0.1:1/robots",
    settings_digest="0123456789abcdef",
    settings_file="settings.json",
    key_file="key.json",
    servers=(ServerState(name="server-1", process=mark(2), port=10, control_port=11),),
    load_balancer=mark(3),
    port=12,
)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    STATE.write(tmp_path)

    assert read_state(tmp_path) == STATE


def test_a_platform_that_only_begins_has_no_balancer_yet(tmp_path: Path) -> None:
    young = PlatformState(
        name="a", control_plane=mark(1), url="", settings_digest="", settings_file="", key_file=""
    )
    young.write(tmp_path)

    assert read_state(tmp_path) == young
    assert young.processes() == ()


def test_the_data_path_is_everything_but_the_control_plane() -> None:
    assert STATE.processes() == (mark(2), mark(3))


def test_a_write_leaves_no_other_file_behind(tmp_path: Path) -> None:
    STATE.write(tmp_path)
    STATE.write(tmp_path)

    assert [file.name for file in tmp_path.iterdir()] == ["platform.json"]


def test_no_file_means_no_platform(tmp_path: Path) -> None:
    assert read_state(tmp_path) is None
    remove_state(tmp_path)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '"text"', "3", '{"servers": 3}', json.dumps({"servers": [], "load_balancer": 1})]
)
def test_a_broken_file_is_an_error_with_a_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "platform.json").write_text(text)

    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_state(tmp_path)


def test_the_folder_follows_the_environment() -> None:
    assert state_folder("a", {"XDG_STATE_HOME": "/x"}) == Path("/x/rse-pf/a")
    assert state_folder("a", {"HOME": "/h"}) == Path("/h/.local/state/rse-pf/a")
    assert state_folder("a", {"HOME": "/h", "XDG_STATE_HOME": "relative"}) == Path("/h/.local/state/rse-pf/a")


@pytest.mark.parametrize("name", ["", "..", "a/b", "A", "-a", "a" * 33, "a\n", "é"])
def test_a_name_cannot_leave_its_folder(name: str) -> None:
    with pytest.raises(UsageError):
        state_folder(name, {"HOME": "/h"})


def test_one_folder_has_one_control_plane_at_a_time(tmp_path: Path) -> None:
    first, second = PlatformLock(tmp_path), PlatformLock(tmp_path)
    first.take("a")
    try:
        with pytest.raises(ConfigurationError, match="'a' is running already"):
            second.take("a")
    finally:
        first.release()

    second.take("a")
    second.release()
