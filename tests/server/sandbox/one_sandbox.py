"""Become one sandbox, as the zygote makes it: ``python one_sandbox.py FOLDER FD MEMORY_BYTES SCRATCH_BYTES``.

A process of its own, because a sandbox has the address space of the process that it was forked from, and the
limit of memory counts all of it.  The service lies in FOLDER, and FD is the socket to whom it answers.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rse_pf.server.sandbox import isolation
from rse_pf.server.sandbox.child import SandboxPlan, readable_paths, run_sandbox
from rse_pf.services.custom.installed import read_service


def main(folder: str, fd: str, memory_bytes: str, scratch_bytes: str) -> None:
    """Enter the namespaces and fork the sandbox; exit as the sandbox did."""
    service = read_service(Path(folder))
    plan = SandboxPlan(
        services={service.name: service},
        readable=readable_paths([service]),
        memory_bytes=int(memory_bytes),
        scratch_bytes=int(scratch_bytes),
        max_bytes=1 << 24,
        missing=(),
    )
    isolation.enter_namespaces()
    pid = os.fork()
    if pid == 0:
        run_sandbox(plan, int(fd), 2, 3_000_000 + os.getppid() if os.getuid() == 0 else None)
    os.close(int(fd))
    sys.exit(abs(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])))


if __name__ == "__main__":
    main(*sys.argv[1:])
