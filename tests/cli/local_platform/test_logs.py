"""The logs of all processes in one: order, levels, rotation, and servers that start while one looks."""

from __future__ import annotations

import json
import math
import os
from datetime import datetime, timezone
from pathlib import Path

import pytest

from rse_pf.cli.local_platform.logs import (
    ALL_LINES,
    LogFilter,
    LogFollower,
    event_document,
    format_event,
    format_line,
    last_lines,
    log_files,
    since_time_s,
)
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


def chosen(folder: Path, **wanted: object) -> list[str]:
    return events(last_lines(log_files(folder, None), LogFilter(**wanted), 10))


def test_lines_of_all_processes_are_in_the_order_of_their_times(folder: Path) -> None:
    found = last_lines(log_files(folder, None), ALL_LINES, 10)

    assert events(found) == ["server-ready", "command", "a", "[warning]", "defect"]
    assert events(last_lines(log_files(folder, None), ALL_LINES, 2)) == ["[warning]", "defect"]


def test_lines_about_a_server_are_chosen_with_its_own_and_rotated_logs_are_read(folder: Path) -> None:
    (folder / "data-1.log").write_text(line(40, "server-gone", server="server-2"))
    (folder / "server-2.log.1").write_text(line(5, "earlier"))
    found = last_lines(log_files(folder, None), LogFilter(process="server-2", since_s=0.0), 1)

    assert events(found) == ["earlier", "command", "a", "server-gone"]
    assert {each.source for each in found} == {"server-2", "data-1"}


def test_a_line_shows_its_fields_and_the_end_of_a_traceback(folder: Path) -> None:
    found = last_lines(log_files(folder, None), ALL_LINES, 10)

    assert format_line(found[1])[19:] == '  server-2  debug    command robot="r 1" id=7'
    assert format_line(found[-1]).endswith("error    defect ZeroDivisionError")


def test_an_unknown_server_and_an_empty_folder_are_refused_with_what_there_is(folder: Path) -> None:
    with pytest.raises(UsageError) as caught:
        log_files(folder, "server-9")
    assert caught.value.hint == "there are logs of load-balancer, server-1, server-2"
    with pytest.raises(UsageError, match="no logs"):
        log_files(folder / "none", None)


def test_what_is_appended_is_followed_also_in_a_rotated_and_in_a_new_log(folder: Path) -> None:
    follower = LogFollower(folder, wanted=LogFilter(level="info"))
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


def entry(time_s: float, action: str, subject: str = "", **detail: object) -> str:
    fields = {"time": time_s, "actor": "control-plane", "action": action, "subject": subject}
    return json.dumps({**fields, "detail": detail}) + "\n"


@pytest.fixture
def with_events(folder: Path) -> Path:
    (folder / "audit").mkdir()
    (folder / "audit" / "control-plane.jsonl").write_text(
        entry(15, "platform.server-healthy", "server-2", pid=7)
        + entry(33, "platform.server-gone", "server-2", exit_code=-9, cause="")
    )
    with (folder / "server-1.log").open("a") as log:
        log.write(line(34, "robot-offline", robot="r1", tenant="acme"))
        log.write(line(35, "robot-online", robot="r1", tenant="default"))
    return folder


def test_what_the_control_plane_did_is_among_the_lines_with_the_level_of_its_kind(with_events: Path) -> None:
    found = last_lines(log_files(with_events, None), LogFilter(process="control-plane"), 10)

    assert [(line.level, line.text) for line in found] == [
        ("info", "server-healthy server=server-2 pid=7"),
        ("warning", 'server-gone server=server-2 exit_code=-9 cause=""'),
    ]


def test_time_robot_and_tenant_choose_lines(with_events: Path) -> None:
    assert chosen(with_events, since_s=33.0) == ["server-gone", "robot-offline", "robot-online"]
    assert chosen(with_events, robot="r1", tenant="acme") == ["robot-offline"]
    assert chosen(with_events, tenant="default", since_s=33.0) == ["server-gone", "robot-online"]
    many = [line(40 + number / 1e3, "drain") for number in range(200)]
    (with_events / "server-3.log").write_text("".join(many))
    assert len(
        last_lines(log_files(with_events, "server-3"), LogFilter(since_s=40.0, process="server-3"), 10)
    ) == len(many)


def test_events_are_the_lines_that_a_program_can_follow(with_events: Path) -> None:
    found = last_lines(log_files(with_events, None), LogFilter(events_only=True), 10)

    documents = [event_document(each) for each in found]
    assert [each["kind"] for each in documents] == [
        "server-healthy", "server-gone", "robot-offline", "robot-online",
    ]  # fmt: skip
    assert documents[1]["robot"] is None
    offline = {"time": 34.0, "kind": "robot-offline", "tenant": "acme", "robot": "r1", "server": "s"}
    assert documents[2] == offline
    assert format_event(found[2]).endswith("  acme/r1 is no longer connected to s")
    assert format_event(found[3]).endswith("  r1 is connected to s")


def test_a_time_is_an_age_or_a_date_and_everything_else_is_refused() -> None:
    now_s = 1_800_000_000.0

    ages = {"90s": 90.0, "5m": 300.0, "1.5h": 5400.0, "2d": 172_800.0}
    assert {text: now_s - since_time_s(text, now_s) for text in ages} == ages
    date = datetime(2026, 3, 1, 14, 30, tzinfo=timezone.utc)
    assert since_time_s("2026-03-01 14:30+00:00", now_s) == date.timestamp()
    assert since_time_s("2026-03-01 14:30", now_s) == date.replace(tzinfo=None).timestamp()
    for text in ("5", "5 minutes", "yesterday", "-5m", "14:30", "", "9999999999d"):
        with pytest.raises(UsageError) as caught:
            assert math.isnan(since_time_s(text, now_s)), text
        assert "5m" in caught.value.hint
