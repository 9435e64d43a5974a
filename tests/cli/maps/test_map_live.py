"""rse-pf map live: what it shows of live maps that no server has now; it starts no owner for that."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.live_map.events import MapServerChanged, encode_events
from rse_pf.server.live_map.lease import MapLease, lease_name, map_folder
from rse_pf.server.live_map.map_server.log import LiveLog
from rse_pf.storage.object_store import DirectoryStore


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with the live maps "hall", which its owner released, and "attic", which was stopped."""
    objects = DirectoryStore(tmp_path / "store")
    for name in ("hall", "attic"):
        lease = MapLease(
            objects,
            lease_name("default", name),
            owner="a-1",
            server="server-1",
            clock=lambda: 0.0,
        )
        lease.claim(None)
        LiveLog(objects, map_folder("default", name), owner="a-1", epoch=1).write_entry(
            encode_events([MapServerChanged(owner="a-1", epoch=1)])
        )
        assert lease.release() if name == "hall" else lease.stop(1)
    return tmp_path / "store"


def run(store: Path, *words: str) -> int:
    return main(["map", *words, "--store", f"dir:{store}"])


def test_list_names_each_live_map_with_its_state(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(store, "live", "list") == 0

    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines] == [
        ["attic", "stopped", "server-1"], ["hall", "idle", "server-1"],
    ]  # fmt: skip
    assert run(store, "live", "list", "--tenant", "other") == 0
    assert capsys.readouterr().out == "no live maps\n"


def test_show_reads_the_log_and_takes_no_lease(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lease = (store / "live/default/hall/lease").read_bytes()
    assert run(store, "live", "show", "hall", "--json") == 0

    shown = json.loads(capsys.readouterr().out)
    assert (shown["state"], shown["keyframes"], shown["version"]) == ("idle", 0, 1)
    assert (store / "live/default/hall/lease").read_bytes() == lease


def test_a_map_that_was_stopped_is_not_shown(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(store, "live", "show", "attic") == 1
    assert "live map 'attic' was stopped" in capsys.readouterr().err
