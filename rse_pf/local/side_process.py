"""Run an optional process beside a local platform, such as the fleet page or the burst function."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

__all__ = ["run_beside_platform"]

# Time after which a process that does not exit on SIGTERM is killed, in seconds.
_END_S = 3.0


@contextlib.asynccontextmanager
async def run_beside_platform(
    module: str, folder: Path, port: int, log_file: Path, on_address: Callable[[str], None]
) -> AsyncIterator[None]:
    """Run *module* as a process with the platform's *folder* inside the block; its output goes to *log_file*.

    *on_address* is called with the address that the process prints.  The platform neither waits for the
    process nor stops when it exits.
    """
    with log_file.open("ab") as log:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", module, str(folder), "--port", str(port),
            "--parent", str(os.getpid()), stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE,
            stderr=log, start_new_session=True,
        )  # fmt: skip
    reader = asyncio.ensure_future(_read_address(process, on_address))
    try:
        yield
    finally:
        reader.cancel()
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), _END_S)
        except asyncio.TimeoutError:
            process.kill()
            await process.wait()


async def _read_address(process: asyncio.subprocess.Process, on_address: Callable[[str], None]) -> None:
    assert process.stdout is not None
    line = await process.stdout.readline()
    with contextlib.suppress(ValueError, KeyError):
        on_address(str(json.loads(line)["url"]))
