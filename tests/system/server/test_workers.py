"""Workers are forked from their supervisor, and hold nothing that is not theirs."""

from __future__ import annotations

import os
import re
from itertools import combinations
from pathlib import Path

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.server.supervisor import serve

pytestmark = pytest.mark.system

KEYS = SigningKey.from_seed(b"d" * 32, "k1").key_set()


def sockets_of(pid: int) -> set[str]:
    """Return the sockets that process *pid* holds, by inode."""
    links = [os.readlink(entry) for entry in Path(f"/proc/{pid}/fd").iterdir()]
    return {link for link in links if re.fullmatch(r"socket:\[\d+\]", link)}


def test_no_worker_holds_the_listener_or_a_channel_of_another(start_server):
    server = start_server(serving={"workers": 3})
    held = {pid: sockets_of(pid) for pid in (server.process.pid, *server.workers)}

    assert all(len(sockets) >= 2 for sockets in held.values())
    for one, other in combinations(held, 2):
        assert not held[one] & held[other], (one, other)


def test_services_that_are_not_there_are_said_before_any_worker_is_forked():
    with pytest.raises(ConfigurationError, match="no services at") as caught:
        serve(
            PlatformSettings.from_dict({"serving": {"port": 0}}), keys=KEYS, server_id="s",
            services="rse_pf.services.no_such:thing",
        )  # fmt: skip

    assert caught.value.hint
