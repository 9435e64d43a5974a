"""A task of the agent: one row of the agent's table, and the context that tasks share.

A task is made by a function ``task(context)`` of its own module below `rse_pf.aws.fleet.tasks`.  It keeps its
state in itself, raises RsePfError or OSError when it fails, and is called again after its period.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.journal import JournalReader
from rse_pf.aws.storage.audit_archive import Shipper
from rse_pf.config import PlatformSettings
from rse_pf.storage.object_store import ObjectStore

__all__ = ["ALWAYS", "AgentConfig", "AgentContext", "AgentState", "Phase", "Task"]


class Phase(Enum):
    """Phase of the instance's life cycle; `rse_pf.aws.fleet.tasks.lifecycle` changes it."""

    STARTING = "starting"
    """Not in service yet."""
    WARMED = "warmed"
    """Prepared in the warm pool; it takes no robots and publishes nothing."""
    SERVING = "serving"
    LEAVING = "leaving"
    """Draining or drained; the termination hook is not completed yet."""
    LEFT = "left"


ALWAYS = frozenset(Phase)
"""Every phase."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """Group and lifecycle hooks of the instance; object name and local file of the public keys.

    ``hook`` is completed when the robots are gone, ``launch_hook`` when the server is ready; empty: none.
    ``keys_file`` lies in memory (tmpfs), so that a revocation reaches the server also when the disk is full;
    files that must survive a boot are in ``state_folder``.
    """

    group: str
    hook: str
    keys_name: str
    keys_file: Path
    state_folder: Path
    launch_hook: str = ""


@dataclass(slots=True, kw_only=True)
class AgentState:
    """The phase, and `flush`: run every task with ``flushes`` now, whatever its period says."""

    phase: Phase = Phase.STARTING
    flush: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentContext:
    """Objects that tasks share.  ``clients`` maps the name of an AWS service to its boto3 client."""

    machine: Instance
    clients: Mapping[str, Any]
    artifacts: ObjectStore
    config: AgentConfig
    settings: PlatformSettings
    log: Callable[..., None]
    shipper: Shipper | None = None
    journal: JournalReader | None = None
    clock: Callable[[], float] = time.monotonic
    wall_clock: Callable[[], float] = time.time
    sleep: Callable[[float], None] = time.sleep
    state: AgentState = field(default_factory=AgentState)


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One row of the agent's table.

    Attributes:
        name: For the log.
        period_s: Seconds between two calls; 0 is at every step, that is every second.
        call: The work.
        phases: When it is called at all.
        flushes: Whether it is also called before an instance drains, and before its hook is completed.
        in_thread: Whether it has a thread of its own, because a drain blocks the others.
    """

    name: str
    period_s: float
    call: Callable[[], None]
    phases: frozenset[Phase] = ALWAYS
    flushes: bool = False
    in_thread: bool = False
