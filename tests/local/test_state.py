"""The state file: whole, without secrets, refused when broken; one control plane per folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.processes import ProcessMark
from rse_pf.local.state import (
    PlatformLock,
    platform_settings,
    read_state,
    settings_file,
    state_folder,
)


def mark(pid: int) -> ProcessMark:
    return ProcessMark(pid=pid, began=f"{pid}@boot")


STATE_OF_0_1_0 = """{
  "name": "default",
  "control_plane": {"pid": 1, "began": "1@boot"},
  "url": "ws://127.0.0.1:1/robots",
  "settings_digest": "0123456789abcdef",
  "settings_file": "settings.json",
  "key_file": "key.json",
  "control_token_file": "control.token",
  "servers": [
    {"name": "server-1", "process": {"pid": 2, "began": "2@boot"}, "port": 10, "control_port": 11}
  ],
  "data_server": {"name": "data-1", "process": {"pid": 4, "began": "4@boot"}, "port": 13, "control_port": 0},
  "load_balancer": {"pid": 3, "began": "3@boot"},
  "port": 12,
  "status_port": 14,
  "launched": 1
}
"""
"""As version 0.1.0 wrote it, with other numbers."""


def test_the_state_of_0_1_0_is_read_and_written_again_in_the_same_form(tmp_path: Path) -> None:
    (tmp_path / "platform.json").write_text(STATE_OF_0_1_0)

    state = read_state(tmp_path)

    assert state is not None
    assert state.processes() == (mark(2), mark(4), mark(3))
    assert (state.status_port, state.launched, state.control_token_file) == (14, 1, "control.token")
    state.write(tmp_path)
    assert json.loads((tmp_path / "platform.json").read_text()) == json.loads(STATE_OF_0_1_0)


def test_settings_of_0_1_0_are_refused_with_what_to_do(tmp_path: Path) -> None:
    assert platform_settings(tmp_path) is None
    old = {"context": {"rse-pf": {"serving": {"health_path": "/healthz", "backlog": 4096}}}}
    settings_file(tmp_path).write_text(json.dumps(old))

    with pytest.raises(ConfigurationError, match=r"is not of this version: .*serving") as told:
        platform_settings(tmp_path)

    assert told.value.hint == f"start the platform once with: rse-pf local --name {tmp_path.name}"


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '"text"', "3", '{"servers": 3}', json.dumps({"servers": [], "load_balancer": 1})]
)
def test_a_broken_file_is_an_error_with_a_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "platform.json").write_text(text)

    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_state(tmp_path)


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
