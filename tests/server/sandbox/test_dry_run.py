"""One service in one real sandbox, without a server."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.server.sandbox.dry_run import DryRun, dry_run
from rse_pf.services.custom.installed import read_service
from rse_pf.wire import Failure, Result

SOURCE = """
import os
import msgspec

class Request(msgspec.Struct):
    do: str = "add"

class Reply(msgspec.Struct):
    count: int

class Service:
    def __init__(self): self.count = 0
    def snapshot(self): return str(self.count).encode()
    def restore(self, data): self.count = int(data)
    def serve(self, request: Request) -> Reply:
        print("asked to", request.do)
        if request.do == "crash":
            print("begun", end="")
            os.abort()
        if request.do == "raise": raise ValueError("no")
        self.count += 1
        return Reply(count=self.count)
"""


@pytest.fixture
def try_it(tmp_path: Path):
    manifest = {"name": "counter", "language": "python", "entry": "service.py", "kind": "per_robot_state"}
    folder = tmp_path / "counter"
    folder.mkdir()
    (folder / "service.json").write_text(json.dumps(manifest))
    (folder / "service.py").write_text(SOURCE)

    def try_it(*payloads: dict[str, str]) -> tuple[list[DryRun], list[str]]:
        lines: list[str] = []
        _, runs = dry_run(read_service(folder), payloads, PlatformSettings(), lines.append)
        return runs, lines

    return try_it


def test_requests_run_one_after_the_other_and_what_the_service_prints_is_shown(try_it):
    runs, lines = try_it({}, {})

    assert [run.answer.reply for run in runs if isinstance(run.answer, Result)] == [
        {"count": 1},
        {"count": 2},
    ]
    assert lines == ["asked to add"] * 2


def test_an_exception_of_the_service_is_a_failure_with_the_traceback_in_its_output(try_it):
    (run,), lines = try_it({"do": "raise"})

    assert isinstance(run.answer, Failure)
    assert run.answer.code == "internal"
    assert any("ValueError: no" in line for line in lines)


def test_state_is_restored_after_a_crash_and_the_crash_is_shown(try_it):
    runs, lines = try_it({}, {"do": "crash"}, {})

    assert [getattr(run.answer, "code", "ok") for run in runs] == ["ok", "poison", "ok"]
    assert isinstance(runs[2].answer, Result)
    assert runs[2].answer.reply == {"count": 2}
    assert sum("sandbox-crashed" in line for line in lines) == 2
    assert lines.count("begun") == 2, "what was printed without a newline before the crash"


def test_what_a_script_prints_without_flushing_is_shown(tmp_path: Path):
    manifest = {"name": "loud", "language": "lua", "entry": "service.lua"}
    folder = tmp_path / "loud"
    folder.mkdir()
    (folder / "service.json").write_text(json.dumps(manifest))
    (folder / "service.lua").write_text(
        "return function(request) print('a line') io.write('begun') return {} end"
    )
    lines: list[str] = []

    dry_run(read_service(folder), [{}, {}], PlatformSettings(), lines.append)

    assert lines == ["a line", "beguna line", "begun"]


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 always imports from where it runs")
def test_a_sandbox_that_is_started_from_inside_the_folder_imports_nothing_of_it(
    try_it, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "ran"
    for name in ("json.py", "socket.py", "rse_pf.py", "sitecustomize.py"):
        (tmp_path / "counter" / name).write_text(f"open({str(mark)!r}, 'w')\nraise SystemExit(1)\n")
    monkeypatch.chdir(tmp_path / "counter")

    runs, _ = try_it({})

    assert isinstance(runs[0].answer, Result)
    assert not mark.exists()
