"""``rse-pf local`` as a person uses it: Ctrl-C, stop, a killed control plane, and nothing left running."""

from __future__ import annotations

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


def test_stop_without_a_platform_says_so(terminal: Terminal) -> None:
    told = terminal.run("local", "stop")

    assert (told.returncode, told.stdout) == (0, "platform 'default' was not running\n")


def test_a_killed_control_plane_leaves_the_data_path_and_stop_cleans_it_up(terminal: Terminal) -> None:
    process, state, _ = terminal.platform()
    process.kill()
    process.wait(SOON_S)

    assert all(map(is_alive, state.processes())), "the data path must outlive the control plane"
    control = f"http://127.0.0.1:{state.servers[0].control_port}/readyz"
    with urllib.request.urlopen(control, timeout=SOON_S) as answer:
        assert answer.status == 200
    again = terminal.run("local", "--port", "0")
    assert again.returncode == 2
    assert "outlived their control plane\n  hint: end them with: rse-pf local stop" in again.stderr

    told = terminal.run("local", "stop")
    assert told.stdout == "platform 'default' is stopped\n"
    assert_gone(state)
    assert read_state(terminal.folder) is None


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
    assert not terminal.folder.exists()


def test_it_ends_with_the_reason_when_the_balancer_dies(terminal: Terminal) -> None:
    process, state, _ = terminal.platform()
    assert state.load_balancer is not None

    send_signal(state.load_balancer, signal.SIGKILL)
    _, errors = process.communicate(timeout=SOON_S)

    assert process.returncode == 1
    assert errors.startswith("RsePfError: the load balancer ended")
    assert len(errors.splitlines()) == 2
    assert_gone(state)
