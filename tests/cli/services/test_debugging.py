"""The action debug: outside of the sandbox, in this process, with a debugger or without."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import main

SOURCE = """
import os
import msgspec
from rse_pf.errors import DegenerateGeometry

class Request(msgspec.Struct):
    do: str = ""

class Reply(msgspec.Struct):
    pid: int
    count: int

class Service:
    def __init__(self):
        self.count = 0
    def serve(self, request: Request) -> Reply:
        self.count += 1
        if request.do == "raise":
            raise ValueError("no table")
        if request.do == "degenerate":
            raise DegenerateGeometry("all on one line")
        if request.do == "break":
            breakpoint()
        return Reply(pid=os.getpid(), count=self.count)
    def snapshot(self):
        return b"12345"
    def restore(self, data):
        pass
"""


@pytest.fixture(autouse=True)
def author(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    write("mine", "python", "service.py", SOURCE, "per_robot_state")
    for do in ("", "raise", "degenerate", "break"):
        Path(f"{do or 'good'}.json").write_text(json.dumps({"request": {"do": do}}))
    lines = [{"format": "rse-pf-requests", "version": 1, "service": "mine"}, *[{"request": {}}] * 3]
    Path("three.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return tmp_path


def write(name: str, language: str, entry: str, source: str, kind: str = "stateless") -> None:
    Path(name).mkdir()
    manifest = {"name": name, "language": language, "entry": entry, "kind": kind}
    Path(name, "service.json").write_text(json.dumps(manifest))
    Path(name, entry).write_text(source)


def debug(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    *words: str,
    typed: str = "",
    code: int = 0,
) -> str:
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
    capsys.readouterr()
    here = Path.cwd()
    assert main(["service", "debug", *words]) == code
    assert Path.cwd() == here
    written = capsys.readouterr()
    return written.out + written.err


def test_the_service_runs_in_this_process_and_its_reply_and_snapshot_are_shown(capsys, monkeypatch):
    told = debug(capsys, monkeypatch, "mine", "--request", "good.json", "--no-debugger")

    assert json.loads(told.splitlines()[0])["count"] == 1
    assert "snapshot: 5 bytes" in told


def test_the_debugger_stops_at_the_first_line_of_the_service(capsys, monkeypatch):
    told = debug(capsys, monkeypatch, "mine", "--request", "@good.json", typed="p request.do\nc\n")

    assert "self.count += 1" in told
    assert '"count": 1' in told


def test_a_breakpoint_of_the_author_stops_without_another_option(capsys, monkeypatch):
    stops: list[int] = []
    monkeypatch.setattr(sys, "breakpointhook", lambda: stops.append(1))  # pytest has its own

    debug(capsys, monkeypatch, "mine", "--request", "break.json", "--no-debugger")

    assert stops == [1]


def test_the_debugger_stands_where_an_exception_was_raised(capsys, monkeypatch):
    told = debug(capsys, monkeypatch, "mine", "--request", "raise.json", typed="c\np 40 + 2\nq\n", code=1)

    assert "ValueError: no table; the debugger stands where it was raised" in told
    assert "\n(Pdb) 42\n" in told


def test_leaving_the_debugger_ends_the_command(capsys, monkeypatch):
    told = debug(capsys, monkeypatch, "mine", "--request", "good.json", typed="q\n", code=1)

    assert "the debugger was left" in told
    assert "Traceback" not in told


def test_a_defect_is_shown_from_the_service_on_and_a_typed_failure_as_the_robot_gets_it(capsys, monkeypatch):
    defect = debug(capsys, monkeypatch, "mine", "--request", "raise.json", "--no-debugger", code=1)
    failure = debug(capsys, monkeypatch, "mine", "--request", "degenerate.json", "--no-debugger", code=1)

    assert "service.py" in defect.splitlines()[0]
    assert "ValueError: no table" in defect
    assert failure.startswith("DegenerateGeometry: all on one line")


def test_requests_before_the_chosen_one_make_the_state(capsys, monkeypatch):
    told = debug(capsys, monkeypatch, "mine", "--request", "three.jsonl", "--number", "3", "--no-debugger")

    assert '"count": 3' in told


def test_a_debugger_of_an_editor_is_waited_for(capsys, monkeypatch):
    asked: list[Any] = []
    fake: Any = types.ModuleType("debugpy")
    fake.listen, fake.wait_for_client = asked.append, lambda: asked.append("waits")
    monkeypatch.setitem(sys.modules, "debugpy", fake)

    told = debug(capsys, monkeypatch, "mine", "--request", "good.json", "--wait-for-client", "7777")

    assert asked == [("127.0.0.1", 7777), "waits"]
    assert '"count": 1' in told


def test_a_script_runs_without_a_sandbox(capsys, monkeypatch):
    write("script", "lua", "s.lua", "return function(request) return {twice = 2 * request.x} end")
    Path("x.json").write_text('{"request": {"x": 21}}')

    told = debug(capsys, monkeypatch, "script", "--request", "x.json")

    assert "Lua has no debugger here" in told
    assert '{"twice": 42' in told


def test_a_library_is_given_to_gdb(capsys, monkeypatch):
    write("library", "cpp", "lib.so", "")

    told = debug(capsys, monkeypatch, "library", "--request", "good.json", "--number", "1")

    assert told.startswith("gdb -q -ex 'set breakpoint pending on' -ex 'break rse_pf_service_call_arrays'")
    assert told.rstrip().endswith(f"--request {Path('good.json').absolute()} --number 1 --no-debugger")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("mine", "add --request mine/requests/example.json"),
        ("typo --request good.json", "cannot read typo/service.json"),
        ("mine --request typo.json", "cannot read typo.json"),
        ("mine --request three.jsonl --number 4", "choose --number 1 to 3"),
        ("mine --request three.jsonl --number 0", "there is no number 0"),
        ("mine --request good.json --gdb", "--gdb is for services in C and C++"),
        ("mine --request good.json --wait-for-client", "pip install debugpy"),
        ("script --request good.json --wait-for-client", "is for services in Python"),
        ("library --request good.json --gdb", "apt install gdb"),
    ],
)
def test_a_wrong_call_is_two_lines(capsys, monkeypatch, words, says):
    write("script", "lua", "s.lua", "return function(request) return {} end")
    write("library", "cpp", "lib.so", "")
    monkeypatch.setitem(sys.modules, "debugpy", None)
    monkeypatch.setattr(shutil, "which", lambda _: None)

    told = debug(capsys, monkeypatch, *words.split(), code=2)

    assert says in told
    assert len([line for line in told.splitlines() if not line.startswith("gdb ")]) == 2


@pytest.mark.slow
def test_gdb_stops_in_a_library(tmp_path: Path) -> None:
    if shutil.which("gdb") is None or shutil.which("cmake") is None:
        pytest.skip("gdb or cmake is not installed")
    assert main(["service", "new", "cloud", "--lang", "cpp"]) == 0
    done = subprocess.run(
        [sys.executable, "-m", "rse_pf.cli.main", "service", "debug", "cloud", "--request",
         "cloud/requests/example.json", "--gdb"],
        input="bt 1\ndelete\ncontinue\nquit\n", capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    if "Operation not permitted" in done.stdout + done.stderr:
        pytest.skip("this machine does not allow to trace processes")

    assert "rse_pf_service_call_arrays" in done.stdout
    assert '"radius"' in done.stdout
