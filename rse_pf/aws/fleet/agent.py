"""Stand beside a backend server on its instance: numbers out; keys, roster and deny-list in; the drain.

    python -m rse_pf.aws.fleet.agent --settings FILE --bucket B --keys-file FILE --group G --hook H

Without it the idle alarm never fires and a scale-in cuts robots off.  Each duty fails by itself, with one
line in the log, and is tried again.  Promises to write the public keys and the control room beside them, and
no secret but the token of the control port, which never leaves the machine.
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

from rse_pf.auth.control_token import ensure_control_token
from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import DENY_NAME, ROBOTS_NAME
from rse_pf.aws.clients import ask, make_client
from rse_pf.aws.fleet.drain_hook import leave_group
from rse_pf.aws.fleet.instance import Instance, Machine
from rse_pf.aws.fleet.metrics import ServerMetrics, datums, read_page
from rse_pf.aws.storage.audit_ship import Shipper
from rse_pf.aws.storage.s3_store import open_bucket
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import NotFound, RsePfError
from rse_pf.files import replace_file
from rse_pf.object_store import ObjectStore
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["Agent", "AgentConfig", "main"]

_NO_KEYS = "no keys in the bucket yet, robots are refused; run rse-pf token init --cloud"


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """Where this agent stands: group, hook, and where the keys are and go."""

    group: str
    hook: str
    keys_name: str
    keys_file: Path


class Agent:
    """The duties, each when it is due; `step` is called again and again."""

    def __init__(
        self,
        machine: Machine,
        *,
        cloudwatch: Any,
        autoscaling: Any,
        artifacts: ObjectStore,
        post: AgentConfig,
        settings: PlatformSettings,
        log: Callable[..., None],
        shipper: Shipper | None = None,
        clock: Callable[[], float] = time.monotonic,
        rest: Callable[[float], None] = time.sleep,
    ) -> None:
        self._machine = machine
        self._cloudwatch = cloudwatch
        self._autoscaling = autoscaling
        self._artifacts = artifacts
        self._post = post
        self._settings = settings
        self._log = log
        self._shipper = shipper
        self._clock = clock
        self._rest = rest
        self._before: ServerMetrics | None = None
        self._due_s = self._ship_due_s = 0.0
        self.has_left = False

    def step(self) -> None:
        """Look at the lifecycle; each in its period, fetch keys, publish numbers, ship the audit log."""
        if not self.has_left:
            self._try("lifecycle", self._look_at_lifecycle)
        if self._clock() >= self._due_s:
            self._due_s = self._clock() + self._settings.scaling.period_s
            self._try("keys", self.fetch_keys)
            if not self.has_left:
                self._try("metrics", self._publish)
        if self._clock() >= self._ship_due_s:
            self._ship_due_s = self._clock() + self._settings.cloud.audit_ship_s
            self._try("audit", self._ship)

    def fetch_keys(self) -> None:
        """Write the public keys if they changed; what is no key set is refused and the old one stays."""
        file = self._post.keys_file
        try:
            fresh = self._artifacts.get(self._post.keys_name)
        except NotFound:
            if not file.exists():
                replace_file(file, b'{"keys":[]}\n')
                self._log("no-keys", hint=_NO_KEYS)
            return
        if file.exists() and file.read_bytes() == fresh:
            return
        KeySet.from_json(fresh.decode("utf-8", "replace"))
        replace_file(file, fresh)
        self._log("keys", bytes=len(fresh))

    def fetch_control(self) -> None:
        """Write what the bucket's control room says; what is nonsense or gone changes nothing."""
        for name, kind in ((ROBOTS_NAME, Roster), (DENY_NAME, DenyList)):
            file = self._post.keys_file.parent / name
            try:
                fresh = self._artifacts.get(name)
            except NotFound:
                continue  # nobody was ever enrolled or denied, or somebody deleted what servers still know
            if file.exists() and file.read_bytes() == fresh:
                continue
            from_json(fresh, kind)
            file.parent.mkdir(exist_ok=True)
            replace_file(file, fresh)
            self._log("control", name=name, bytes=len(fresh))

    def watch_control(self, rest: Callable[[float], None] = time.sleep) -> None:
        """Fetch it again and again, for ever; in a thread, since a drain holds `step` up."""
        while True:
            self._try("control", self.fetch_control)
            rest(self._settings.auth.deny_list_refresh_s)

    def _look_at_lifecycle(self) -> None:
        if self._machine.is_leaving():
            self._log("leaving", group=self._post.group)
            self._try("audit", self._ship)  # most of it goes before the time is short
            drained = leave_group(
                self._machine, self._autoscaling, group=self._post.group, hook=self._post.hook,
                settings=self._settings, clock=self._clock, rest=self._rest, before_end=self._ship_the_rest,
            )  # fmt: skip
            self.has_left = True
            self._log("left", drained=drained)

    def _ship_the_rest(self) -> None:
        self._rest(2e-3 * self._settings.auth.audit_sync_ms)  # a server that has left is still writing
        self._try("audit", self._ship)

    def _ship(self) -> None:
        count = 0 if self._shipper is None else self._shipper.ship()
        if count:
            self._log("shipped", pieces=count)

    def _publish(self) -> None:
        now = read_page(self._machine.page())
        if self._before is None:
            self._before = now  # what was before this agent began is not this period's
        data = datums(self._before, now, self._post.group, self._machine.instance_id())
        ask(self._cloudwatch, "put_metric_data", Namespace=NAMESPACE, MetricData=data)
        self._before = now

    def _try(self, duty: str, work: Callable[[], None]) -> None:
        try:
            work()
        except (RsePfError, OSError) as error:
            self._log("failed", duty=duty, why=str(error)[:200])


def main(arguments: list[str] | None = None) -> int:
    """Stand at the post until a signal ends it; ``--once`` only makes the token and fetches the keys."""
    parser = argparse.ArgumentParser(prog="rse-pf-agent", description="the agent of a backend server on AWS")
    parser.add_argument("--settings", type=Path, required=True, metavar="FILE")
    for name in ("bucket", "keys-name", "group", "hook"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--keys-file", type=Path, required=True, metavar="FILE")
    parser.add_argument(
        "--control-token", type=Path, metavar="FILE", help="the token of the control port; --once makes it"
    )
    parser.add_argument("--audit", type=Path, metavar="FOLDER", help="where servers write their audit logs")
    parser.add_argument("--audit-bucket", metavar="B", help="where the audit logs go")
    parser.add_argument("--once", action="store_true", help="fetch the keys and leave")
    args = parser.parse_args(arguments)
    try:
        settings = load_settings(args.settings)
        if args.once and args.control_token is not None:
            ensure_control_token(args.control_token, seed=secrets.token_bytes(32))
        region = settings.cloud.region
        post = AgentConfig(
            group=args.group, hook=args.hook, keys_name=args.keys_name, keys_file=args.keys_file
        )
        machine = Instance(settings.serving.control_port, args.control_token)
        agent = Agent(
            machine,
            cloudwatch=make_client("cloudwatch", region),
            autoscaling=make_client("autoscaling", region), artifacts=open_bucket(args.bucket, region),
            post=post, settings=settings, log=_log, shipper=_shipper(args, region, machine),
        )  # fmt: skip
        if args.once:
            agent.fetch_keys()
            agent.fetch_control()
            return 0
    except RsePfError as error:
        sys.stderr.write(f"{error.report()}\n")
        return 2
    threading.Thread(target=agent.watch_control, daemon=True).start()
    while True:
        agent.step()
        time.sleep(settings.cloud.poll_s)  # it polls, because nobody calls an instance


def _shipper(args: argparse.Namespace, region: str, machine: Machine) -> Shipper | None:
    if args.audit is None or args.audit_bucket is None:
        return None
    return Shipper(
        args.audit, open_bucket(args.audit_bucket, region), instance=machine.instance_id,
        marks_file=args.audit.with_name(f"{args.audit.name}-shipped.json"),
        on_broken=lambda who, why: _log("audit-broken", who=who, why=why[:200]),
    )  # fmt: skip


def _log(event: str, **fields: Any) -> None:
    line = {"at_s": round(time.time(), 3), "event": f"agent-{event}", **fields}
    sys.stderr.write(json.dumps(line) + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
