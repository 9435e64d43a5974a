"""The agent of a backend server on its instance: a table of tasks, each repeated in its own period.

    python -m rse_pf.aws.fleet.agent --settings FILE --bucket B --keys-file FILE --state FOLDER
        --group G --hook H

Without the agent no metrics are published, so that the idle alarm never fires, and a server that is removed
disconnects its robots without a drain.  A task that fails writes one line to the log and is called again
after its period; the other tasks continue.  The agent writes public keys, roster and deny list to files; the
only secret that it writes is the token of the control port, which never leaves the machine.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rse_pf.auth.control_token import ensure_control_token
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.journal import read_journal
from rse_pf.aws.fleet.task import AgentConfig, AgentContext, Phase, Task
from rse_pf.aws.fleet.tasks import (
    access_control,
    audit,
    journals,
    keys,
    lifecycle,
    rebalancing,
    server_metrics,
    services,
    spot_notice,
    store_errors,
)
from rse_pf.aws.storage.audit_archive import Shipper
from rse_pf.aws.storage.s3_store import open_bucket
from rse_pf.config import load_settings
from rse_pf.errors import RsePfError, StoreError, message_of
from rse_pf.terminal import show, show_error

__all__ = ["SERVICES", "TASKS", "Agent", "AgentConfig", "AgentContext", "main"]

TASKS: tuple[Callable[[AgentContext], Task], ...] = (
    lifecycle.task,
    keys.task,
    server_metrics.task,
    rebalancing.task,
    spot_notice.task,
    audit.task,
    journals.task,
    access_control.task,
    services.task,
    store_errors.task,
)
"""The functions that make the tasks, one module each, in the order in which a step runs the tasks."""

# Time between two steps of the agent, in seconds: the shortest period of a task without a thread of its own.
_STEP_S = 1.0
# Name of the file that exists if keys, roster and deny list were fetched since the machine booted.
_FETCHED_FILE = "fetched"

SERVICES = ("autoscaling", "cloudwatch")
"""The AWS services whose clients the tasks use, in addition to S3."""


class Agent:
    """The tasks of one instance.

    `step`, which the main loop calls every second, runs the tasks that are due; some have threads instead.
    """

    def __init__(
        self, context: AgentContext, tasks: tuple[Callable[[AgentContext], Task], ...] = TASKS
    ) -> None:
        """Make each task by calling its function in *tasks* with *context*; no task runs yet."""
        self._context = context
        self._tasks = {task.name: task for task in (make(context) for make in tasks)}
        self._due_s = dict.fromkeys(self._tasks, float("-inf"))
        context.state.flush = self._flush

    @property
    def has_left(self) -> bool:
        """Whether the server has drained and the termination hook is completed."""
        return self._context.state.phase is Phase.LEFT

    def step(self) -> None:
        """Run each task without a thread of its own whose period has passed and that runs in this phase."""
        for task in self._tasks.values():
            now_s = self._context.clock()
            if not task.in_thread and self._may_run(task) and now_s >= self._due_s[task.name]:
                self._due_s[task.name] = now_s + task.period_s
                self._try_task(task)

    def run(self, name: str) -> None:
        """Run the task *name* once, and raise its errors."""
        self._tasks[name].call()

    def attempt(self, name: str) -> None:
        """Run the task *name* once, and log an error instead of raising it."""
        self._try_task(self._tasks[name])

    def repeat(self, name: str, sleep: Callable[[float], None] = time.sleep) -> None:
        """Run the task *name* once in each of its periods, for ever; called in a thread of its own."""
        task = self._tasks[name]
        while True:
            if self._may_run(task):
                self._try_task(task)
            sleep(task.period_s)

    def start_threads(self) -> None:
        """Start a thread that repeats the task, for each task with ``in_thread``."""
        for task in self._tasks.values():
            if task.in_thread:
                threading.Thread(target=self.repeat, args=(task.name,), daemon=True).start()

    def _may_run(self, task: Task) -> bool:
        return self._context.state.phase in task.phases

    def _flush(self) -> None:
        for task in self._tasks.values():
            if task.flushes:
                self._try_task(task)

    def _try_task(self, task: Task) -> None:
        try:
            task.call()
        except (RsePfError, OSError) as error:
            self._context.log("failed", task=task.name, error=message_of(error)[:200])
        except Exception as error:  # noqa: BLE001  a defect of one task must not end the others, or its thread
            self._context.log("failed", task=task.name, error=repr(error)[:200])


def main(arguments: list[str] | None = None) -> int:
    """Run the agent until a signal kills the process; return 2 after an error at the start.

    With ``--once`` make the control token, fetch keys, roster, deny list and services, and return 0.
    """
    parser = argparse.ArgumentParser(prog="rse-pf-agent", description="agent of a backend server on AWS")
    parser.add_argument("--settings", type=Path, required=True, metavar="FILE")
    for name in ("bucket", "keys-name", "group", "hook"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--launch-hook", default="", metavar="H", help="the hook that waits for readiness")
    parser.add_argument(
        "--keys-file", type=Path, required=True, metavar="FILE",
        help="the public keys, in a folder that is empty after each boot",
    )  # fmt: skip
    parser.add_argument(
        "--state",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="where services and the journal's cursor are",
    )
    parser.add_argument(
        "--control-token", type=Path, metavar="FILE", help="the token of the control port; --once makes it"
    )
    parser.add_argument("--audit", type=Path, metavar="FOLDER", help="where servers write their audit logs")
    parser.add_argument("--audit-bucket", metavar="B", help="where the audit logs go")
    parser.add_argument("--once", action="store_true", help="fetch the keys and exit")
    args = parser.parse_args(arguments)
    try:
        context = _context(args)
        agent = Agent(context)
        if args.once:
            _fetch(agent, args.keys_file.with_name(_FETCHED_FILE))
            agent.attempt("services")  # a server without the published services is better than no server
            return 0
    except RsePfError as error:
        show_error(error)
        return 2
    agent.start_threads()
    while True:
        agent.step()
        time.sleep(_STEP_S)


def _fetch(agent: Agent, mark: Path) -> None:
    """Fetch keys, roster and deny list before the server starts; create the file *mark* after a success.

    If S3 does not answer when a server restarts, the files that were fetched since the boot are used, as in a
    running server.  Files of an earlier boot are never used, because a machine of the warm pool may have been
    off for weeks: the folder of the keys, which also holds *mark*, is empty after each boot.

    Raises:
        RsePfError: The objects could not be fetched, now or earlier since the boot.
    """
    try:
        agent.run("keys")
        agent.run("access-control")
    except StoreError as error:
        if not mark.exists():
            raise
        _log("not-fetched", error=message_of(error)[:200])
        return
    mark.touch()


def _context(args: argparse.Namespace) -> AgentContext:
    settings = load_settings(args.settings)
    if args.once and args.control_token is not None:
        ensure_control_token(args.control_token, seed=secrets.token_bytes(32))
    region = settings.cloud.region
    data_port = settings.data.port if settings.data.enabled else 0
    machine = Instance(settings.serving.control_port, args.control_token, data_port)
    return AgentContext(
        machine=machine,
        clients={service: make_client(service, region) for service in SERVICES},
        artifacts=open_bucket(args.bucket, region),
        config=AgentConfig(
            group=args.group,
            hook=args.hook,
            launch_hook=args.launch_hook,
            keys_name=args.keys_name,
            keys_file=args.keys_file,
            state_folder=args.state,
        ),
        settings=settings,
        log=_log,
        shipper=_shipper(args, region, machine),
        journal=read_journal,
    )


def _shipper(args: argparse.Namespace, region: str, machine: Instance) -> Shipper | None:
    if args.audit is None or args.audit_bucket is None:
        return None
    return Shipper(
        args.audit, open_bucket(args.audit_bucket, region), instance=machine.instance_id,
        marks_file=args.audit.with_name(f"{args.audit.name}-shipped.json"),
    )  # fmt: skip


def _log(event: str, **fields: Any) -> None:
    line = {"at_s": round(time.time(), 3), "event": f"agent-{event}", **fields}
    show(json.dumps(line), error=True)


if __name__ == "__main__":
    sys.exit(main())
