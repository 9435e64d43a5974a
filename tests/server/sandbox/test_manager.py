"""A hostile service writes to its worker what it likes: a typed failure for its robot, and nothing else."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.processes.ipc import encode_message
from rse_pf.server.sandbox.dry_run import DryRun, dry_run
from rse_pf.services.custom.installed import read_service

SOURCE = """
import os
import stat
import time
import msgspec

class Request(msgspec.Struct):
    frames: bytes = b""
    times: int = 1

class Reply(msgspec.Struct):
    fine: bool = True

def serve(request: Request) -> Reply:
    if not request.frames:
        return Reply()
    for fd in range(3, 256):
        try:
            if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                continue
        except OSError:
            continue
        left = memoryview(request.frames * request.times)
        while left:
            left = left[os.write(fd, left):]
    time.sleep(60)
"""
SETTINGS = PlatformSettings.from_dict({"services": {"breaker_crashes": 1000}})


@pytest.fixture
def try_it(tmp_path: Path) -> Callable[..., tuple[list[DryRun], list[str]]]:
    manifest = {"name": "hostile", "language": "python", "entry": "service.py", "kind": "stateless"}
    folder = tmp_path / "hostile"
    folder.mkdir()
    (folder / "service.json").write_text(json.dumps(manifest))
    (folder / "service.py").write_text(SOURCE)

    def try_it(*payloads: dict[str, Any]) -> tuple[list[DryRun], list[str]]:
        lines: list[str] = []
        _, runs = dry_run(read_service(folder), payloads, SETTINGS, lines.append)
        return runs, lines

    return try_it


FRAMES = {
    "a number as snapshot": encode_message([True, None, 300_000_000, 1.0]),
    "an array as snapshot": encode_message([True, None, np.zeros(9), 1.0]),
    "NaN as time": encode_message([True, 1, None, math.nan]),
    "a negative time": encode_message([True, 1, None, -5.0]),
    "a failure without a code": encode_message([False, None, "", "", 1.0]),
    "an array that is compared": encode_message([np.zeros(2)]),
    "no list": encode_message({"ready": True}),
    "deep nesting": (100_001).to_bytes(4, "little") + b"\x91" * 100_000 + b"\x00",
    "an endless frame": b"\xff\xff\xff\xff",
    "no MessagePack": (3).to_bytes(4, "little") + b"\xc1\xc1\xc1",
    "its start a second time": encode_message(["ready"]),
}


def test_a_malformed_frame_is_a_typed_failure_and_the_next_command_gets_a_sandbox_that_works(try_it):
    payloads = [each for frames in FRAMES.values() for each in ({"frames": frames}, {})]
    runs, lines = try_it(*payloads)

    codes = [getattr(run.answer, "code", "ok") for run in runs]
    assert dict(zip(FRAMES, codes[::2], strict=True)) == dict.fromkeys(FRAMES, "poison"), "\n".join(lines)
    assert set(codes[1::2]) == {"ok"}
