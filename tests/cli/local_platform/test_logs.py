"""The logs of all processes in one: order, levels, rotation, and servers that start while one looks."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rse_pf.cli.local_platform.logs import LogFollower, format_line, last_lines, log_files
from rse_pf.errors import UsageError


def line(time_s: float, event: str, level: str = "info", **fields: object) -> str:
    return json.dumps({"time": time_s, "level": level, "event": event, "server": "s", **fields}) + "\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "server-1.log").write_text(
        line(10, "server-ready") + line(30, "defect", "error", traceback="Traceback\n  x\nZeroDivisionError")
    )
    (tmp_path / "server-2.log").write_text(
        line(20, "command", "debug", robot="r 1", id=7) + "a thread died\n"
    )
    (tmp_path / "load-balancer.log").write_text("[warning] something\n")
    os.utime(tmp_path / "load-balancer.log", (25, 25))
    return tmp_path


def events(found: list) -> list[str]:
    return [each.text.split()[0] for each in found]


def test_lines_of_all_processes_are_in_the_order_of_their_times(folder: Path) -> None:
    found = last_lines(log_files(folder, None), "debug", 10)

    assert events(found) == ["server-ready", "command", "a", "[warning]", "defect"]
    assert events(last_lines(log_files(folder, None), "debug", 2)) == ["[warning]", "defect"]


def test_a_level_and_a_server_choose(folder: Path) -> None:
    assert events(last_lines(log_files(folder, None), "error", 10)) == ["defect"]
    assert events(last_lines(log_files(folder, "server-2"), "debug", 10)) == ["command", "a"]


def test_a_line_shows_its_fields_and_the_end_of_a_traceback(folder: Path) -> None:
    found = last_lines(log_files(folder, None), "debug", 10)

    assert format_line(found[1])[8:] == '  server-2  debug    command robot="r 1" id=7'
    assert format_line(found[-1]).endswith("error    defect ZeroDivisionError")


def test_an_unknown_server_and_an_empty_folder_are_refused_with_what_there_is(folder: Path) -> None:
    with pytest.raises(UsageError) as caught:
        log_files(folder, "server-9")
    assert caught.value.hint == "there are logs of load-balancer, server-1, server-2"
    with pytest.raises(UsageError, match="no logs"):
        log_files(folder / "none", None)


def test_what_is_appended_is_followed_also_in_a_rotated_and_in_a_new_log(folder: Path) -> None:
    follower = LogFollower(folder, None, "info")
    assert follower.new_lines() == []

    with (folder / "server-1.log").open("a") as log:
        log.write(line(40, "drain") + line(41, "hidden", "debug") + line(42, "half")[:10])
    assert events(follower.new_lines()) == ["drain"]

    with (folder / "server-1.log").open("a") as log:
        log.write(line(42, "half")[10:])
    (folder / "server-3.log").write_text(line(43, "server-ready"))
    assert events(follower.new_lines()) == ["half", "server-ready"]

    (folder / "server-1.log").write_text(line(50, "rotated"))
    assert events(follower.new_lines()) == ["rotated"]
