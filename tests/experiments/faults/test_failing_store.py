"""A store that fails by order: in processes of its environment alone, and half of the writes take place."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from rse_pf.extensions.experiments.faults.failing_store import failing_environment, set_failing_percent
from rse_pf.storage.object_store import DirectoryStore

PROGRAM = """
import sys
from pathlib import Path
from rse_pf.errors import StoreError
from rse_pf.storage.object_store import DirectoryStore
store, failed = DirectoryStore(Path(sys.argv[1])), 0
for number in range(200):
    try:
        store.put(f"o/{number}", b"x")
    except StoreError:
        failed += 1
print(failed)
"""


def test_a_share_of_the_operations_fails_in_processes_started_inside(tmp_path: Path) -> None:
    def failures() -> int:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(tmp_path / "objects")],
            capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3],
        )  # fmt: skip
        return int(done.stdout)

    with failing_environment(tmp_path / "order"):
        set_failing_percent(tmp_path / "order", 30.0)
        failed = failures()
    stored = sum(1 for _ in DirectoryStore(tmp_path / "objects").list("o/"))

    assert 30 <= failed <= 90  # 60 of 200, 6.5 standard deviations at most
    assert 200 - failed < stored < 200
    assert "RSE_PF_FAILING_STORE" not in os.environ
