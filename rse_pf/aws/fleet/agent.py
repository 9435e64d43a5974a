"""The agent of a backend server on its instance: publish metrics, fetch keys and access control, drain.

    python -m rse_pf.aws.fleet.agent --settings FILE --bucket B --keys-file FILE --group G --hook H

Without it the idle alarm never fires and a scale-in disconnects robots.  A task that fails writes one line to
the log and is repeated; the other tasks go on.  The agent writes public keys, roster and deny list; the only
secret it writes is the token of the control port, which never leaves the machine.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.audit.log import SYNC_S
from rse_pf.auth.control_token import ensure_control_token
from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import DENY_NAME, REFRESH_S, ROBOTS_NAME
from rse_pf.aws.clients import call_api, make_client
from rse_pf.aws.fleet.drain_hook import leave_group
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.metrics import ServerMetrics, datums, read_page
from rse_pf.aws.storage.audit_archive import Shipper
from rse_pf.aws.storage.s3_store import open_bucket
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import NotFound, RsePfError, message_of
from rse_pf.files import replace_file
from rse_pf.object_store import ObjectStore
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.terminal import show, show_error

__all__ = ["Agent", "AgentConfig", "main"]

_NO_KEYS = "no keys in the bucket yet, so robots are refused; run rse-pf token init --cloud"


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """Group and lifecycle hook of the instance; object name and local file of the public keys."""

    group: str
    hook: str
    keys_name: str
    keys_file: Path


class Agent:
    """The tasks of the agent; `step` runs those that are due and is called repeatedly."""

    def __init__(
        self,
        machine: Instance,
        *,
        cloudwatch: Any,
        autoscaling: Any,
        artifacts: ObjectStore,
        config: AgentConfig,
        settings: PlatformSettings,
        log: Callable[..., None],
        shipper: Shipper | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._machine = machine
        self._cloudwatch = cloudwatch
        self._autoscaling = autoscaling
        self._artifacts = artifacts
        self._config = config
        self._settings = settings
        self._log = log
        self._shipper = shipper
        self._clock = clock
        self._sleep = sleep
        self._before: ServerMetrics | None = None
        self._due_s = self._ship_due_s = 0.0
        self.has_left = False

    def step(self) -> None:
        """Check the lifecycle; when due, fetch keys, publish metrics and ship the audit log."""
        if not self.has_left:
            self._try("lifecycle", self._check_lifecycle)
        if self._clock() >= self._due_s:
            self._due_s = self._clock() + self._settings.scaling.period_s
            self._try("keys", self.fetch_keys)
            if not self.has_left:
                self._try("metrics", self._publish)
        if self._clock() >= self._ship_due_s:
            self._ship_due_s = self._clock() + self._settings.cloud.audit_ship_s
            self._try("audit", self._ship)

    def fetch_keys(self) -> None:
        """Write the public keys if they changed; an invalid key set is refused and the old one stays."""
        file = self._config.keys_file
        exists = self._fetch(
            self._config.keys_name, file, lambda data: KeySet.from_json(data.decode("utf-8", "replace"))
        )
        if not exists and not file.exists():
            replace_file(file, b'{"keys":[]}\n')
            self._log("no-keys", hint=_NO_KEYS)

    def fetch_access_control(self) -> None:
        """Write roster and deny list if they changed; a missing or invalid one changes nothing."""
        folder = self._config.keys_file.parent
        self._fetch(ROBOTS_NAME, folder / ROBOTS_NAME, lambda data: from_json(data, Roster))
        self._fetch(DENY_NAME, folder / DENY_NAME, lambda data: from_json(data, DenyList))

    def _fetch(self, name: str, file: Path, check: Callable[[bytes], object]) -> bool:
        """Write the object *name* to *file* if it changed and passes *check*; return whether it exists."""
        try:
            fresh = self._artifacts.get(name)
        except NotFound:
            return False
        if not file.exists() or file.read_bytes() != fresh:
            check(fresh)
            file.parent.mkdir(exist_ok=True)
            replace_file(file, fresh)
            self._log("fetched", name=name, bytes=len(fresh))
        return True

    def watch_access_control(self, sleep: Callable[[float], None] = time.sleep) -> None:
        """Fetch roster and deny list for ever; in a thread, because a drain blocks `step`."""
        while True:
            self._try("access-control", self.fetch_access_control)
            sleep(REFRESH_S)

    def _check_lifecycle(self) -> None:
        if self._machine.is_leaving():
            self._log("leaving", group=self._config.group)
            self._try("audit", self._ship)  # most of the log is uploaded before time is short
            drained = leave_group(
                self._machine, self._autoscaling, group=self._config.group, hook=self._config.hook,
                settings=self._settings, clock=self._clock, sleep=self._sleep, before_end=self._ship_last,
            )  # fmt: skip
            self.has_left = True
            self._log("left", drained=drained)

    def _ship_last(self) -> None:
        self._sleep(2 * SYNC_S)  # a server that has ended was still writing
        self._try("audit", self._ship)

    def _ship(self) -> None:
        count = 0 if self._shipper is None else self._shipper.ship()
        if count:
            self._log("shipped", pieces=count)

    def _publish(self) -> None:
        now = read_page(self._machine.page())
        if self._before is None:
            self._before = now  # counts from before the agent's start do not belong to this period
        data = datums(self._before, now, self._config.group, self._machine.instance_id())
        call_api(self._cloudwatch, "put_metric_data", Namespace=NAMESPACE, MetricData=data)
        self._before = now

    def _try(self, task: str, work: Callable[[], None]) -> None:
        try:
            work()
        except (RsePfError, OSError) as error:
            self._log("failed", task=task, error=message_of(error)[:200])


def main(arguments: list[str] | None = None) -> int:
    """Run until a signal ends the process; ``--once`` only makes the token and fetches the keys."""
    parser = argparse.ArgumentParser(prog="rse-pf-agent", description="agent of a backend server on AWS")
    parser.add_argument("--settings", type=Path, required=True, metavar="FILE")
    for name in ("bucket", "keys-name", "group", "hook"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--keys-file", type=Path, required=True, metavar="FILE")
    parser.add_argument(
        "--control-token", type=Path, metavar="FILE", help="the token of the control port; --once makes it"
    )
    parser.add_argument("--audit", type=Path, metavar="FOLDER", help="where servers write their audit logs")
    parser.add_argument("--audit-bucket", metavar="B", help="where the audit logs go")
    parser.add_argument("--once", action="store_true", help="fetch the keys and exit")
    args = parser.parse_args(arguments)
    try:
        settings = load_settings(args.settings)
        if args.once and args.control_token is not None:
            ensure_control_token(args.control_token, seed=secrets.token_bytes(32))
        region = settings.cloud.region
        config = AgentConfig(
            group=args.group, hook=args.hook, keys_name=args.keys_name, keys_file=args.keys_file
        )
        machine = Instance(settings.serving.control_port, args.control_token)
        agent = Agent(
            machine,
            cloudwatch=make_client("cloudwatch", region),
            autoscaling=make_client("autoscaling", region), artifacts=open_bucket(args.bucket, region),
            config=config, settings=settings, log=_log, shipper=_shipper(args, region, machine),
        )  # fmt: skip
        if args.once:
            agent.fetch_keys()
            agent.fetch_access_control()
            return 0
    except RsePfError as error:
        show_error(error)
        return 2
    threading.Thread(target=agent.watch_access_control, daemon=True).start()
    while True:
        agent.step()
        time.sleep(settings.cloud.poll_s)  # AWS does not notify an instance, so the agent polls


def _shipper(args: argparse.Namespace, region: str, machine: Instance) -> Shipper | None:
    if args.audit is None or args.audit_bucket is None:
        return None
    return Shipper(
        args.audit, open_bucket(args.audit_bucket, region), instance=machine.instance_id,
        marks_file=args.audit.with_name(f"{args.audit.name}-shipped.json"),
        on_broken=lambda chain, problem: _log("audit-broken", chain=chain, problem=problem[:200]),
    )  # fmt: skip


def _log(event: str, **fields: Any) -> None:
    line = {"at_s": round(time.time(), 3), "event": f"agent-{event}", **fields}
    show(json.dumps(line), error=True)


if __name__ == "__main__":
    sys.exit(main())
