"""The data service as a process: killed during uploads, on a full disk, replaced when it ends."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import StoreFull
from rse_pf.identity import RobotId, object_name
from rse_pf.local.servers.single_servers import local_data_server
from rse_pf.storage.object_store import DirectoryStore, digest_of

pytestmark = pytest.mark.system

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(b"k" * 32, "key-1")
UPLOADS = int(os.environ.get("RSE_PF_UPLOADS", "40"))
MIB = 1 << 20


class Platform:
    """One data server and its successors, run by an event loop in a thread."""

    def __init__(self, folder: Path, store: Path) -> None:
        (folder / "keys.json").write_text(KEY.key_set().to_json(), encoding="utf-8")
        (folder / "settings.json").write_text(json.dumps({"context": {"rse-pf": {}}}), encoding="utf-8")
        self.events: list[tuple[float, str]] = []
        self.up = threading.Semaphore(0)
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.servers = local_data_server(SETTINGS, folder=folder, store=f"dir:{store}", emit=self._emit)
        self._call(self.servers.start())

    def _emit(self, event: str, **details: object) -> None:
        self.events.append((time.monotonic(), event))
        if event == "data-server-up":
            self.up.release()

    def _call(self, work: object) -> object:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(60)  # type: ignore[arg-type]

    def client(self, robot: str = "robot-1", **options: object) -> DataClient:
        def token() -> str:
            return KEY.issue(robot, now=time.time(), token_id="t", settings=SETTINGS.auth)

        chosen = DataOptions(part_bytes=MIB // 4, first_pause_s=0.02, random=random.Random(1), **options)  # type: ignore[arg-type]
        return DataClient(f"http://127.0.0.1:{self.servers.port}", token, chosen)

    def close(self) -> None:
        self._call(self.servers.stop(10.0))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(10)
        self.loop.close()


@pytest.fixture
def platform(tmp_path: Path) -> Iterator[Platform]:
    made = Platform(tmp_path, tmp_path / "store")
    yield made
    made.close()


@pytest.mark.slow
def test_uploads_survive_kills_and_acknowledged_objects_are_stored(
    platform: Platform, tmp_path: Path
) -> None:
    contents = [random.Random(n).randbytes(MIB) for n in range(UPLOADS)]
    acknowledged: list[str] = []
    offsets: list[int] = []
    reached = {
        UPLOADS // 4: threading.Event(),
        UPLOADS // 2: threading.Event(),
        3 * UPLOADS // 4: threading.Event(),
    }

    def upload(content: bytes) -> str:
        client = platform.client()
        digest = client.upload(content, lambda done, size: offsets.append(done))
        client.close()
        acknowledged.append(digest)
        for count, event in reached.items():
            if len(acknowledged) >= count:
                event.set()
        return digest

    assert platform.up.acquire(timeout=20)
    with ThreadPoolExecutor(4) as pool:
        running = [pool.submit(upload, content) for content in contents]
        for event in reached.values():
            assert event.wait(100)
            platform.servers.process.send(signal.SIGKILL)
            assert platform.up.acquire(timeout=20)
        digests = [each.result() for each in running]

    ended = [at for at, event in platform.events if event == "data-server-down"]
    started = [at for at, event in platform.events if event == "data-server-up"]
    back_s = [up - down for down, up in zip(ended, started[1:], strict=True)]
    store = DirectoryStore(tmp_path / "store")
    print(f"{len(digests)} uploads, 3 kills, ready again after {', '.join(f'{s:.2f}' for s in back_s)} s")
    assert digests == [digest_of(content) for content in contents]
    assert len(back_s) == 3
    assert max(back_s) <= 5.0
    names = {object_name(RobotId("default", "robot-1"), digest) for digest in digests}
    assert {info.name for info in store.list("objects/")} == names
    for name in names:
        assert digest_of(store.get(name)) == name.rpartition("/")[2]
    client = platform.client()
    assert dict(client.objects()) == dict.fromkeys(digests, MIB)
    assert list(store.list("uploads/")) == []
    client.close()


def test_an_upload_resumes_after_the_last_stored_part(platform: Platform) -> None:
    content = random.Random(7).randbytes(2 * MIB)
    seen: list[int] = []
    assert platform.up.acquire(timeout=20)

    def kill_at_half(done: int, size: int) -> None:
        seen.append(done)
        if done == size // 2:
            platform.servers.process.send(signal.SIGKILL)
            assert platform.up.acquire(timeout=20)

    client = platform.client()
    digest = client.upload(content, kill_at_half)

    assert seen == list(range(0, 2 * MIB + 1, MIB // 4))  # no part was sent twice, none was lost
    assert client.download(digest) == content
    client.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_full_disk_is_reported_and_leaves_no_partial_object(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("this machine does not let us mount a tmpfs")
    try:
        platform = Platform(tmp_path, disk / "store")
    except BaseException:
        subprocess.run(["umount", str(disk)], check=True)
        raise
    client = platform.client()
    try:
        kept: list[str] = []

        def fill() -> None:
            for n in range(40):
                kept.append(client.upload(random.Random(n).randbytes(MIB // 4)))

        with pytest.raises(StoreFull):
            fill()

        assert len(kept) >= 10
        files = [path for path in (disk / "store" / "objects").rglob("*") if path.is_file()]
        assert len(files) == len(kept)
        assert client.download(kept[0]) == random.Random(0).randbytes(MIB // 4)
        client.delete(kept[0])
        assert client.upload(random.Random(99).randbytes(MIB // 4))
    finally:
        client.close()
        platform.close()
        subprocess.run(["umount", str(disk)], check=True)


def test_the_service_ends_on_sigterm_and_is_replaced_on_the_same_port(platform: Platform) -> None:
    assert platform.up.acquire(timeout=20)
    port = platform.servers.port

    platform.servers.process.send(signal.SIGTERM)

    assert platform.up.acquire(timeout=20)
    assert platform.servers.port == port
    assert asyncio.run(platform.servers.is_ready())
