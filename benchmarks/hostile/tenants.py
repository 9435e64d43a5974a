"""Interleave commands of three tenants whose robots have one name: no data may reach another tenant.

    python -m benchmarks hostile.tenants [--commands 10000]

Every robot is called ``robot-1``.  Each sends frames of the same streams (the rival's with far higher
sequence numbers), keeps and reads a secret in a stateful service, names its own and the others' stored
objects, and asks for the same long job.  Then the server's log is read: every line of a command must name its
tenant.

Defends the promise that tenants do not see each other: in 10,000 interleaved commands no data of another
tenant appears, and no command is refused as ``stale`` because of another tenant's robot of the same name.
"""

from __future__ import annotations

import asyncio
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.server.serving import BenchServer
from tests.kit import tenants


@benchmark(
    Bar("shared", equals=[]),
    Bar("stale", equals=0),
    Bar("every_line_has_its_tenant", equals=True),
    Bar("owners_are_right", equals=True),
)
def run_benchmark(*, commands: int = 10_000) -> dict[str, Any]:
    """Send the commands of all tenants, interleaved."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tenants.prepare(folder)
        with BenchServer(folder, workers=1, **tenants.settings_in(folder)) as server:
            tokens = {tenant: server.token(tenants.NAME, tenant=tenant) for tenant in tenants.TENANTS}
            outcome = asyncio.run(tenants.interleave(f"ws://127.0.0.1:{server.port}/ws", tokens, commands))
        lines = tenants.count_logged(server.log_file.read_text())
        areas = {area: tenants.owners(folder / "store", area) for area in ("states", "jobs", "objects")}
    expected = sorted(f"{tenant}/{tenants.NAME}" for tenant in tenants.TENANTS)
    return {
        "commands": dict(outcome.commands), "codes": dict(outcome.codes), "shared": outcome.shared[:20],
        "stale": outcome.stale, "log_lines": dict(lines), "owners": areas,
        "every_line_has_its_tenant": lines == outcome.commands,
        "owners_are_right": all(stored == expected for stored in areas.values()),
    }  # fmt: skip
