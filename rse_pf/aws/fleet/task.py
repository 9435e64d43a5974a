"""The tasks of the agent: their common type, and the context that they share.

Each module below `rse_pf.aws.fleet.tasks` has a function ``task(context)`` that makes its task.  A task keeps
its own state, raises RsePfError or OSError when it fails, and is called again after its period.
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
    """The phase of the instance's life cycle, which the task `lifecycle` changes."""

    STARTING = "starting"
    """The instance is not in service yet."""
    WARMED = "warmed"
    """The instance waits in the warm pool, installed; it takes no robots and publishes no metrics."""
    SERVING = "serving"
    LEAVING = "leaving"
    """The server drains or has drained; the termination hook is not completed yet."""
    LEFT = "left"


ALWAYS = frozenset(Phase)
"""All phases, for tasks that always run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """The names and paths that the agent's command line gives.

    Attributes:
        group: Name of the Auto Scaling group.
        hook: Name of the termination hook, which is completed when the server has drained.
        keys_name: Name of the public keys in the artifact bucket.
        keys_file: Local file of the public keys; it lies in memory (tmpfs), so that a revocation reaches the
            server also when the disk is full.
        state_folder: Folder of files that must survive a boot.
        launch_hook: Name of the launch hook, which is completed when the server is ready; "": there is none.
    """

    group: str
    hook: str
    keys_name: str
    keys_file: Path
    state_folder: Path
    launch_hook: str = ""


@dataclass(slots=True, kw_only=True)
class AgentState:
    """The phase of the instance, and `flush`, which at once runs every task with ``flushes``, due or not."""

    phase: Phase = Phase.STARTING
    flush: Callable[[], None] = lambda: None


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentContext:
    """The objects that tasks share.

    Attributes:
        machine: This instance and its servers.
        clients: Maps the name of an AWS service to its boto3 client.
        artifacts: The artifact bucket.
        config: Names and paths from the command line.
        settings: Settings of the platform.
        log: Writes an event with fields to the agent's log.
        shipper: Uploads the audit logs; None if there are none.
        journal: Reads the machine's journal; None ships no journals.
        clock: Monotonic seconds.
        wall_clock: Unix seconds.
        sleep: Waits for some seconds.
        state: The phase of the instance.
    """

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
        name: Name of the task in the log.
        period_s: Seconds between two calls; 0 means at every step of the agent, that is every second.
        call: The function that does the work once.
        phases: Phases of the instance in which the task is called.
        flushes: Whether the task is also called before a drain, and before the hook is completed.
        in_thread: Whether the task has a thread of its own, so that a drain, which blocks the main loop, does
            not delay it.
    """

    name: str
    period_s: float
    call: Callable[[], None]
    phases: frozenset[Phase] = ALWAYS
    flushes: bool = False
    in_thread: bool = False
