"""``rse-pf local`` as a person uses it: Ctrl-C, stop, a killed control plane, and nothing left running."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.local.processes import ProcessMark, is_alive, send_signal, wait_ended
from rse_pf.local.state import PlatformState, read_state

pytestmark = pytest.mark.system

SOON_S = 20.0
RSE_PF = [sys.executable, "-m", "rse_pf.cli.main"]


class Terminal:
    """Commands in an environment of their own."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.folder = home / "rse-pf" / "default"
        self._environment = {**os.environ, "XDG_STATE_HOME": str(home)}
        self._opened: list[subprocess.Popen[str]] = []
        self._seen: set[ProcessMark] = set()

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Run a verb in the background."""
        process = subprocess.Popen(
            [*RSE_PF, *words], env=self._environment, cwd=self.home, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        self._opened.append(process)
        return process

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a verb to its end."""
        return subprocess.run(
            [*RSE_PF, *words], env=self._environment, cwd=self.home, text=True, timeout=3 * SOON_S,
            capture_output=True, check=False,
        )  # fmt: skip

    def platform(self, *words: str) -> tuple[subprocess.Popen[str], PlatformState, str]:
        """Run ``rse-pf local`` until it says how to stop it; return process, state and what it said."""
        process = self.start("local", "--port", "0", "--servers", "1", *words)
        assert process.stdout is not None
        said = ""
        for line in process.stdout:
            said += line
            if "logs and state" in line:
                break
        else:
            raise AssertionError(said + process.communicate()[1])
        return process, self.state(), said

    def state(self) -> PlatformState:
        """Return the state file, which must be there."""
        state = read_state(self.folder)
        assert state is not None
        self._seen.update(state.processes())
        return state

    def until_any_state(self) -> PlatformState:
        """Return the state file as soon as there is one, long before the platform is ready."""
        end = time.monotonic() + SOON_S
        while read_state(self.folder) is None:
            assert time.monotonic() < end, "no state file"
            os.sched_yield()
        return self.state()

    def close(self) -> None:
        """End what a failed test left."""
        for process in self._opened:
            process.kill()
            process.communicate()
        for mark in self._seen:
            send_signal(mark, signal.SIGKILL)


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    made = Terminal(tmp_path)
    yield made
    made.close()


def assert_gone(state: PlatformState) -> None:
    for mark in state.processes():
        assert wait_ended(mark, SOON_S), mark


def test_it_says_where_to_connect_how_to_get_a_token_and_how_to_stop(terminal: Terminal) -> None:
    _, state, said = terminal.platform()

    assert state.url in said
    assert "rse-pf token issue robot-1\n" in said
    assert "Ctrl-C, or rse-pf local stop\n" in said
    assert terminal.run("token", "issue", "robot-1").returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_a_kind_kill_and_a_closed_terminal_leave_nothing(
    terminal: Terminal, number: signal.Signals
) -> None:
    process, state, _ = terminal.platform()

    process.send_signal(number)
    _, errors = process.communicate(timeout=SOON_S)

    assert (process.returncode, errors) == (0, "")
    assert_gone(state)
    assert read_state(terminal.folder) is None


def test_ctrl_c_before_it_is_ready_leaves_nothing(terminal: Terminal) -> None:
    process = terminal.start("local", "--port", "0", "--servers", "1")
    state = terminal.until_any_state()

    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=SOON_S)

    assert process.returncode == 130
    assert "robots connect to" not in said
    assert_gone(state)
    assert read_state(terminal.folder) is None


def test_stop_ends_a_platform_from_another_terminal(terminal: Terminal) -> None:
    process, state, _ = terminal.platform()

    told = terminal.run("local", "stop")

    assert (told.returncode, told.stdout, told.stderr) == (0, "platform 'default' is stopped\n", "")
    assert process.wait(SOON_S) == 0
    assert_gone(state)


def test_without_a_control_plane_robots_are_served_status_works_and_stop_cleans_up(
    terminal: Terminal,
) -> None:
    process, state, _ = terminal.platform()
    process.kill()
    process.wait(SOON_S)

    assert all(map(is_alive, state.processes())), "the data path must outlive the control plane"
    control = f"http://127.0.0.1:{state.servers[0].control_port}/readyz"
    with urllib.request.urlopen(control, timeout=SOON_S) as answer:
        assert answer.status == 200
    seen = json.loads(terminal.run("local", "status", "--json").stdout)
    assert not seen["control_plane"]["running"]
    assert seen["balancer"]["running"]
    assert [(each["name"], each["state"]) for each in seen["servers"]] == [("server-1", "ready")]
    assert [(each["name"], each["state"]) for each in seen["data_servers"]] == [("data-1", "ready")]

    told = terminal.run("local", "stop")
    assert told.stdout == "platform 'default' is stopped\n"
    assert_gone(state)
    assert read_state(terminal.folder) is None


def test_a_platform_of_0_1_0_keeps_its_key_and_its_robots_keep_their_tokens(terminal: Terminal) -> None:
    key = SigningKey.from_seed(b"o" * 32, "9d6395a1")
    token = key.issue("robot-1", now=time.time(), token_id="t", settings=PlatformSettings().auth)
    old = {
        "key.json": key.to_json(), "keys.json": key.key_set().to_json(), "control.token": "0f" * 32 + "\n",
        "settings.json": json.dumps({"context": {"rse-pf": {"serving": {"health_path": "/healthz"}}}}),
    }  # fmt: skip
    assert json.loads(old["key.json"]).keys() == {"kty", "crv", "kid", "x", "d"}, "the form of 0.1.0"
    terminal.folder.mkdir(parents=True)
    for name, content in old.items():
        (terminal.folder / name).write_text(content)
        (terminal.folder / name).chmod(0o600)
    refused = terminal.run("token", "issue", "robot-1")
    assert refused.returncode == 2
    assert "start the platform once with: rse-pf local --name default" in refused.stderr

    terminal.platform()

    inspected = terminal.run("token", "inspect", token)
    assert json.loads(inspected.stdout)["verified"] == "yes", inspected.stderr
    for name in ("key.json", "keys.json", "control.token"):
        assert (terminal.folder / name).read_text() == old[name]


def test_stop_signals_nobody_who_only_has_the_pid_of_a_server(terminal: Terminal) -> None:
    terminal.folder.mkdir(parents=True)
    with subprocess.Popen([sys.executable, "-c", "import signal; signal.pause()"]) as stranger:
        mark = ProcessMark(pid=stranger.pid, began="1@another-boot")
        PlatformState(
            name="default", control_plane=mark, url="", settings_digest="", settings_file="", key_file="",
            load_balancer=mark,
        ).write(terminal.folder)  # fmt: skip

        told = terminal.run("local", "stop")

        assert told.stdout == "platform 'default' was not running\n"
        assert stranger.poll() is None
        stranger.kill()


def test_a_name_that_runs_already_is_two_lines(terminal: Terminal) -> None:
    terminal.platform()

    told = terminal.run("local", "--port", "0")

    assert told.returncode == 2
    assert told.stdout == ""
    assert told.stderr.splitlines() == [
        "ConfigurationError: a platform named 'default' is running already",
        "  hint: end it with: rse-pf local stop --name default, or choose another --name",
    ]


def test_a_taken_port_is_two_lines_and_starts_nothing(terminal: Terminal) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        told = terminal.run("local", "--port", str(port))

    assert told.returncode == 2
    assert told.stderr.splitlines() == [
        f"ConfigurationError: cannot listen on 127.0.0.1:{port}: Address already in use",
        "  hint: choose another port with --port; --port 0 takes a free one",
    ]
    assert read_state(terminal.folder) is None


def until_said(process: subprocess.Popen[str], words: str) -> str:
    """Return what the platform said up to *words*."""
    assert process.stdout is not None
    said = ""
    for line in process.stdout:
        said += line
        if words in line:
            return said
    raise AssertionError(said)


def test_a_new_control_plane_takes_over_what_runs(terminal: Terminal) -> None:
    process, before, _ = terminal.platform()
    process.kill()
    process.wait(SOON_S)

    _, after, said = terminal.platform()

    assert "servers of an earlier control plane were adopted: server-1" in said
    assert after.processes() == before.processes()
    assert after.data_server == before.data_server is not None
    assert (after.url, after.key_file) == (before.url, before.key_file)


def test_a_data_server_that_died_without_a_control_plane_is_started_by_the_next_one(
    terminal: Terminal,
) -> None:
    process, before, said = terminal.platform()
    assert "large data goes to  http://127.0.0.1:" in said
    process.kill()
    process.wait(SOON_S)
    assert before.data_server is not None
    told = terminal.run("local", "kill", "data-1")
    assert told.stdout == f"killed: data-1 (pid {before.data_server.process.pid}, 1 processes)\n"

    _, after, said = terminal.platform()

    assert "data server data-1 is ready" in said
    assert after.data_server is not None
    assert after.data_server.port == before.data_server.port
    assert after.data_server.process != before.data_server.process


def test_a_killed_balancer_comes_back_on_the_same_port(terminal: Terminal) -> None:
    process, state, _ = terminal.platform()

    told = terminal.run("local", "kill-balancer")

    assert state.load_balancer is not None
    assert told.stdout == f"killed the load balancer (pid {state.load_balancer.pid})\n"
    until_said(process, "the load balancer is back")
    assert terminal.state().url == state.url


def test_a_killed_server_is_replaced_and_both_are_told_in_words(terminal: Terminal) -> None:
    process, state, _ = terminal.platform()
    server = state.servers[0]

    told = terminal.run("local", "kill", "server-1")

    # A supervisor, a worker, and five that wait for a crash of native code.
    assert told.stdout == f"killed: server-1 (pid {server.process.pid}, 7 processes)\n"
    assert "server-1 ended" in until_said(process, "server-2 is ready")
    terminal.state()


def test_pause_for_a_moment_stops_the_tree_and_lets_it_go_on(terminal: Terminal) -> None:
    _, state, _ = terminal.platform()

    told = terminal.run("local", "pause", "server-1", "--for", "0.2")

    assert told.returncode == 0
    assert told.stdout.splitlines()[1] == "server-1 continues"
    assert is_alive(state.servers[0].process)
    table = terminal.run("local", "status").stdout
    assert table.splitlines()[0].split()[:4] == ["server", "pid", "state", "robots"]
    assert table.splitlines()[1].split()[:3] == ["server-1", str(state.servers[0].process.pid), "ready"]
    assert state.url in table


def test_slow_ends_with_ctrl_c_and_the_server_is_whole(terminal: Terminal) -> None:
    _, state, _ = terminal.platform()
    process = terminal.start("local", "slow", "server-1", "--percent", "50")
    assert process.stdout is not None
    assert process.stdout.readline() == "server-1 has 50 % of its time; Ctrl-C ends that\n"

    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=SOON_S)

    assert (process.returncode, said, errors) == (0, "server-1 has all of its time again\n", "")
    fields = Path(f"/proc/{state.servers[0].process.pid}/stat").read_text().rpartition(")")[2].split()
    assert fields[0] in "SR"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("kill", "server-9"), "no server named 'server-9' is running"),
        (("kill",), "rse-pf local kill: the following arguments are required: SERVER"),
        (("status", "server-1"), "rse-pf local status: unrecognized arguments: server-1"),
        (("slow", "server-1"), "rse-pf local slow: the following arguments are required: --percent"),
        (("pause", "server-1", "--for", "-1"), "--for takes a positive number"),
        (("kill", "server-1", "--for", "1"), "rse-pf local kill: unknown option --for"),
    ],
)
def test_a_wrong_word_is_two_lines_and_breaks_nothing(
    terminal: Terminal, words: tuple[str, ...], said: str
) -> None:
    _, state, _ = terminal.platform() if words[-1] == "server-9" else (None, None, "")

    told = terminal.run("local", *words)

    assert told.returncode == 2
    assert said in told.stderr.splitlines()[0]
    assert len(told.stderr.splitlines()) == 2
    assert state is None or ("running: server-1" in told.stderr and all(map(is_alive, state.processes())))


@pytest.mark.parametrize("action", ["status", "kill-balancer"])
def test_without_a_platform_there_is_nothing_to_look_at_or_to_break(terminal: Terminal, action: str) -> None:
    told = terminal.run("local", action)

    assert (told.returncode, told.stdout) == (2, "")
    assert "hint: start it with: rse-pf local" in told.stderr
