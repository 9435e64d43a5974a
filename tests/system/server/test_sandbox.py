"""Sandboxes of a real server: what a service cannot do to the server and to other robots."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from rse_pf.cli.main import main as rse_pf
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import install
from rse_pf.wire import Failure, Result

pytestmark = pytest.mark.system

COUNTER = """
from __future__ import annotations
import ctypes, os, signal, sys, threading, time, msgspec

class Request(msgspec.Struct):
    do: str = "add"

class Reply(msgspec.Struct):
    count: int = 0
    seen: str = ""

class Service:
    def __init__(self):
        self.count = 0
        self.held = []

    def snapshot(self):
        return str(self.count).encode()

    def restore(self, data):
        self.count = int(data)

    def serve(self, request: Request) -> Reply:
        seen = getattr(self, request.do)() or ""
        return Reply(count=self.count, seen=str(seen))

    def look(self): pass
    def add(self): self.count += 1
    def segv(self): ctypes.string_at(0)
    def abort(self): os.abort()
    def leave(self): os._exit(3)
    def exit(self): sys.exit(3)
    def loop(self):
        while True: pass
    def leak(self):
        while True: self.held.append(bytearray(1 << 22))
    def big(self): return "x" * (1 << 30)
    def shout(self):
        for _ in range(20000): print("noise" * 100)
    def fork(self):
        while True: os.fork()
    def threads(self):
        for _ in range(100000): threading.Thread(target=time.sleep, args=(100,), daemon=True).start()
    def socket(self):
        import socket
        socket.socket()
    def program(self): os.execv("/usr/bin/true", ["true"])
    def others(self): return sorted(os.listdir("/proc")) if os.path.isdir("/proc") else ""
    def signal(self): os.kill(-1, signal.SIGKILL)
    def write_code(self): open(__file__, "a").write("x = 1")
    def files(self, *names):
        found = []
        for folder, below, files in os.walk("/"):
            large = ("/usr", sys.prefix, sys.base_prefix)
            below[:] = [b for b in below if os.path.join(folder, b) not in large]
            found += [os.path.join(folder, name) for name in files if name in names]
        return found
    def read_keys(self): return self.files("keys.json", "key.json")
    def environment(self): return sorted(os.environ)
    def fill_disk(self):
        with open("full", "wb") as file:
            while True: file.write(b"x" * (1 << 20))
    def leave_note(self): open("note", "w").write("mine")
    def find_note(self): return self.files("note")
    def descriptors(self):
        found = []
        for fd in range(3, 256):
            try: os.fstat(fd)
            except OSError: continue
            found.append(fd)
        return len(found)
"""

HOSTILE_LUA = {
    "ffi_read0": "local ffi = require 'ffi' return ffi.cast('int*', 0)[0]",
    "ffi_system": "local f = require 'ffi' f.cdef 'int system(const char *);' return f.C.system('true') == 0",
    "os_execute": "return os.execute('true') == 0",
    "io_open": "return io.open('/etc/hostname'):read('*a')",
    "popen": "return io.popen('id'):read('*a')",
    "py_eval": "return python.eval('1')",
    "py_builtins": "return python.builtins.__import__('os').getpid()",
    "loadlib": "return tostring(package.loadlib('libc.so.6', 'system')('true'))",
    "loop": "while true do end",
    "mem": "local t = {} for i = 1, 1e9 do t[i] = ('x'):rep(1000) .. i end return #t",
    "strrep": "return #(('x'):rep(2 ^ 31))",
    "recursion": "local function f() return 1 + f() end return f()",
    "pattern": "return tostring((('a'):rep(40)):find(('a*'):rep(40) .. 'b'))",
    "debug": "return tostring(debug.getregistry ~= nil)",
    "bytecode": "return load(string.dump(function() return 7 end))()",
}
HARMLESS = {"debug", "bytecode", "loadlib"}
"""These may succeed: they reach the robot's own process only, where system() cannot start a program."""

HOSTILE_CPP = """
#include <fcntl.h>
#include <sys/socket.h>
#include <unistd.h>
#include <cerrno>
#include "rse_pf_service.hpp"
struct Hostile {
  rse_pf::Fields call(const rse_pf::Fields &request) {
    const std::string &what = request.at("do").text;
    double got = -1;
    if (what == "read0") got = *static_cast<volatile char *>(nullptr);
    if (what == "fork") got = fork();
    if (what == "socket") got = socket(AF_INET, SOCK_STREAM, 0);
    if (what == "file") got = open(request.at("path").text.c_str(), O_RDONLY);
    rse_pf::Fields reply;
    reply["got"] = rse_pf::Field::number(got);
    return reply;
  }
};
RSE_PF_SERVICE(Hostile)
"""


def written(folder: Path, name: str, language: str, entry: str, source: str, kind: str = "stateless") -> Path:
    """Write a service folder."""
    made = folder / name
    made.mkdir()
    (made / "service.json").write_text(
        json.dumps({"name": name, "language": language, "entry": entry, "kind": kind})
    )
    (made / entry).write_text(source)
    return made


@pytest.fixture
def services(tmp_path):
    """A services folder with a stateful and a stateless Python service."""
    install(written(tmp_path, "counter", "python", "service.py", COUNTER, "per_robot_state"), tmp_path / "s")
    plain = COUNTER.replace("def snapshot", "def no_snapshot")
    install(written(tmp_path, "worker", "python", "service.py", plain), tmp_path / "s")
    return tmp_path / "s"


@pytest.fixture
def serve_isolated(start_server, services, tmp_path):
    """A function that starts a server with them."""

    def start(**more):
        chosen = {"folder": str(services), "grace_s": 0.2, "breaker_crashes": 1000, **more}
        store = f"dir:{tmp_path / 'store'}"
        return start_server(keys=True, services=chosen, data={"store": store})

    return start


def ask_all(server, robot_name, asks, deadline_ms=3000.0):
    """Return the answers to one robot's requests, sent one after the other."""

    async def run():
        async with server.robot(token=server.token(robot_name)) as robot:
            return [
                await robot.ask(i, service, payload, deadline_ms=deadline_ms, keep=True)
                for i, (service, payload) in enumerate(asks)
            ]

    return asyncio.run(run())


def children(pid):
    """Return the pids below *pid*."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found += [int(stat.parent.name), *children(int(stat.parent.name))]
    return found


def until(condition, within_s=10.0):
    """Wait until *condition* is true, with a deadline; return its last value."""
    end = time.monotonic() + within_s
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return value


async def test_each_robot_has_a_process_and_a_count_of_its_own(serve_isolated):
    server = serve_isolated()

    async with (
        server.robot(token=server.token("robot-1")) as one,
        server.robot(token=server.token("robot-2")) as two,
    ):
        assert [
            (await robot.ask(i, "counter", {})).reply["count"] for i, robot in enumerate([one, one, two])
        ] == [1, 2, 1]


def test_a_crash_is_one_typed_failure_and_does_not_affect_other_robots(serve_isolated):
    server = serve_isolated()

    async def run(crash):
        async with (
            server.robot(token=server.token(f"victim-{crash}")) as victim,
            server.robot(token=server.token(f"other-{crash}")) as other,
        ):
            await other.ask(0, "counter", {})
            failure = await victim.ask(1, "worker", {"do": crash}, keep=True)
            return failure, await victim.ask(3, "worker", {}), await other.ask(4, "counter", {})

    for number, crash in enumerate(("segv", "abort", "leave"), 1):
        failure, after, other = asyncio.run(run(crash))
        assert isinstance(failure, Failure)
        assert failure.code == "poison", "it was tried twice, and crashed two sandboxes"
        assert isinstance(after, Result)
        assert other.reply["count"] == 2
        assert until(lambda: server.status()["isolation"]["counts"].get("crashed", 0) >= 2 * number)  # noqa: B023  called at once
        assert server.status()["isolation"]["counts"]["crashed"] == 2 * number


def test_what_is_forbidden_is_a_typed_failure_and_the_server_keeps_running(serve_isolated):
    server = serve_isolated()
    before = server.status()["resident_bytes"]
    harms = ["exit", "leak", "big", "fork", "threads", "socket", "program", "write_code", "fill_disk"]

    for harm in harms:
        asks = [("worker", {"do": harm}), ("worker", {"do": "look"})]
        failure, after = ask_all(server, harm, asks)
        assert isinstance(failure, Failure), harm
        assert failure.code in ("internal", "poison", "too-large", "worker-lost"), harm
        assert isinstance(after, Result), harm
    assert server.status()["resident_bytes"] - before < 32 << 20


def test_a_sandbox_sees_neither_keys_nor_other_processes_nor_open_files(serve_isolated):
    server = serve_isolated()
    asks = [("worker", {"do": what}) for what in ("read_keys", "others", "environment", "descriptors")]
    keys, others, environment, descriptors = (answer.reply["seen"] for answer in ask_all(server, "a", asks))

    assert keys == ""
    assert others in ("", "['1']")
    assert environment == "['HOME', 'LANG', 'PATH', 'TMPDIR']"
    assert int(descriptors) <= 1, "the IPC socket, and nothing inherited"


async def test_an_endless_loop_is_expired_and_killed_and_the_next_command_is_answered(serve_isolated):
    server = serve_isolated()

    async with server.robot(token=server.token("robot-1")) as robot:
        late = await robot.ask(1, "worker", {"do": "loop"}, deadline_ms=300.0, keep=True)
        after = await robot.ask(2, "worker", {"do": "look"}, deadline_ms=30e3, keep=True)
    assert late.code == "expired"
    assert isinstance(after, Result)
    killed = server.wait_for_log("sandbox-overran")
    assert "too long" in killed["reason"]


def test_a_poison_request_crashes_two_sandboxes_however_often_it_is_sent(serve_isolated):
    server = serve_isolated()
    asks = [("worker", {"do": "segv"})] * 5 + [("worker", {"do": "look"})] * 20
    answers = ask_all(server, "robot-1", asks)

    assert [answer.code for answer in answers[:5]] == ["poison"] * 5
    assert all(isinstance(answer, Result) for answer in answers[5:])
    assert until(lambda: server.status()["isolation"]["counts"].get("crashed", 0) >= 2)
    assert server.status()["isolation"]["counts"]["crashed"] == 2


def test_a_service_that_crashes_repeatedly_opens_its_circuit_breaker_and_readyz_reports_it(serve_isolated):
    server = serve_isolated(breaker_crashes=3)
    crashes = [("worker", {"do": what}) for what in ("segv", "abort", "leave")]
    answers = ask_all(server, "robot-1", [*crashes, ("worker", {"do": "look"})])

    assert answers[3].code == "worker-lost"
    assert answers[3].retry_after_ms > 1000
    assert isinstance(ask_all(server, "robot-2", [("worker", {"do": "look"})])[0], Result)
    for robot in ("robot-3", "robot-4"):
        ask_all(server, robot, crashes[:1])
    assert ask_all(server, "robot-5", [("worker", {"do": "look"})])[0].code == "worker-lost"
    status, _, body = server.http("/readyz")
    assert status == 200, "the server itself is healthy"
    assert json.loads(body)["open_breakers"] == ["worker"]


def test_an_operator_sees_and_lifts_what_is_refused_after_crashes(serve_isolated, capsys):
    server = serve_isolated(breaker_crashes=4)
    look = [("worker", {"do": "look"})]
    ask_all(server, "robot-1", [("worker", {"do": what}) for what in ("segv", "abort")])
    port = ["--control-port", str(server.identity["control_port"])]
    assert ask_all(server, "robot-1", look)[0].code == "worker-lost"

    assert rse_pf(["service", "status", *port]) == 0
    seen = capsys.readouterr().out
    assert rse_pf(["service", "unblock", "worker", "--robot", "robot-1", *port]) == 0
    lifted = capsys.readouterr().out

    assert "robot default/robot-1  crashes" in seen
    assert "robot default/robot-1  2 poison requests" in seen
    assert "worker is no longer refused to robot default/robot-1 (crashes)" in lifted
    assert isinstance(ask_all(server, "robot-1", look)[0], Result)
    assert json.loads(server.http("/blocks")[2])["blocks"] == []
    assert server.wait_for_log("unblock")["lifted"] == 2
    assert server.http("/unblock?robot=robot-1", "POST")[0] == 400


def test_a_sandbox_ends_with_its_robot_and_leaves_no_process_or_descriptor(serve_isolated):
    server = serve_isolated()
    (worker,) = server.workers
    zygote = children(worker)
    descriptors = len(os.listdir(f"/proc/{worker}/fd"))
    ask_all(server, "robot-1", [("worker", {"do": "leave_note"}), ("counter", {})])

    assert until(lambda: children(worker) == zygote)
    assert until(lambda: len(os.listdir(f"/proc/{worker}/fd")) <= descriptors)


def test_a_reconnect_within_the_grace_period_keeps_the_state_without_a_store(serve_isolated):
    server = serve_isolated(grace_s=5.0)

    first = ask_all(server, "robot-1", [("worker", {}), ("worker", {})])
    second = ask_all(server, "robot-1", [("worker", {})])

    assert [answer.reply["count"] for answer in first] == [1, 2]
    assert second[0].reply["count"] == 3


def test_state_survives_the_crash_of_its_server(serve_isolated, gone):
    first = serve_isolated()
    assert ask_all(first, "robot-1", [("counter", {}), ("counter", {})])[-1].reply["count"] == 2
    pids = [first.process.pid, *children(first.process.pid)]
    first.process.kill()
    for pid in pids[1:]:
        gone(pid)
    second = serve_isolated()
    assert ask_all(second, "robot-1", [("counter", {})])[0].reply["count"] == 3


async def test_a_sandbox_whose_state_was_changed_on_another_server_does_not_answer_with_older_state(
    serve_isolated,
):
    first, second = serve_isolated(), serve_isolated()

    tokens = first.token("robot-1"), second.token("robot-1")
    async with first.robot(token=tokens[0]) as old, second.robot(token=tokens[1]) as new:
        assert (await old.ask(1, "counter", {})).reply["count"] == 1
        assert (await new.ask(1, "counter", {})).reply["count"] == 2
        stale, after = [await old.ask(i, "counter", {}, keep=True) for i in (2, 3)]
    assert (getattr(stale, "code", stale), after.reply["count"]) == ("worker-lost", 3)


def test_robots_beyond_the_capacity_are_busy_until_another_robot_leaves(serve_isolated):
    server = serve_isolated(max_sandboxes=2)

    async def run():
        async with server.robot(token=server.token("three")) as three:
            async with (
                server.robot(token=server.token("one")) as one,
                server.robot(token=server.token("two")) as two,
            ):
                await one.ask(1, "worker", {})
                await two.ask(2, "worker", {})
                busy = await three.ask(3, "worker", {})
            while True:
                answer = await three.ask(4, "worker", {})
                if isinstance(answer, Result):
                    return busy

    busy = asyncio.run(asyncio.wait_for(run(), 10))
    assert busy.code == "busy"
    assert busy.retry_after_ms > 0


def test_a_tenant_that_holds_every_sandbox_and_always_works_gives_one_to_another_tenant(serve_isolated):
    server = serve_isolated(max_sandboxes=2)

    async def ask_for_ever(robot):
        for i in itertools.count(2):
            await robot.ask(i, "worker", {}, keep=True)

    async def run():
        async with (
            server.robot(token=server.token("one", tenant="rival")) as one,
            server.robot(token=server.token("two", tenant="rival")) as two,
            server.robot(token=server.token("three")) as three,
        ):
            await one.ask(1, "worker", {}, keep=True)
            await two.ask(1, "worker", {}, keep=True)
            rivals = [asyncio.create_task(ask_for_ever(robot)) for robot in (one, two)]
            ids = itertools.count(1)
            while not isinstance(await three.ask(next(ids), "worker", {}, keep=True), Result):
                pass
            answers = [await three.ask(next(ids), "worker", {}, keep=True) for _ in range(20)]
            for task in rivals:
                task.cancel()
            return answers

    answers = asyncio.run(asyncio.wait_for(run(), 20))
    assert all(isinstance(answer, Result) for answer in answers)


async def test_robots_are_served_again_after_the_zygote_was_killed(serve_isolated):
    server = serve_isolated()
    (worker,) = server.workers

    async with server.robot(token=server.token("robot-1")) as robot:
        await robot.ask(1, "counter", {})
        os.kill(children(worker)[0], 9)
        while not isinstance(answer := await robot.ask(2, "counter", {}), Result):
            pass
        assert answer.reply["count"] >= 2


def test_hostile_lua_stays_in_its_sandbox(start_server, tmp_path):
    for name, script in HOSTILE_LUA.items():
        source = f"return function(request) return {{got = (function() {script} end)()}} end"
        install(written(tmp_path, name, "lua", "service.lua", source), tmp_path / "s")
    server = start_server(
        keys=True,
        services={"folder": str(tmp_path / "s"), "memory_bytes": 300_000_000, "breaker_crashes": 1000},
    )

    for name in HOSTILE_LUA:
        (answer,) = ask_all(server, name, [(name, {})], deadline_ms=1000.0)
        if isinstance(answer, Result):
            got = answer.reply.get("got")
            assert name in HARMLESS or got in (False, -1, None, "nil"), f"{name} got {got!r}"
        assert server.http("/readyz")[0] == 200
        assert ask_all(server, "bystander", [("echo", {"value": 1})])[0].reply == {"value": 1}


def test_a_hostile_library_stays_in_its_sandbox(start_server, tmp_path):
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no compiler for C++ is installed")
    folder = written(tmp_path, "hostile", "cpp", "hostile.cpp", HOSTILE_CPP)
    subprocess.run(
        [compiler, "-std=c++17", "-fPIC", "-shared", f"-I{INCLUDE_FOLDER}", "hostile.cpp", "-o", "lib.so"],
        cwd=folder, check=True,
    )  # fmt: skip
    manifest = {"name": "hostile", "language": "cpp", "entry": "lib.so"}
    (folder / "service.json").write_text(json.dumps(manifest))
    install(folder, tmp_path / "s")
    secret = tmp_path / "secret"
    secret.write_text("of another robot")
    secret.chmod(0o644)
    server = start_server(keys=True, services={"folder": str(tmp_path / "s"), "breaker_crashes": 1000})
    asks = [("hostile", {"do": what, "path": str(secret)}) for what in ("read0", "fork", "socket", "file")]

    read0, fork, socket, file = ask_all(server, "robot-1", asks)

    assert read0.code == "poison"
    assert [answer.reply["got"] for answer in (fork, socket, file)] == [-1, -1, -1]


@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to become a plain user")
def test_a_plain_user_has_the_same_isolation(tmp_path):
    python = shutil.which("python3", path="/usr/bin")
    if python is None or shutil.which("setpriv") is None:
        pytest.skip("no python3 outside of this user's home, or no setpriv")
    package = Path(__file__).resolve().parents[3] / "rse_pf"
    copied = tmp_path / "rse_pf" / "server" / "sandbox"
    processes = tmp_path / "rse_pf" / "processes"
    for folder in (copied, processes):
        folder.mkdir(parents=True)
    for source in ("server/sandbox/isolation.py", "server/sandbox/seccomp.py", "processes/linux.py"):
        (tmp_path / "rse_pf" / source).write_text((package / source).read_text())
        (tmp_path / "rse_pf" / source).chmod(0o644)
    for folder in (processes, copied, *copied.parents):
        if folder != Path("/tmp") and folder.is_relative_to("/tmp"):
            folder.chmod(0o755)
    script = f"""
import os, sys
sys.dont_write_bytecode = True
sys.path.insert(0, {str(tmp_path)!r})
from pathlib import Path
from rse_pf.server.sandbox import isolation
assert isolation.__file__.startswith({str(tmp_path)!r}), isolation.__file__
def root():
    isolation.enter_namespaces()
    isolation.make_root([Path("/usr")], 1 << 20, os.getuid())
    assert sorted(os.listdir("/")) == ["dev", "scratch", "tmp", "usr"], os.listdir("/")
def syscalls():
    isolation.forbid_system_calls()
    import socket
    for forbidden in (socket.socket, os.fork):
        try:
            forbidden()
        except PermissionError:
            continue
        raise AssertionError(forbidden)
tries = (isolation.enter_namespaces, root, lambda: isolation.give_up_privileges(None), syscalls)
print(os.getuid(), isolation.missing_isolation(tries))
"""
    done = subprocess.run(
        ["setpriv", "--reuid", "12345", "--regid", "12345", "--clear-groups", python, "-c", script],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip

    assert done.stdout.strip() == "12345 []", done.stderr


def test_without_a_services_folder_there_is_no_zygote(start_server):
    server = start_server()

    assert children(server.workers[0]) == []
