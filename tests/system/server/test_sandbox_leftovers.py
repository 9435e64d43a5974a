"""What one robot leaves in its sandbox, in every place that there is; the next robot finds nothing."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import install
from tests.system.server.test_sandbox import until, written

pytestmark = pytest.mark.system

PYTHON = """
from __future__ import annotations
import builtins, ctypes, json, os, resource, signal, socket, sys, msgspec
import numpy as np

class Request(msgspec.Struct):
    do: str

class Reply(msgspec.Struct):
    seen: list[str]

LIBC = ctypes.CDLL(None, use_errno=True)
LEFT = "left-by-a-robot"

def writable():
    return [each for each in ("/scratch", "/tmp", "/dev/shm", "/var/tmp", "/run", "/", "/dev", os.getcwd(),
                              os.path.dirname(__file__)) if os.path.isdir(each)]

class Service:
    held: list[str] = []

    def serve(self, request: Request) -> Reply:
        return Reply(seen=getattr(self, request.do)())

    def leave(self):
        done = []
        for folder in writable():
            try:
                with open(os.path.join(folder, LEFT), "w") as file:
                    file.write(LEFT)
                done.append("file")
            except OSError:
                pass
        os.environ[LEFT] = LEFT
        Service.held.append(LEFT)
        for module in (builtins, json, np, sys, msgspec):
            setattr(module, LEFT, LEFT)
        sys.path.insert(0, "/scratch/" + LEFT)
        self.file = open("/dev/zero", "rb")
        LIBC.prctl(15, LEFT[:15].encode())  # the name of the process
        for attempt in (
            lambda: LIBC.shm_open(b"/left", 0o102, 0o666),
            lambda: LIBC.shmget(4711, 4096, 0o1666),
            lambda: LIBC.msgget(4711, 0o1666),
            lambda: LIBC.semget(4711, 1, 0o1666),
            lambda: LIBC.syscall(248, b"user", b"left", b"x", 1, -4),  # add_key, to the keyring of the user
        ):
            if attempt() >= 0:
                done.append("kernel object")
        try:
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.bind("\\0" + LEFT)
            done.append("abstract socket")
        except OSError:
            pass
        return done

    def find(self):
        found = []
        for folder in writable():
            found += [f"file {folder}" for name in os.listdir(folder) if name == LEFT]
        found += ["environment"] * (LEFT in os.environ)
        found += ["class"] * bool(Service.held)
        found += [f"module {m.__name__}" for m in (builtins, json, np, sys, msgspec) if hasattr(m, LEFT)]
        found += ["path"] * any(LEFT in each for each in sys.path)
        name = ctypes.create_string_buffer(16)
        LIBC.prctl(16, name)
        found += ["name"] * (name.value == LEFT[:15].encode())
        opened = 0
        for fd in range(3, 64):
            try:
                os.fstat(fd)
            except OSError:
                continue
            opened += 1
        found += ["descriptor"] * (opened > 1)  # one leads to the worker
        for what, attempt in (
            ("shm_open", lambda: LIBC.shm_open(b"/left", 0, 0)),
            ("shmget", lambda: LIBC.shmget(4711, 4096, 0)),
            ("msgget", lambda: LIBC.msgget(4711, 0)),
            ("semget", lambda: LIBC.semget(4711, 1, 0)),
            ("key", lambda: LIBC.syscall(249, b"user", b"left", 0, 0)),
        ):
            found += [what] * (attempt() >= 0)
        return found
"""
LUA = """
return function(request)
  local seen = {}
  if request["do"] == "leave" then
    left, string.left, package.loaded.left = "x", "x", "x"
    local mt = getmetatable("") or {}
    mt.left = "x"
    local f = io.open("/scratch/left", "w")
    if f then f:write("x") f:close() end
  else
    if rawget(_G, "left") then seen[#seen + 1] = "global" end
    if string.left then seen[#seen + 1] = "string" end
    if package.loaded.left then seen[#seen + 1] = "package" end
    if (getmetatable("") or {}).left then seen[#seen + 1] = "metatable" end
    local f = io.open("/scratch/left")
    if f then seen[#seen + 1] = "file" f:close() end
  end
  return {seen = table.concat(seen, " ")}
end
"""
CPP = """
#include <cstdlib>
#include <cstdio>
#include <unistd.h>
#include "rse_pf_service.hpp"
static int left_static = 0;
static thread_local int left_of_thread = 0;
struct Leaver {
  int member = 0;
  rse_pf::Fields call(const rse_pf::Fields &request) {
    std::string seen;
    if (request.at("do").text == "leave") {
      left_static = left_of_thread = member = 1;
      setenv("LEFT", "x", 1);
      if (FILE *file = std::fopen("/scratch/left", "w")) std::fclose(file);
    } else {
      if (left_static) seen += "static ";
      if (left_of_thread) seen += "thread ";
      if (member) seen += "member ";
      if (std::getenv("LEFT")) seen += "environment ";
      if (access("/scratch/left", F_OK) == 0) seen += "file ";
    }
    rse_pf::Fields reply;
    reply["seen"] = rse_pf::Field::number(static_cast<double>(seen.size()));
    return reply;
  }
};
RSE_PF_SERVICE(Leaver)
"""


@pytest.fixture
def languages(tmp_path: Path) -> list[str]:
    """Install a service that leaves and finds in each language; return the names."""
    names = ["python"]
    install(written(tmp_path, "python", "python", "service.py", PYTHON), tmp_path / "s")
    try:
        import lupa  # noqa: F401
    except ImportError:
        pass
    else:
        names.append("lua")
        install(written(tmp_path, "lua", "lua", "service.lua", LUA), tmp_path / "s")
    compiler = shutil.which("c++")
    if compiler is not None:
        names.append("native")
        folder = written(tmp_path, "native", "cpp", "leaver.cpp", CPP)
        command = [compiler, "-std=c++17", "-fPIC", "-shared", f"-I{INCLUDE_FOLDER}", "leaver.cpp"]
        subprocess.run([*command, "-o", "lib.so"], cwd=folder, check=True)
        manifest = {"name": "native", "language": "cpp", "entry": "lib.so"}
        (folder / "service.json").write_text(json.dumps(manifest))
        install(folder, tmp_path / "s")
    return names


async def test_a_robot_finds_nothing_that_another_left_in_any_language(start_server, tmp_path, languages):
    """The second robot comes beside the first one, the third gets its place, user id and memory after it."""
    server = start_server(
        keys=True,
        services={"folder": str(tmp_path / "s"), "grace_s": 0.05, "max_sandboxes": 2},
        serving={"workers": 1},
    )

    async def does(robot, what):
        answers = [
            await robot.ask(number, name, {"do": what}, deadline_ms=5000.0)
            for number, name in enumerate(languages, start=100 if what == "find" else 0)
        ]
        return {name: answer.reply["seen"] for name, answer in zip(languages, answers, strict=True)}

    async def after(name):
        async with server.robot(token=server.token(name)) as robot:
            return await does(robot, "find")

    async with (
        server.robot(token=server.token("one")) as one,
        server.robot(token=server.token("two")) as two,
    ):
        left, own, others = await does(one, "leave"), await does(one, "find"), await does(two, "find")
    assert until(lambda: server.status()["isolation"]["sandboxes"] == 0)
    later = [await after(name) for name in ("three", "one")]

    assert set(left["python"]) == {"file"}, "no object of the kernel and no socket could be made"
    assert all(own.values()), "what was left is found by its own robot, so that the search works"
    assert {"environment", "class", "path", "name", "descriptor"} < set(own["python"])
    nothing = {"python": [], "lua": "", "native": 0.0}
    for found in (others, *later):
        assert found == {name: nothing[name] for name in languages}
