"""A robot on another machine: connected by its one file, refused without it, served while servers change."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import ssl
import stat
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from system.local.lan.conftest import OtherMachine

from rse_pf.auth.certificates import SERVER_S
from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.local.lan.listener import LanListener
from rse_pf.local.processes import send_signal
from rse_pf.local.state import PlatformState, read_state

pytestmark = pytest.mark.system

SOON_S = 60.0
RSE_PF = [sys.executable, "-m", "rse_pf.cli.main"]

ASK = """
import asyncio, sys
import client_sdk
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_problem

async def ask(moves=0, **how):
    problem, servers, answered = make_problem(seed=1), [], 0
    try:
        async with client_sdk.connect(codec="bin", **how) as robot:
            while len(servers) <= moves:
                answer = await robot.solve_pnp(problem.points_world, problem.pixels, problem.camera)
                answered += 1
                if answer.server not in servers:
                    servers.append(answer.server)
                    print("pose by", answer.server, answer.solution.T_camera_world.shape, flush=True)
                await asyncio.sleep(0.05 * (moves > 0))  # the rate of a camera
            print("sent - answered =", robot.stats.sent - answered, "failed =", robot.stats.failed)
    except RsePfError as error:
        print(type(error).__name__, error.message, "/", error.hint)
"""


class Lan:
    """A platform of this machine that the other one may reach."""

    def __init__(self, home: Path, other: OtherMachine) -> None:
        self.folder = home / "rse-pf" / "default"
        self._home = home
        settings = {"local": {"warm_standby": False}}  # it saves time only where servers fail
        (home / "cdk.json").write_text(json.dumps({"context": {"rse-pf": settings}}))
        self._process = subprocess.Popen(
            [*RSE_PF, "local", "--lan", other.here, "--port", "0", "--metrics-port", "0", "--servers", "1"],
            env={**os.environ, "XDG_STATE_HOME": str(home)}, cwd=home, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self.said = ""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.said += line
            if "logs and state" in line:
                return
        raise AssertionError(self.said)

    @property
    def state(self) -> PlatformState:
        state = read_state(self.folder)
        assert state is not None
        return state

    def run(self, *words: str) -> tuple[int, str, str]:
        """Run a verb in this process; return its exit code and what it wrote."""
        out, err = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patched, redirect_stdout(out), redirect_stderr(err):
            patched.setenv("XDG_STATE_HOME", str(self._home))
            patched.chdir(self._home)
            code = main(list(words))
        return code, out.getvalue(), err.getvalue()

    def wait_for_trust(self) -> None:
        """Wait until the server has read the roster, as it does twice a second."""
        deadline = time.monotonic() + SOON_S
        while '"event":"access-control-read"' not in (self.folder / "server-1.log").read_text():
            assert time.monotonic() < deadline, "the server has not read the roster"
            threading.Event().wait(0.02)

    def metrics(self) -> dict[str, Any]:
        """Return the metric families of the one address."""
        token = read_control_token(self.folder / "control.token")
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.state.status_port}/metrics", headers={"Authorization": bearer(token)}
        )
        with urllib.request.urlopen(request, timeout=SOON_S) as answer:
            text = answer.read().decode()
        return {family.name: family for family in text_string_to_metric_families(text)}

    def close(self) -> None:
        marks = self.state.processes() if read_state(self.folder) is not None else ()
        self._process.terminate()
        try:
            self._process.communicate(timeout=SOON_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        for mark in marks:
            send_signal(mark, signal.SIGKILL)


@pytest.fixture(scope="module")
def lan(other_machine: OtherMachine, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lan]:
    made = Lan(tmp_path_factory.mktemp("lan"), other_machine)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def enrolment(lan: Lan) -> Path:
    code, _, errors = lan.run("robot", "enrol", "robot-1", "--out", "robot-1.enrolment")
    assert (code, errors) == (0, "")
    lan.wait_for_trust()
    return lan.folder.parents[1] / "robot-1.enrolment"


def changed(enrolment: Path, name: str, **members: Any) -> str:
    """Write the enrolment with other members; return its path."""
    file = enrolment.with_name(name)
    file.write_text(json.dumps({**json.loads(enrolment.read_text()), **members}))
    file.chmod(0o600)
    return str(file)


def test_the_start_says_what_another_machine_needs(lan: Lan, other_machine: OtherMachine) -> None:
    port = lan.state.port

    assert lan.state.url == f"wss://{other_machine.here}:{port}/ws"
    for words in (lan.state.url, f"TCP port {port}", "robot enrol"):
        assert words in lan.said
    modes = {name: stat.S_IMODE((lan.folder / name).stat().st_mode) for name in ("authority.pem", "tls.json")}
    assert set(modes.values()) == {0o600}


def test_a_robot_gets_a_pose_by_the_one_file_and_is_refused_without_a_part_of_it(
    lan: Lan, enrolment: Path, other_machine: OtherMachine
) -> None:
    assert lan.run("robot", "keygen", "--out", "other.key")[0] == 0
    stranger = json.loads((enrolment.parent / "other.key").read_text())
    files = [
        str(enrolment),
        changed(enrolment, "no-authority", authority=""),
        changed(enrolment, "other-key", key=stranger),
    ]
    program = ASK + (
        "for file in sys.argv[2:]:\n    asyncio.run(ask(enrolment=file))\n"
        "import ssl\nfrom client_sdk.enrolment import read_enrolment\n"
        "asyncio.run(ask(url=sys.argv[1].replace('wss', 'ws')))\n"
    )

    said = other_machine.python(program, lan.state.url, *files).splitlines()

    assert said[0].endswith("(4, 4)")
    assert said[1] == "sent - answered = 0 failed = 0"
    assert "ConnectError" in said[2]
    assert "certificate that this robot does not trust: " in said[2]
    assert "rse-pf robot enrol" in said[2]
    assert said[3].startswith("Unauthorized the token is missing, wrong or expired / ")
    assert "ConnectError" in said[4]
    assert "write wss://" in said[4]
    assert len(said) == 5, "each refusal is one line"


def test_only_the_port_of_the_robots_can_be_reached(lan: Lan, other_machine: OtherMachine) -> None:
    state = lan.state
    assert state.data_server is not None
    server = state.servers[0]
    ports = [state.port, state.status_port, server.port, server.control_port, state.data_server.port]
    program = (
        "import socket, sys\n"
        "for port in sys.argv[2:]:\n"
        "    with socket.socket() as trial:\n"
        "        trial.settimeout(5)\n"
        "        print(trial.connect_ex((sys.argv[1], int(port))))\n"
    )

    said = other_machine.python(program, other_machine.here, *map(str, ports)).split()

    assert all(ports)
    assert said[0] == "0"
    assert set(said[1:]) == {"111"}, "connection refused"


STRANGER = """
import json, socket, ssl, sys, time
host, port, limit_s = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
hello = bytes.fromhex("1603010200010001fc0303") + bytes(32)
silent, dribbling, halves = [], [], []
for kept, first in ((silent, b""), (dribbling, hello[:1]), (halves, hello)):
    for _ in range(100):
        one = socket.create_connection((host, port), 5)
        if first:
            one.sendall(first)
        kept.append(one)
begin = time.monotonic()

def relaxed():
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    made.check_hostname, made.verify_mode = False, ssl.CERT_NONE
    return made

def asked(text, name=None):
    with socket.create_connection((host, port), 5) as plain:
        with relaxed().wrap_socket(plain, server_hostname=name) as secure:
            secure.settimeout(5)
            secure.sendall(text.encode())
            return secure.recv(4096).decode(errors="replace").split("\\r\\n")[0]

def get(path, name=None):
    return asked(f"GET {path} HTTP/1.1\\r\\nhost: x\\r\\nconnection: close\\r\\n\\r\\n", name)

took = time.monotonic()
healthy = get("/healthz")
took = time.monotonic() - took
told = {"healthy": healthy, "took_s": took}
for path in ("/", "/metrics", "/status", "/robots", "/readyz", "/events", "/api/state", "/fleet",
             "/authority.pem", "/tls.json", "/%2e%2e/authority.pem", "/..%2fauthority.pem",
             "/control/robots.json", "/ws", "/data/v1/objects", "/rosbridge"):
    told[path] = get(path)
for name in ("other.example", ".".join(["a" * 60] * 4), "localhost"):
    told["name " + name[:13]] = get("/healthz", name)
with socket.create_connection((host, port), 5) as plain:
    plain.sendall(b"GET / HTTP/1.1\\r\\nhost: x\\r\\n\\r\\n")
    plain.settimeout(5)
    try:
        told["plain"] = plain.recv(4096).decode(errors="replace")
    except ConnectionResetError:
        told["plain"] = ""
closed = 0
dribbled = time.monotonic()
rest = hello[1:]
waiting = [*silent, *dribbling, *halves]
for one in waiting:
    one.setblocking(False)
while waiting and time.monotonic() - begin < limit_s:
    for one in list(waiting):
        try:
            if one in dribbling and rest:
                one.send(rest[:1])
            if one.recv(4096) != b"":
                continue
        except BlockingIOError:
            continue
        except OSError:
            pass
        waiting.remove(one)
        closed += 1
    rest = rest[1:]
    time.sleep(0.5)
told["closed"], told["within_s"] = closed, time.monotonic() - begin
print(json.dumps(told))
"""


@pytest.mark.slow
def test_a_stranger_on_the_network_gets_no_page_and_holds_no_handshake_open(
    lan: Lan, other_machine: OtherMachine
) -> None:
    """300 connections are silent, send their first message byte by byte, or half of it, and are closed."""
    limit_s = 2 * PlatformSettings().session.hello_timeout_s

    said = other_machine.python(STRANGER, other_machine.here, str(lan.state.port), str(limit_s))

    told = json.loads(said)
    assert told.pop("closed") == 300
    assert told.pop("within_s") <= limit_s
    assert told.pop("took_s") < 1.0, "another machine is served meanwhile"
    assert told.pop("plain") == "", "plain HTTP gets no answer"
    pages = {name: told.pop(name) for name in list(told) if name == "healthy" or name.startswith("name ")}
    assert set(pages.values()) == {"HTTP/1.1 200 OK"}
    assert set(told.values()) <= {
        "HTTP/1.1 400 Bad Request", "HTTP/1.1 401 Unauthorized", "HTTP/1.1 404 Not Found",
    }, told  # fmt: skip


def test_no_file_with_a_secret_can_be_read_by_others(lan: Lan, enrolment: Path) -> None:
    secret = {"authority.pem", "tls.json", "control.token", enrolment.name}
    found = {path.name: path for path in (*lan.folder.rglob("*"), enrolment) if path.is_file()}

    assert secret < found.keys()
    for name in secret:
        assert stat.S_IMODE(found[name].stat().st_mode) == 0o600, name
    for path in found.values():
        if b"PRIVATE KEY" in path.read_bytes() or b'"d":' in path.read_bytes():
            assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path


def test_every_server_is_replaced_while_a_robot_works_and_nothing_is_lost(
    lan: Lan, enrolment: Path, other_machine: OtherMachine
) -> None:
    before = lan.state.servers[0].name
    program = ASK + "asyncio.run(ask(moves=1, enrolment=sys.argv[1]))"
    robot = subprocess.Popen(
        ["ip", "netns", "exec", other_machine.name, sys.executable, "-c", program, str(enrolment)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=Path(__file__).parents[4],
    )  # fmt: skip
    try:
        assert robot.stdout is not None
        assert robot.stdout.readline() == f"pose by {before} (4, 4)\n"
        shown = json.loads(lan.run("local", "robots", "--json")[1])

        rolled = lan.run("local", "roll")
        said, _ = robot.communicate(timeout=SOON_S)
    finally:
        robot.kill()

    after = lan.state.servers[0]
    assert after.name != before
    assert said.splitlines() == [f"pose by {after.name} (4, 4)", "sent - answered = 0 failed = 0"]
    code, report, errors = rolled
    assert (code, errors) == (0, "")
    assert f"  {before} is replaced (1 of 1)\n" in report
    assert report.endswith("every server was replaced\n")
    (row,) = shown["robots"]
    assert (row["robot"], row["tenant"], row["server"], row["codec"]) == ("robot-1", "default", before, "bin")
    assert (row["last_result"], row["commands"] > 0) == ("ok", True)
    families = lan.metrics()
    assert {s.labels["server"]: s.value for s in families["rse_pf_server_up"].samples} == {after.name: 1.0}
    assert all(len(family.documentation.split()) >= 3 for family in families.values())
    (found,) = json.loads((lan.folder / "prometheus_sd.json").read_text())
    assert found["targets"] == [f"127.0.0.1:{after.control_port}"]
    assert found["labels"] == {"platform": "default", "server": after.name}


def test_the_last_server_and_an_unknown_one_are_not_drained_and_a_long_pause_is_refused(lan: Lan) -> None:
    server = lan.state.servers[0].name

    told = [
        lan.run("local", *words)[2].splitlines()
        for words in (("drain", server), ("drain", "server-99"), ("pause", server, "--for", "2"))
    ]

    assert told[0] == [
        f"UsageError: {server} is the last server", "  hint: rse-pf local roll starts another one first"
    ]  # fmt: skip
    assert told[1][0] == "UsageError: no server named 'server-99' is running"
    assert f"{server} would not go on after 2 s" in told[2][0]
    assert lan.state.servers[0].name == server


def test_a_renewed_certificate_is_served_without_a_restart_and_open_connections_stay(
    lan: Lan, other_machine: OtherMachine
) -> None:
    context = ssl.create_default_context(cafile=str(lan.folder / "authority.crt"))
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    where = (other_machine.here, lan.state.port)

    def served() -> bytes | None:
        with (
            socket.create_connection(where, timeout=SOON_S) as plain,
            unchecked.wrap_socket(plain) as secured,
        ):
            return secured.getpeercert(binary_form=True)

    before, balancer = served(), lan.state.load_balancer
    with (
        socket.create_connection(where, timeout=SOON_S) as plain,
        context.wrap_socket(plain, server_hostname=other_machine.here) as opened,
    ):
        later_s = time.time() + 0.7 * SERVER_S
        assert LanListener(address=other_machine.here, folder=lan.folder).prepare("default", now_s=later_s)
        end = time.monotonic() + SOON_S
        while served() == before:
            assert time.monotonic() < end, "the balancer still serves the old certificate"

        opened.sendall(b"GET /healthz HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
        assert opened.recv(12) == b"HTTP/1.1 200"
    assert lan.state.load_balancer == balancer
