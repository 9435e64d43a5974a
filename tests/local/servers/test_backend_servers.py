"""Server processes: what they announce is believed only from the right pid; failures name their cause."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from rse_pf.auth.control_token import ensure_control_token
from rse_pf.errors import ConfigurationError
from rse_pf.local.processes import is_alive
from rse_pf.local.servers.backend_servers import LocalBackendServers
from rse_pf.local.state import control_token_file

pytestmark = pytest.mark.system

SOON_S = 20.0

FAKE = """
import json, os, signal, sys
from pathlib import Path
options = dict(zip(sys.argv[2::2], sys.argv[3::2]))
announce = Path(options["--announce"])
told = {"server": options["--server-id"], "pid": os.getpid() + %d, "port": 1, "control_port": 1}
told["workers"] = []
part = announce.with_suffix(".part")
part.write_text(json.dumps(told))
%s
part.rename(announce)
signal.pause()
"""
"""Announces itself as a server does, and waits for a signal."""


def servers(folder: Path, script: str) -> LocalBackendServers:
    ensure_control_token(control_token_file(folder), seed=bytes(32))
    return LocalBackendServers(folder=folder, program=(sys.executable, "-c", script))


def with_server(
    folder: Path, script: str, work: Callable[[LocalBackendServers], Coroutine[Any, Any, Any]]
) -> tuple[Any, bool]:
    """Launch one, let *work* speak, and return its answer and whether anything is left running."""
    made = servers(folder, script)
    made.launch("server-1")
    marks = made.marks
    try:
        answer = asyncio.run(work(made))
    finally:
        made.kill_all()
    return answer, any(map(is_alive, marks.values()))


def test_an_announcement_of_another_pid_is_not_trusted(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="announced pid"):
        with_server(tmp_path, FAKE % (1, ""), lambda made: made.wait_ready("server-1", SOON_S))


def test_a_server_that_ends_shows_the_last_line_of_its_log(tmp_path: Path) -> None:
    script = "import sys; print('chatter', flush=True); sys.exit('no cheese today')"

    with pytest.raises(ConfigurationError, match="exit code 1: no cheese today") as told:
        with_server(tmp_path, script, lambda made: made.wait_ready("server-1", SOON_S))
    assert str(tmp_path / "server-1.log") in told.value.hint
