"""Measure what hostile services take: memory, threads and inodes of the machine, and time of other robots.

    python -m benchmarks hostile.services [--only memory cpu] [--seconds 60]

One row per attack.  ``peak_mib`` is what the machine lost to the sandbox: its pages, shared ones in part,
and the growth of shared memory and kernel memory meanwhile; the limit is that of `services.memory_bytes`.
The time of other robots is measured in turns with and without the hostile robot.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import percentile
from benchmarks.hostile.sandboxes import Answers, Row, Server, pnp_robot, serving
from rse_pf.errors import RsePfError
from rse_pf.linux import cpu_seconds, proportional_bytes
from rse_pf.services.custom.installed import install

MIB = 1 << 20
MEMORY_BYTES, SCRATCH_BYTES = 512 * MIB, 16 * MIB
HOSTILE = """
from __future__ import annotations
import ctypes, hashlib, mmap, os, socket, threading, time, msgspec

libc = ctypes.CDLL(None, use_errno=True)
HELD = []
BLOCK = bytes(1 << 20)

class Request(msgspec.Struct):
    do: str = "look"
    seconds: float = 0.0

class Reply(msgspec.Struct):
    got: str = ""

def touched(size):
    block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    for at in range(0, size, 4096): block[at] = 1
    return block

def heap():
    size = 16 << 20
    while True:
        try: HELD.append(touched(size))
        except (OSError, MemoryError):
            if size == 4096: return
            size = max(4096, size // 2)

def scratch():
    with open(f"full-{len(HELD)}", "wb") as file:
        while True: file.write(b"x" * (1 << 16))

def heap_and_scratch():
    try: scratch()
    except OSError: pass
    heap()

def inodes():
    for i in range(3_000_000): os.close(os.open(f"f{i}", os.O_CREAT | os.O_WRONLY))

def pages():
    block = mmap.mmap(-1, 256 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x4000)
    for at in range(0, 256 << 20, 1 << 21): block[at] = 1
    heap()

def threads():
    while True:
        t = threading.Thread(target=time.sleep, args=(99,), daemon=True)
        t.start(); HELD.append(t)

def processes():
    while True: HELD.append(os.fork())

def sysv():
    while True:
        number = libc.shmget(0, ctypes.c_size_t(64 << 20), 0o1600)
        if number < 0: raise OSError(ctypes.get_errno(), "shmget")
        libc.shmat.restype = ctypes.c_void_p
        at = libc.shmat(number, None, 0)
        ctypes.memset(at, 1, 64 << 20)
        libc.shmdt(ctypes.c_void_p(at))

def memfd():
    while True:
        fd = os.memfd_create("x")
        HELD.append(fd)
        for _ in range(64): os.write(fd, b"x" * (1 << 20))

def pipes():
    import fcntl
    while True:
        r, w = os.pipe()
        HELD.append((r, w))
        try: fcntl.fcntl(w, 1031, 1 << 20)
        except OSError: pass
        os.set_blocking(w, False)
        try:
            while True: os.write(w, b"x" * 65536)
        except BlockingIOError: pass

def sockets():
    while True:
        a, b = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        HELD.append((a, b))
        a.setblocking(False)
        try:
            while True: a.send(b"x" * 4096)
        except BlockingIOError: pass

def burn(end):
    while time.monotonic() < end: hashlib.sha256(BLOCK).digest()  # without the interpreter's lock

def serve(request: Request) -> Reply:
    end = time.monotonic() + request.seconds
    if request.do in ("work_on", "work_in"):
        for _ in range(6): threading.Thread(target=burn, args=(end,), daemon=True).start()
        if request.do == "work_in": burn(end)
    elif request.do != "look":
        globals()[request.do]()
        time.sleep(request.seconds)  # keeps what it took, so that it can be measured
    return Reply(got="no refusal")
"""
MEMORY = (
    "heap", "scratch", "heap_and_scratch", "inodes", "pages", "threads", "processes", "sysv", "memfd",
    "pipes", "sockets",
)  # fmt: skip


def shared_and_kernel_bytes() -> int:
    """Return the machine's shared memory, slab, stacks of threads and page tables."""
    lines = (line.split() for line in Path("/proc/meminfo").read_text().splitlines())
    names = ("Shmem:", "SUnreclaim:", "KernelStack:", "PageTables:")
    return 1024 * sum(int(words[1]) for words in lines if words[0] in names)


def sandbox_pids(server: Server) -> list[int]:
    """Return the first processes of the sandboxes: what a sandbox's parent, the zygote, forked."""
    return [pid for pid in server.processes() if b"zygote" in _command_line(_parent(pid))]


def _parent(pid: int) -> int:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


async def memory(folder: Path) -> list[Row]:
    """Let one service after the other take what it gets."""
    rows = []
    for attack in MEMORY:
        async with serving(folder, **LIMITS) as server, server.robot("hostile") as robot:
            await robot.call("hostile", {}, deadline_s=5)
            before, own = shared_and_kernel_bytes(), _own_bytes(server)
            call = asyncio.create_task(_outcome(robot, attack, 1.0))
            peak, shared_peak, is_over = 0, 0, False
            while not is_over:  # one sample comes after the answer
                is_over = call.done()
                shared = shared_and_kernel_bytes() - before
                shared_peak, peak = max(shared_peak, shared), max(peak, _own_bytes(server) - own + shared)
                await asyncio.sleep(0.02)  # samples
            rows.append({
                "row": f"memory, {attack}", "outcome": call.result(), "peak_mib": peak / MIB,
                "shared_and_kernel_mib": shared_peak / MIB, "limit_mib": MEMORY_BYTES / MIB,
                "of_limit": peak / MEMORY_BYTES,
            })  # fmt: skip
    return rows


def _own_bytes(server: Server) -> int:
    return sum(map(proportional_bytes, sandbox_pids(server)))


async def _outcome(robot: Any, attack: str, seconds: float, deadline_s: float = 20.0) -> str:
    try:
        answer = await robot.call("hostile", {"do": attack, "seconds": seconds}, deadline_s=deadline_s)
    except RsePfError as error:
        return f"{error.code}: {error.message}"[:160]
    return str(answer.reply["got"])


async def cpu(folder: Path, seconds: float, others: int = 10, turns: int = 4) -> list[Row]:
    """Let threads work after the answer, and within a call, beside robots that locate themselves."""
    rows = []
    for attack, call_s in (("work_on", 0.0), ("work_in", 4.0)):
        times: dict[bool, list[float]] = {False: [], True: []}
        failed: list[str] = []
        used = 0.0
        async with serving(folder, **LIMITS) as server, server.robot("hostile") as robot:
            for _ in range(turns):
                for is_hostile in (False, True):
                    end = time.perf_counter() + seconds / turns
                    began_s = time.perf_counter()
                    before = sum(map(cpu_seconds, sandbox_pids(server)))
                    answers = Answers(times[is_hostile], failed)
                    each = [
                        pnp_robot(server, f"other-{i}", end, i / others, answers, period_s=0.5)
                        for i in range(others)
                    ]
                    if is_hostile:
                        each.append(_hostile(robot, attack, call_s, end))
                    await asyncio.gather(*each)
                    if is_hostile:
                        spent = sum(map(cpu_seconds, sandbox_pids(server))) - before
                        used += spent / (time.perf_counter() - began_s)
        quiet, beside = 1e3 * percentile(times[False], 99), 1e3 * percentile(times[True], 99)
        rows.append({
            "row": f"cpu, {attack}", "n_quiet": len(times[False]), "n_beside": len(times[True]),
            "failed": len(failed), "p50_quiet_ms": 1e3 * percentile(times[False], 50),
            "p50_beside_ms": 1e3 * percentile(times[True], 50),
            "p99_quiet_ms": quiet, "p99_beside_ms": beside,
            "ratio": beside / quiet, "hostile_cores": used / turns,
        })  # fmt: skip
    return rows


async def _hostile(robot: Any, attack: str, call_s: float, end: float) -> None:
    """Ask the service again and again, as a robot that works with it would."""
    while time.perf_counter() < end:
        await _outcome(robot, attack, call_s or 3600.0, deadline_s=10.0)
        await asyncio.sleep(0.5)  # the pace of the robot


ROWS = ("memory", "cpu")
LIMITS = {"memory_bytes": MEMORY_BYTES, "breaker_crashes": 100_000}


async def measure(only: list[str], seconds: float) -> list[Row]:
    """Return the rows and print each as soon as it is measured."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="rse-pf-hostile-") as temporary:
        folder = Path(temporary)
        made = folder / "hostile"
        made.mkdir()
        (made / "service.py").write_text(HOSTILE)
        manifest = {"name": "hostile", "language": "python", "entry": "service.py", "kind": "stateless"}
        (made / "service.json").write_text(json.dumps(manifest))
        install(made, folder / "services")
        works = {"memory": lambda: memory(folder), "cpu": lambda: cpu(folder, seconds)}
        for name in only:
            for row in await works[name]():
                say(row)
                rows.append(row)
    return rows


@benchmark()
def run_benchmark(
    *, only: Annotated[tuple[str, ...], "rows", ROWS] = ROWS, seconds: float = 60.0
) -> dict[str, Any]:
    """Measure the rows."""
    return {"rows": asyncio.run(measure(list(only), seconds))}
