"""One service in one real sandbox, without a server."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.server.sandbox.dry_run import DryRun, dry_run
from rse_pf.services.custom.installed import read_service
from rse_pf.wire import Result

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
