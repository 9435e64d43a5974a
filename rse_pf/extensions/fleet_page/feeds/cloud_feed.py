"""The feed of the page of a deployment on AWS, which it reads with the operator's credentials.

The feed reads AWS only while a page is open, changes nothing in the account, and opens no port there.  The
page lists the data that AWS does not provide.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any, TypeVar

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.group import AutoScalingGroup, Server
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.fleet_page.feeds.cloud_metrics import GroupMetrics, read_group_metrics
from rse_pf.extensions.fleet_page.feeds.cloud_overview import CloudOverview, ScalingActivity, read_overview
from rse_pf.extensions.fleet_page.feeds.sentences import waiting_for
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.local.together import run_together
from rse_pf.terminal import printable

__all__ = ["CloudFeed", "cloud_document", "new_events"]

# Time between two readings of the group's state, in seconds.
_STATE_EVERY_S = 10.0
# Time between two messages to the pages about the connection to AWS, in seconds.
_PUBLISH_LINK_EVERY_S = 3.0
# Time between two checks whether a page is open, in seconds.
_CHECK_PAGES_S = 0.25
# Largest number of characters of a text.
_MAX_TEXT = 300
# Number of the newest periods that may lack a CPU value, because CloudWatch publishes it late.
_LATE_PERIODS = 2
# Exceptions that the parsing of an unexpected answer of AWS raises.
_MALFORMED_ANSWER_ERRORS = (LookupError, TypeError, ValueError)
# Sentences about data that AWS does not provide, for the page.
_UNAVAILABLE = (
    "Commands, queue and wait are published for the whole group, not for each server",
    "robots are counted, not named; weak poses, events of the servers and live maps stay on the servers",
    "audit entries: rse-pf audit show --cloud",
)
# Lifecycle states of an instance in the Auto Scaling group, in the words of the local platform.
_STATES = {"InService": "starting", "Pending": "starting", "Terminating": "draining", "Terminated": "gone"}

T = TypeVar("T")


class CloudFeed:
    """Puts state, metrics and events of one deployment into a `Hub`."""

    def __init__(
        self,
        hub: Hub,
        account: Account,
        settings: PlatformSettings,
        first: CloudOverview,
        *,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        """Publish the events of *first*; `run` reads and publishes everything else.

        Args:
            hub: The hub of the page.
            account: The account with the deployment.
            settings: Settings of the deployment.
            first: The state that was read before, as a check of the credentials.
            wall_clock: Returns Unix seconds.
        """
        self._hub = hub
        self._account = account
        self._settings = settings
        self._wall_clock = wall_clock
        self._overview = first
        self._metrics = GroupMetrics(period_s=settings.scaling.period_s)
        self._problems: dict[str, str] = {}
        for event in new_events(None, first, time_s=wall_clock()):
            hub.append("event", event)

    async def run(self) -> None:
        """Publish the first state, then read and publish while a page is open, until cancelled."""
        self._publish()
        works: list[Coroutine[Any, Any, None]] = [
            self._repeat(_STATE_EVERY_S, self._read_state),
            self._repeat(float(self._settings.scaling.period_s), self._read_metrics),
            self._publish_periodically(),
        ]
        await run_together(*works)

    async def _repeat(self, every_s: float, read: Callable[[], Coroutine[Any, Any, None]]) -> None:
        while True:
            while not self._hub.watches("fleet"):
                await asyncio.sleep(_CHECK_PAGES_S)
            await read()
            self._publish()
            await asyncio.sleep(every_s)

    async def _publish_periodically(self) -> None:
        while True:
            self._publish_link()
            await asyncio.sleep(_PUBLISH_LINK_EVERY_S)

    async def _read_state(self) -> None:
        now = self._now()
        read = await self._read_in_thread(
            "state", lambda: read_overview(self._account, self._settings, now=now)
        )
        if read is not None:
            for event in new_events(self._overview, read, time_s=now.timestamp()):
                self._hub.append("event", event)
            self._overview = read

    async def _read_metrics(self) -> None:
        names, now = [server.name for server in self._overview.group.servers], self._now()
        read = await self._read_in_thread(
            "metrics", lambda: read_group_metrics(self._account, self._settings, names, now=now)
        )
        if read is not None:
            self._metrics = read
            self._hub.put("history", "minutes", _history(read))

    async def _read_in_thread(self, subject: str, read: Callable[[], T]) -> T | None:
        """Call *read* in a thread and return its result.

        After an error return None, and store the error under *subject* for the page.
        """
        try:
            value = await asyncio.to_thread(read)
        except RsePfError as error:
            self._problems[subject] = f"{error.message} ({error.hint})"
            return None
        except _MALFORMED_ANSWER_ERRORS as error:  # the page shows the data of the other answers
            self._problems[subject] = f"AWS answers in a way that is not understood: {error}"
            return None
        self._problems.pop(subject, None)
        return value

    def _publish(self) -> None:
        unread = (text for subject, text in self._problems.items() if subject != "state")
        overview = replace(self._overview, problems=(*self._overview.problems, *unread))
        document = cloud_document(
            overview, self._metrics, self._settings, time_s=self._wall_clock(),
            region=self._account.region,
        )  # fmt: skip
        document["pages"] = self._hub.pages
        self._hub.put("fleet", "now", document)
        self._publish_link()

    def _publish_link(self) -> None:
        wrong = self._problems.get("state")
        link = {"connected": wrong is None, "time_s": self._wall_clock()}
        self._hub.put("link", "control_plane", {**link, **({"text": printable(wrong)} if wrong else {})})

    def _now(self) -> datetime:
        return datetime.fromtimestamp(self._wall_clock(), timezone.utc)


def cloud_document(
    overview: CloudOverview,
    metrics: GroupMetrics,
    settings: PlatformSettings,
    *,
    time_s: float,
    region: str = "",
) -> dict[str, Any]:
    """Return the document that the Fleet view shows for a deployment.

    Texts are escaped, unknown values are None.

    Args:
        overview: The state of the deployment.
        metrics: The metrics of the deployment.
        settings: Settings of the deployment.
        time_s: The present time, Unix seconds.
        region: AWS region of the deployment.
    """
    group, balancer, period_s = overview.group, overview.balancer, metrics.period_s
    servers = [_server(server, overview, metrics, time_s) for server in group.servers]
    robots = [server["robots"] for server in servers if server["robots"] is not None]
    answers = metrics.newest("answers")
    percentiles = {name: _round(metrics.newest(name), 1) for name in ("p50_ms", "p95_ms", "p99_ms")}
    per_s = {
        name: _round(_divide(metrics.newest(name), period_s), 2)
        for name in ("requests", "bytes_in", "bytes_out")
    }
    unknown = [*_UNAVAILABLE, *overview.problems]
    if len(robots) < len(servers):
        unknown.insert(
            0, f"{len(servers) - len(robots)} of {len(servers)} servers did not report their robots"
        )
    return {
        "time_s": time_s,
        "cloud": True,
        "platform": printable(f"on AWS, {region}"),
        "url": printable("" if balancer is None else balancer.address),
        "tls": balancer is not None
        and bool(balancer.protocols)
        and set(balancer.protocols) <= _ENCRYPTING_PROTOCOLS,
        "protocols": [] if balancer is None else [printable(protocol) for protocol in balancer.protocols],
        "balancer": balancer is not None and balancer.state in ("active", "active_impaired"),
        "balancer_state": printable("not known" if balancer is None else balancer.state),
        "robots": sum(robots) if robots else None,
        "cpu_percent": _round(metrics.newest("cpu_percent"), 1),
        "queue_ms": _round(metrics.newest("queue_ms"), 1),
        **per_s,
        "servers": servers,
        "data_servers": [],
        "waiting": _list_wait_reasons(group, metrics, settings),
        "last_action": printable(overview.activities[-1].text[:_MAX_TEXT]) if overview.activities else "",
        "min_servers": group.min_servers,
        "max_servers": group.max_servers,
        "wanted_servers": group.wanted_servers,
        "busy_percent": settings.scaling.busy_cpu_percent,
        "period_s": period_s,
        "percentiles": {"count": round(answers), "covered_s": period_s, **percentiles} if answers else {},
        "alarms": [
            {"name": printable(name), "state": printable(state)}
            for name, state in sorted(group.alarms.items())
        ],
        "unknown": [printable(text) for text in unknown],
    }


def new_events(before: CloudOverview | None, after: CloudOverview, *, time_s: float) -> list[dict[str, Any]]:
    """Return rows of the Events view for the changes between two readings.

    The changes are scaling activities, alarms, and servers that changed or left.  At the first reading,
    *before* is None, and the rows are all known activities and the alarms in state ALARM.
    """
    old_activities = (
        set() if before is None else {(activity.id, activity.status) for activity in before.activities}
    )
    events = [
        _activity(activity)
        for activity in after.activities
        if (activity.id, activity.status) not in old_activities
    ]
    old_alarms = {} if before is None else before.group.alarms
    for name, state in sorted(after.group.alarms.items()):
        if state != old_alarms.get(name) and (before is not None or state == "ALARM"):
            reason = after.group.reasons.get(name, "")
            events.append(
                _event(
                    time_s, f"alarm-{name}", f"alarm {name} is in state {state}: {reason}",
                    group="trouble" if state == "ALARM" and name not in _SCALING_ALARMS else "scaling",
                )
            )  # fmt: skip
    if before is not None:
        events += _changes(before.group, after.group, time_s)
    return events


# Protocols of listeners that encrypt.
_ENCRYPTING_PROTOCOLS = {"TLS", "HTTPS"}
# Names of the alarms that add or remove servers; all other alarms report problems.
_SCALING_ALARMS = ("busy", "idle", "crowded", "underused")


def _changes(before: AutoScalingGroup, after: AutoScalingGroup, time_s: float) -> list[dict[str, Any]]:
    old_states = {server.name: _state(server) for server in before.servers}
    changes = []
    for server in after.servers:
        state = _state(server)
        if old_states.get(server.name) != state:
            health = ", ".join(server.targets) or "in no target group"
            text = f"{server.name} is {state} ({server.state}; {health})"
            group = "trouble" if state == "unhealthy" else "other"
            changes.append(_event(time_s, f"server-{state}", text, group=group, server=server.name))
    for name in sorted(old_states.keys() - {server.name for server in after.servers}):
        changes.append(
            _event(time_s, "server-gone", f"{name} has left the group", group="other", server=name)
        )
    return changes


def _activity(activity: ScalingActivity) -> dict[str, Any]:
    text = f"{activity.text} {activity.status}. {activity.cause}".strip()
    group = "trouble" if activity.has_failed else "scaling"
    return _event(activity.began_s, "group-activity", text, group=group)


def _event(time_s: float, kind: str, text: str, *, group: str, server: str = "") -> dict[str, Any]:
    return {
        "time_s": time_s, "kind": printable(kind), "text": printable(text[:_MAX_TEXT]),
        "server": printable(server), "group": group,
    }  # fmt: skip


def _server(server: Server, overview: CloudOverview, metrics: GroupMetrics, time_s: float) -> dict[str, Any]:
    numbers = metrics.servers.get(server.name, {})
    launched_s = overview.launched_s.get(server.name)
    robots = numbers.get("robots")
    return {
        "name": printable(server.name),
        "state": printable(_state(server)),
        "note": printable(f"{server.state}, {server.zone}; targets: {', '.join(server.targets) or 'none'}"),
        "cpu_percent": _round(numbers.get("cpu_percent"), 1),
        "robots": None if robots is None else round(robots),
        "requests": None, "queue": None, "queue_ms": None, "in_flight": None, "pid": None, "warming": False,
        "age_s": None if launched_s is None else round(max(time_s - launched_s, 0.0), 1),
    }  # fmt: skip


def _state(server: Server) -> str:
    """Return the state of an instance in the words of the local platform, such as "healthy" or "draining"."""
    phase = server.state.partition(":")[0]
    if phase != "InService":
        return _STATES.get(phase, server.state)
    if set(server.targets) == {"healthy"}:
        return "healthy"
    return "unhealthy" if {"unhealthy", "draining", "unused"} & set(server.targets) else "starting"


def _list_wait_reasons(
    group: AutoScalingGroup, metrics: GroupMetrics, settings: PlatformSettings
) -> list[str]:
    """Return sentences about when the alarms will add or remove servers, and about alarms in state ALARM.

    The alarms implement the same policy as the scale modifier of a local platform.
    """
    pairs = list(zip(metrics.series.get("cpu_percent", ()), metrics.series.get("requests", ()), strict=False))
    while pairs and pairs[-1][0] is None and len(metrics.times_s) - len(pairs) < _LATE_PERIODS:
        pairs.pop()  # CloudWatch publishes CPU values a minute or two late
    samples: list[dict[str, float]] = []
    for cpu, requests in pairs:
        # A period without a value does not breach an alarm, so that the count of breaching periods restarts.
        samples = [] if cpu is None else [*samples, {"cpu_percent": cpu, "requests": requests or 0.0}]
    policy = {
        "elastic": True, "samples": samples,
        "min_servers": group.min_servers, "max_servers": group.max_servers,
    }  # fmt: skip
    reasons = waiting_for(policy, settings.scaling, servers=len(group.servers))
    if group.wanted_servers != len(group.servers):
        reasons.insert(0, f"the group wants {group.wanted_servers} servers and has {len(group.servers)}")
    for name, state in sorted(group.alarms.items()):
        if state == "ALARM":
            text = f"alarm {name} is in state ALARM: {group.reasons.get(name, '')}"
            reasons.append(f"{text[:_MAX_TEXT]} (docs/operations.md#{name})")
    return [printable(reason) for reason in reasons]


def _history(metrics: GroupMetrics) -> list[list[float | None]]:
    """Return the columns of the charts: time, CPU (%), commands per second, robots (all None), p99 (ms)."""
    series, count = metrics.series, len(metrics.times_s)
    nothing: tuple[float | None, ...] = (None,) * count
    rates = [_round(_divide(count, metrics.period_s), 2) for count in series.get("requests", nothing)]
    return [
        [float(time_s) for time_s in metrics.times_s],
        list(series.get("cpu_percent", nothing)),
        rates,
        list(nothing),
        list(series.get("p99_ms", nothing)),
    ]


def _divide(value: float | None, by: float) -> float | None:
    return None if value is None else value / by


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
