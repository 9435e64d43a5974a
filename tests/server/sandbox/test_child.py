"""One sandbox without a worker: what a service can do in it, what it can read, and what is refused."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.processes.ipc import encode_message, receive
from rse_pf.server.sandbox import isolation
from rse_pf.server.sandbox.child import readable_paths
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import read_service

pytestmark = pytest.mark.system

MEMORY, SCRATCH = 536_870_912, 4_194_304
ONE_SANDBOX = Path(__file__).with_name("one_sandbox.py")
WAIT_S = 20
ASK = """
from __future__ import annotations
import asyncio, concurrent.futures, ctypes, errno, fcntl, os, resource, shutil, sqlite3, tempfile, threading
import time, zoneinfo
import msgspec
import numpy as np

class Request(msgspec.Struct):
    do: str

class Reply(msgspec.Struct):
    got: dict

LIBC = ctypes.CDLL(None, use_errno=True)

def serve(request: Request) -> Reply:
    return Reply(got=globals()[request.do]())

def why(function, *arguments):
    try:
        function(*arguments)
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"

def call(name, *arguments):
    ctypes.set_errno(0)
    return errno.errorcode.get(ctypes.get_errno()) if getattr(LIBC, name)(*arguments) == -1 else "done"

def honest():
    tempfile.tempdir = None  # of the process that was forked
    with tempfile.TemporaryDirectory() as folder:
        with open(f"{folder}/a", "w") as file:
            file.write("a" * 100_000)
            file.flush()
            os.fsync(file.fileno())
        shutil.copy2(f"{folder}/a", f"{folder}/b")
        os.replace(f"{folder}/b", f"{folder}/c")
        shutil.copytree(folder, f"{folder}-copy")
        shutil.rmtree(f"{folder}-copy")
        files = sorted(os.listdir(folder))
    array = np.memmap("m", mode="w+", shape=(1000,))
    array[:] = 1
    array.flush()
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        total = sum(pool.map(abs, range(100)))
    async def loop():
        return await asyncio.to_thread(threading.get_native_id) != await asyncio.sleep(0.001, 1)
    compared = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    LIBC.qsort((ctypes.c_int * 3)(3, 1, 2), 3, 4, compared(lambda a, b: 0))
    base = sqlite3.connect("file:kept.db?nolock=1", uri=True)
    base.execute("create table t (a)")
    base.execute("insert into t values (1)")
    base.commit()
    time.sleep(0.001)
    solved = np.linalg.solve(np.eye(50), np.ones(50)).sum().item()
    zone = str(zoneinfo.ZoneInfo("UTC"))
    return {"files": files, "total": total, "loop": asyncio.run(loop()), "solved": solved, "zone": zone}

def abort(): os.abort()

def refused():
    lock = os.open("lock", os.O_CREAT | os.O_RDWR)
    return {
        "System V memory": call("shmget", 0, 1 << 20, 0o1600),
        "System V messages": call("msgget", 0, 0o1600),
        "System V semaphores": call("semget", 0, 1, 0o1600),
        "memory file": why(os.memfd_create, "a"),
        "lock of a file": why(fcntl.lockf, lock, fcntl.LOCK_EX),
        "lease of a file": why(fcntl.fcntl, lock, 1024, 1),
        "survive the zygote": call("prctl", 1, 0, 0, 0, 0),
        "own scheduling": why(os.sched_setscheduler, 0, os.SCHED_BATCH, os.sched_param(0)),
        "own processors": why(os.sched_setaffinity, 0, {0}),
        "pipe": why(os.pipe),
        "process": why(os.fork),
        "program": why(os.execv, "/bin/true", ["true"]),
        "device": why(os.mknod, "device", 0o20600, 0),
        "named pipe": why(os.mkfifo, "pipe"),
        "attribute of a file": why(os.setxattr, "lock", "user.a", b"x"),
        "root folder": why(os.mkdir, "/mine"),
    }

def entries():
    found = []
    for folder, below, files in os.walk("/"):
        found += [folder, *(os.path.join(folder, name) for name in files)]
        below[:] = [name for name in below if os.path.join(folder, name) not in msgspec.json.decode(KNOWN)]
    return {"found": found}

def writable():
    wanted = os.ST_RDONLY | os.ST_NOSUID | os.ST_NODEV
    known = msgspec.json.decode(KNOWN)
    flags = {name: os.statvfs(name).f_flag for name in known if os.path.exists(name)}
    return {"found": [name for name, flag in flags.items() if flag & wanted != wanted], "of": len(flags)}

def heap():
    held = []
    try:
        while True:
            held.append(b"x" * (1 << 20))
    except MemoryError:
        return {"bytes": len(held) << 20, "limit": resource.getrlimit(resource.RLIMIT_AS)}

def limits():
    names = "FSIZE", "NOFILE", "CORE", "MEMLOCK", "MSGQUEUE"
    return {name: resource.getrlimit(getattr(resource, f"RLIMIT_{name}")) for name in names}

def inodes():
    made, longest = 0, "n" * 240
    try:
        while True:
            os.close(os.open(f"{longest}{made}", os.O_CREAT | os.O_WRONLY))
            made += 1
    except OSError as error:
        return {"made": made, "why": errno.errorcode[error.errno]}

def disk():
    written = 0
    try:
        for number in range(100):
            with open(str(number), "wb", buffering=0) as file:
                written += sum(file.write(b"x" * 65536) for _ in range(16))
    except OSError as error:
        return {"bytes": written, "why": errno.errorcode[error.errno]}
"""
LUA = """
local ffi, json, zlib = require "ffi", require "json", require "zlib"
ffi.cdef "void *malloc(size_t); void free(void *); int usleep(unsigned); int socket(int, int, int);"
ffi.cdef "int fork(void); int shmget(int, size_t, int);"
return function(request)
  local file = assert(io.open("/scratch/a", "w"))
  file:write(("x"):rep(100000)); file:close()
  assert(os.rename("/scratch/a", "/scratch/b")); assert(os.remove("/scratch/b"))
  local sum = 0
  for i = 1, 1e6 do sum = sum + i % 7 end
  ffi.C.free(ffi.C.malloc(1e7)); ffi.C.usleep(1000)
  assert(zlib.inflate(zlib.deflate(("ab"):rep(10000))) == ("ab"):rep(10000))
  local refused = {ffi.C.socket(2, 1, 0), ffi.C.fork(), ffi.C.shmget(0, 4096, 896)}
  return {sum = sum, refused = refused, now = os.time() > 0}
end
"""
C = """
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
#include "rse_pf_service.h"
static void *add(void *n) {
  char *held = memset(malloc(1 << 20), 1, 1 << 20);
  *(int *)n += held[5];
  free(held);
  return 0;
}
uint32_t rse_pf_service_abi(void) { return RSE_PF_SERVICE_ABI; }
int rse_pf_service_open(const char *scratch, void **state) { *state = 0; return scratch[0] != '/'; }
void rse_pf_service_close(void *state) { (void)state; }
void rse_pf_service_free(void *state, void *memory) { (void)state; free(memory); }
int rse_pf_service_call(void *state, const uint8_t *request, uint64_t size, uint8_t **reply,
                        uint64_t *reply_size) {
  (void)state; (void)request; (void)size;
  int n = 0;
  pthread_t thread;
  for (int i = 0; i < 3; ++i)
    if (pthread_create(&thread, 0, add, &n) || pthread_join(thread, 0)) return RSE_PF_FAILED;
  FILE *file = fopen("a", "w");
  if (!file || fputs("text", file) < 0 || fclose(file) || rename("a", "b") || remove("b"))
    return RSE_PF_FAILED;
  struct timespec nap = {0, 1000000};
  nanosleep(&nap, 0);
  int pair[2];
  char *text = malloc(200);
  *reply_size = snprintf(text, 200, "{\\"threads\\": %d, \\"refused\\": [%d, %d, %d, %d]}", n,
                         socket(AF_INET, SOCK_STREAM, 0), socketpair(AF_UNIX, SOCK_STREAM, 0, pair), fork(),
                         memfd_create("a", 0));
  *reply = (uint8_t *)text;
  return RSE_PF_OK;
}
"""
EXAMPLES = Path(__file__).parents[3] / "examples" / "services"
Ask = Callable[[Any], Any]


@pytest.fixture
def sandbox(tmp_path: Path) -> Iterator[Callable[[str, str, str], Ask]]:
    """A function that starts a sandbox with one service and returns what sends it a request."""
    started: list[tuple[subprocess.Popen[bytes], socket.socket]] = []

    def start(language: str, entry: str, source: str = "") -> Ask:
        manifest = {"name": "tried", "language": language, "entry": entry}
        (tmp_path / "service.json").write_text(json.dumps(manifest))
        if source:
            (tmp_path / entry).write_text(source)
        tmp_path.chmod(0o755)
        ours, theirs = socket.socketpair()
        command = [sys.executable, ONE_SANDBOX, tmp_path, theirs.fileno(), MEMORY, SCRATCH]
        process = subprocess.Popen([str(each) for each in command], pass_fds=(theirs.fileno(),))
        theirs.close()
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", WAIT_S, 0))
        started.append((process, ours))
        assert receive(ours) == ["ready"]

        def ask(payload: Any) -> Any:
            ours.sendall(encode_message(["call", "tried", payload]))
            return receive(ours)

        return ask

    yield start
    for process, channel in started:
        channel.close()  # at which a sandbox ends
        process.wait(WAIT_S)


@pytest.fixture
def ask(sandbox: Callable[..., Ask], tmp_path: Path) -> Callable[[str], dict[str, Any]]:
    """A function that has the Python service do something, and returns what came of it."""
    service = read_service(_manifest(tmp_path))
    known = json.dumps(json.dumps([str(path) for path in readable_paths([service])]))
    send = sandbox("python", "service.py", f"{ASK}\nKNOWN = {known}\n")

    def do(what: str) -> dict[str, Any]:
        answer = send({"do": what})
        assert answer[0] is True, answer
        return dict(answer[1]["got"])

    return do


def _manifest(folder: Path) -> Path:
    manifest = {"name": "tried", "language": "python", "entry": "service.py"}
    (folder / "service.json").write_text(json.dumps(manifest))
    return folder


def test_a_python_service_may_use_files_threads_event_loops_and_native_libraries(ask):
    assert ask("honest") == {
        "files": ["a", "c"], "total": 4950, "loop": True, "solved": 50.0, "zone": "UTC",
    }  # fmt: skip


def test_a_lua_service_may_use_files_and_libraries_and_starts_nothing(sandbox):
    pytest.importorskip("lupa", reason="the extra services is not installed")

    answer = sandbox("lua", "service.lua", LUA)({})

    assert answer[:2] == [True, {"sum": 2999998, "refused": [-1, -1, -1], "now": True}]


def test_a_native_service_may_use_threads_and_files_and_starts_nothing(sandbox, tmp_path):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no compiler for C is installed")
    (tmp_path / "s.c").write_text(C)
    command = [compiler, "-D_GNU_SOURCE", "-fPIC", "-shared", "-pthread", f"-I{INCLUDE_FOLDER}", "s.c"]
    subprocess.run([*command, "-o", "lib.so"], cwd=tmp_path, check=True)

    answer = sandbox("cpp", "lib.so")({})

    assert answer[:2] == [True, {"threads": 3, "refused": [-1, -1, -1, -1]}]


def test_what_has_no_limit_or_reaches_beyond_the_sandbox_is_refused(ask):
    got = ask("refused")

    assert got.pop("root folder") == "EROFS"
    assert set(got.values()) == {"EPERM"}, got


def test_nothing_but_modules_libraries_and_the_service_can_be_read(ask, tmp_path):
    allowed = {str(path) for path in readable_paths([read_service(tmp_path)])}
    folders_on_the_way = {str(parent) for path in allowed for parent in Path(path).parents}
    own = {"/dev", "/dev/null", "/dev/zero", "/dev/urandom", "/scratch"}

    found = set(ask("entries")["found"])

    assert found <= allowed | folders_on_the_way | own, found - allowed - folders_on_the_way - own
    assert own - {"/dev"} <= found


def test_all_that_can_be_read_is_mounted_read_only_without_devices_and_set_user_ids(ask):
    writable = ask("writable")

    assert writable["found"] == []
    assert writable["of"] >= 4


def test_the_readable_paths_hold_no_program_home_setting_or_other_service(tmp_path):
    paths = readable_paths([read_service(_manifest(tmp_path))])

    def readable(name: str) -> bool:
        return any(Path(name).is_relative_to(path) for path in paths if not path.is_symlink())

    secret = (
        "/usr/bin", "/usr/sbin", "/usr/local", "/usr/local/bin", "/usr/local/share", "/usr/share",
        "/usr/src", "/bin", "/etc", "/etc/passwd", "/home", "/proc",
        "/sys", "/var", "/opt", "/srv",
        str(Path.home()), str(Path.home() / ".ssh"), str(Path.cwd() / "tests"),
        sys.prefix, f"{sys.prefix}/bin", f"{sys.base_prefix}/bin",
        str(tmp_path.parent), str(tmp_path.parent / "other-service"),
    )  # fmt: skip
    assert [name for name in secret if readable(name)] == []
    assert readable(json.__file__), "Python's own modules"
    assert readable(isolation.__file__), "this package"
    assert readable(str(tmp_path / "service.json")), "the service"


def test_memory_files_and_their_number_end_at_the_limit(ask):
    heap = ask("heap")
    assert heap["limit"] == [MEMORY - SCRATCH] * 2, "the scratch folder is part of the memory"
    assert heap["bytes"] <= MEMORY - SCRATCH
    made = ask("inodes")
    assert made["why"] == "ENOSPC"
    assert made["made"] <= SCRATCH // 4096


def test_no_limit_of_a_sandbox_can_be_raised(ask):
    limits = {"FSIZE": SCRATCH, "NOFILE": 64, "CORE": 0, "MEMLOCK": 0, "MSGQUEUE": 0}

    assert ask("limits") == {name: [limit] * 2 for name, limit in limits.items()}


@pytest.mark.slow
@pytest.mark.parametrize("example", ["icp-python", "icp-cpp", "icp-lua", "pnp-lua"])
def test_every_example_answers_its_recorded_requests_in_a_sandbox(tmp_path, example):
    if example != "icp-python" and shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    shutil.copytree(EXAMPLES, tmp_path / "services", ignore=shutil.ignore_patterns("build"))

    done = subprocess.run(
        [sys.executable, "-m", "rse_pf.cli.main", "service", "test", str(tmp_path / "services" / example)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip

    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 of 2 recorded requests as expected" in done.stdout
    assert "isolation" not in done.stdout + done.stderr, "a means of isolation is missing here"
