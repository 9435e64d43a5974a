"""The network of a hundred robots is gone for a while: when each has an answer, and what the firewall saw.

    python -m benchmarks cloud.network_gone [--client CLIENT] [--robots N] [--gone S S] [--case CASE]
        [--runs N]

Three network namespaces, which are deleted at the end: robots, a router, and a server with a local platform
behind a relay that plays the web firewall.  Two cases for each time: the link of the robots is down, or the
router loses every packet with the link up.  Each robot asks echo twice a second; all have one address.  Needs
root and ip(8), and says so otherwise.

The robots are of the Python client, pages of one Chromium, or of the JavaScript client in Node.

Defends: first answer p99 <= 2 s after the network is back, of pages <= 5 s; the firewall blocks nobody.
"""

from __future__ import annotations

import asyncio
import functools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import client_sdk
from benchmarks.cloud.local_platform import LocalPlatform
from benchmarks.cloud.outage import FrontDoor, most_within
from benchmarks.cloud.played_firewall import PlayedFirewall, rules_of_settings
from benchmarks.frame.registry import Bar, benchmark, command_of
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError

__all__ = ["CASES", "measure"]

CASES = ("link-down", "packets-lost")
BARS_S = {"python": 2.0, "node": 2.0, "chromium": 5.0}
ASK_EVERY_S = 0.5
BEFORE_S = 3.0
WAIT_S = 60.0
START_S = 240.0
ROBOT_SIDE, SERVER_SIDE = "10.212.1", "10.212.2"
TREE = Path(__file__).resolve().parents[2]
CLIENT_WEB = TREE / "client_web" / "rse-pf.js"
PAGE_ORIGIN = "http://127.0.0.1:8000"
"""In the namespace of the robots, where every port is free."""


class Machines:
    """The namespaces of robots, router and server."""

    def __init__(self, number: int) -> None:
        self.robots, self.router, self.server = (f"rse-{number}-{role}" for role in "abc")
        self.link = "up0"

    def steps(self) -> list[tuple[str, ...]]:
        """Return the commands that make them."""
        made: list[tuple[str, ...]] = [
            ("netns", "add", each) for each in (self.robots, self.router, self.server)
        ]
        for name, side, inside in ((self.robots, ROBOT_SIDE, "down0"), (self.server, SERVER_SIDE, "down1")):
            made += [
                (
                    "-n",
                    name,
                    "link",
                    "add",
                    self.link,
                    "type",
                    "veth",
                    "peer",
                    "name",
                    inside,
                    "netns",
                    self.router,
                ),
                ("-n", name, "address", "add", f"{side}.2/24", "dev", self.link),
                ("-n", self.router, "address", "add", f"{side}.1/24", "dev", inside),
                ("-n", self.router, "link", "set", inside, "up"),
                ("-n", name, "link", "set", self.link, "up"),
                ("-n", name, "link", "set", "lo", "up"),
                ("-n", name, "route", "add", "default", "via", f"{side}.1"),
            ]
        return made

    def forward(self, *, is_on: bool) -> None:
        """Let the router carry packets, or lose each of them."""
        self.run(self.router, "sh", "-c", f"echo {int(is_on)} > /proc/sys/net/ipv4/ip_forward")

    def set_link(self, *, is_up: bool) -> None:
        """Switch the interface of the robots; a route of one that is down is gone, as with Wi-Fi."""
        self.run(self.robots, "ip", "link", "set", self.link, "up" if is_up else "down")
        if is_up:
            self.run(self.robots, "ip", "route", "add", "default", "via", f"{ROBOT_SIDE}.1")

    @staticmethod
    def run(space: str, *words: str) -> None:
        """Run a command in a namespace."""
        subprocess.run(["ip", "netns", "exec", space, *words], check=True)

    @staticmethod
    def python(space: str, function: Callable[[str], None], word: str) -> subprocess.Popen[str]:
        """Call *function* in a namespace, with pipes."""
        return subprocess.Popen(
            ["ip", "netns", "exec", space, *command_of(function, word)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=TREE,
        )  # fmt: skip


@contextmanager
def machines() -> Iterator[Machines]:
    """Make the namespaces, and delete them at the end; SystemExit where that is not allowed."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        raise SystemExit("network namespaces need root and ip(8)")
    made = Machines(os.getpid() % 10_000)
    try:
        for step in made.steps():
            if subprocess.run(["ip", *step], check=False).returncode != 0:
                raise SystemExit(f"not allowed here: ip {' '.join(step)}")
        made.forward(is_on=True)
        yield made
    finally:
        for each in (made.robots, made.router, made.server):
            subprocess.run(["ip", "netns", "delete", each], check=False, capture_output=True)


# --- in the namespace of the server ------------------------------------------------------------------


def start_serving(robots: str) -> None:
    """Run `serve` in a process of its own."""
    asyncio.run(serve(int(robots)))


def start_driving(client: str) -> None:
    """Run `drive` in a process of its own."""
    asyncio.run(drive(client))


async def serve(robots: int) -> None:
    """Serve a platform behind the firewall; print its tokens, and for each line read what it saw."""
    loop = asyncio.get_running_loop()
    with tempfile.TemporaryDirectory(prefix="network-gone-") as folder, ExitStack() as ends:
        settings = {"context": {"rse-pf": {"serving": {"allowed_origins": PAGE_ORIGIN}}}}
        (Path(folder) / "cdk.json").write_text(json.dumps(settings), encoding="utf-8")
        local = await asyncio.to_thread(ends.enter_context, LocalPlatform("bench-gone", Path(folder)))
        async with FrontDoor(
            local.port, PlayedFirewall(rules_of_settings(PlatformSettings())), "0.0.0.0"
        ) as front:
            url = front.url.replace("0.0.0.0", f"{SERVER_SIDE}.2")
            tokens = [local.token(f"robot-{number}") for number in range(robots)]
            print(json.dumps({"url": url, "tokens": tokens}), flush=True)
            while line := await loop.run_in_executor(None, sys.stdin.readline):
                since = float(line)
                dials = [dial for dial in front.dials if dial >= since]
                told = {"dials": len(dials), "most_in_a_minute": most_within(dials, 60.0)}
                print(json.dumps({**told, "blocked": front.firewall.blocked}), flush=True)


# --- in the namespace of the robots ------------------------------------------------------------------

Answered = Callable[[int], None]
"""Takes the number of a robot that has an answer."""


async def drive(client: str) -> None:
    """Connect; then, for each line with a time, tell when each robot had its next answer."""
    loop = asyncio.get_running_loop()
    given = json.loads(await loop.run_in_executor(None, sys.stdin.readline))
    first_s: dict[int, float] = {}

    def answered(number: int) -> None:
        first_s.setdefault(number, time.monotonic())

    async with CLIENTS[client](given, answered):
        await _until(lambda: len(first_s) == len(given["tokens"]), time.monotonic() + START_S)
        print("ready", flush=True)
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            back_s = float(line)
            first_s.clear()
            await _until(lambda: len(first_s) == len(given["tokens"]), back_s + WAIT_S)
            print(json.dumps({"after_s": sorted(each - back_s for each in first_s.values())}), flush=True)


async def _until(is_so: Callable[[], bool], until_s: float) -> None:
    while not is_so() and time.monotonic() < until_s:
        await asyncio.sleep(0.01)  # polls, with a deadline


@asynccontextmanager
async def python_robots(given: dict[str, Any], answered: Answered) -> AsyncIterator[None]:
    """Let robots of the Python client, all in this process, ask."""
    fleet = [client_sdk.connect(given["url"], token=token) for token in given["tokens"]]
    for robot in fleet:
        await robot

    async def ask(number: int, robot: client_sdk.Robot) -> None:
        while True:
            began = time.monotonic()
            try:
                await robot.call("echo", {"value": number}, deadline_s=WAIT_S, stream="pose")
                answered(number)
            except RsePfError:
                pass
            await asyncio.sleep(max(0.0, ASK_EVERY_S - (time.monotonic() - began)))

    asking = [asyncio.create_task(ask(number, robot)) for number, robot in enumerate(fleet)]
    yield
    for task in asking:
        task.cancel()
    await asyncio.gather(*(robot.close() for robot in fleet))


ASK = f"""
const ask = async (connect, url, token, answered) => {{
  const robot = await connect(url, {{ token }});
  for (;;) {{
    const began = performance.now();
    const options = {{ deadlineMs: {WAIT_S * 1e3}, stream: "pose" }};
    await robot.call("echo", {{ value: 1 }}, options).then(answered, () => {{}});
    const ms = Math.max(0, {ASK_EVERY_S * 1e3} - (performance.now() - began));
    await new Promise((done) => setTimeout(done, ms));
  }}
}};
"""
"""What a robot of the JavaScript client does, in a page and in Node."""
IN_PAGE = f"""async ({{ number, url, token }}) => {{
  {ASK}
  const {{ connect }} = await import("/rse-pf.js");
  ask(connect, url, token, () => window.answered(number)).catch((failed) => window.failed(failed.message));
}}"""
IN_NODE = f"""
  {ASK}
  const [module, given] = process.argv.slice(1);
  const {{ connect }} = await import(module);
  const {{ url, tokens }} = JSON.parse(given);
  await Promise.all(tokens.map((token, number) => ask(connect, url, token, () => console.log(number))));
"""


class _Files(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Write nothing."""


@asynccontextmanager
async def pages(given: dict[str, Any], answered: Answered) -> AsyncIterator[None]:
    """Let pages of one Chromium ask, each with a robot and a profile of its own."""
    from playwright.async_api import async_playwright

    def failed(message: str) -> None:
        print(f"a page failed: {message}", file=sys.stderr, flush=True)

    # For Chromium a page that playwright answers by itself is not on this machine, and may not connect to it.
    origin = urlsplit(PAGE_ORIGIN)
    files = functools.partial(_Files, directory=str(CLIENT_WEB.parent))
    server = ThreadingHTTPServer((str(origin.hostname), origin.port or 0), files)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    paths = map(shutil.which, ("chromium-headless-shell", "chromium"))
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=next(filter(None, paths)), args=["--no-sandbox"]
        )
        for number, token in enumerate(given["tokens"]):
            page = await browser.new_page()
            await page.expose_function("answered", answered)
            await page.expose_function("failed", failed)
            await page.goto(PAGE_ORIGIN)
            await page.evaluate(IN_PAGE, {"number": number, "url": given["url"], "token": token})
        yield
        await browser.close()
        server.shutdown()


@asynccontextmanager
async def node_robots(given: dict[str, Any], answered: Answered) -> AsyncIterator[None]:
    """Let robots of the JavaScript client, all in one process of Node, ask."""
    beside = Path(sys.executable).with_name("node")
    process = await asyncio.create_subprocess_exec(
        str(beside) if beside.exists() else "node", "--input-type=module", "-e", IN_NODE, "--",
        str(CLIENT_WEB), json.dumps(given), stdout=subprocess.PIPE,
    )  # fmt: skip

    async def read() -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            answered(int(line))

    reading = asyncio.create_task(read())
    yield
    process.kill()
    await process.wait()
    await reading


CLIENTS = {"python": python_robots, "chromium": pages, "node": node_robots}


# --- outside -----------------------------------------------------------------------------------------


def measure(
    *, client: str, robots: int, gone: list[float], runs: int, cases: list[str]
) -> list[dict[str, Any]]:
    """Return a row for each case, time and run."""
    rows: list[dict[str, Any]] = []
    with machines() as made, ExitStack() as ends:
        server = made.python(made.server, start_serving, str(robots))
        ends.callback(_end, server)
        told = _line(server)
        fleet = made.python(made.robots, start_driving, client)
        ends.callback(_end, fleet)
        _say(fleet, told.strip())
        assert _line(fleet).strip() == "ready"
        for number in range(runs):
            for case in cases:
                for gone_s in gone:
                    row = one(made, server, fleet, case, gone_s)
                    asked = {"client": client, "case": case, "gone_s": gone_s, "run": number + 1}
                    rows.append({**asked, "robots": robots, **row})
                    say(rows[-1])
    return rows


def one(
    made: Machines, server: subprocess.Popen[str], fleet: subprocess.Popen[str], case: str, gone_s: float
) -> dict[str, Any]:
    """Take the network away once, and return what came back when."""
    time.sleep(BEFORE_S)  # a quiet time before it
    began = time.monotonic()
    is_link = case == "link-down"
    made.set_link(is_up=False) if is_link else made.forward(is_on=False)
    time.sleep(max(0.0, began + gone_s - time.monotonic()))
    made.set_link(is_up=True) if is_link else made.forward(is_on=True)
    back_s = time.monotonic()
    _say(fleet, repr(back_s))
    found = json.loads(_line(fleet))
    _say(server, repr(began))
    seen = json.loads(_line(server))
    after = found.pop("after_s")
    figures = {"after_s": spread(after), "answered": len(after)}
    return {**figures, **seen, **found}


def _say(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise SystemExit("a process in a namespace ended; its message is above")
    return line


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(60)
    except subprocess.TimeoutExpired:
        process.kill()


@benchmark(
    Bar("p99_s.python", at_most=BARS_S["python"], unit="s"),
    Bar("p99_s.node", at_most=BARS_S["node"], unit="s"),
    Bar("p99_s.chromium", at_most=BARS_S["chromium"], unit="s"),
    Bar("without_answer", equals=0),
    Bar("rows.*.blocked", equals=0),
)
def run_benchmark(
    *, client: Annotated[str, "", CLIENTS] = "python", robots: int = 100,
    gone: Annotated[tuple[float, ...], "seconds"] = (5.0, 30.0, 120.0), runs: int = 1,
    case: Annotated[str | None, "only this one", CASES] = None,
) -> dict[str, Any]:  # fmt: skip
    """Take the network away, in every case for every time."""
    cases = [case] if case else [*CASES]
    rows = measure(client=client, robots=robots, gone=list(gone), runs=runs, cases=cases)
    return {
        "rows": rows, "without_answer": sum(robots - row["answered"] for row in rows),
        "p99_s": {client: max(row["after_s"]["p99"] or float("inf") for row in rows)},
    }  # fmt: skip
