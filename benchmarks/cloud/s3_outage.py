"""S3 answers 503, then nothing: does any server end, and what do robots and the operator see of it?

    python -m benchmarks cloud.s3_outage [--servers 4] [--outage-s 60] [--data-path /data/readyz]

Each server is a real rse-pf serve and rse-pf data, whose bucket is `PlayedS3` on this machine.  For the first
half of the outage S3 answers 503, for the second half nothing.  Each server has a robot that asks for two
poses a second and one that stores an object each second, the checks of the load balancer with the rule of
`rse_pf.scaling.health`, and the task of its agent that publishes to a CloudWatch in this process.  A server
with a check that is unhealthy counts as ended, because the group ends it.  The alarm is that of
`rse_pf.scaling.operator_alarms`, replayed on what the agents published; CloudWatch shows it `DELAY_S` later.

Defends: no server ends, all poses are answered, all refusals of data are typed, the alarm fires within 60 s.
``--data-path /data/readyz`` asks the data service what release 0.2 asked it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import client_sdk
from benchmarks.cloud.delayed_cloudwatch import DELAY_S
from benchmarks.cloud.played_s3 import PlayedS3
from benchmarks.frame.registry import Bar, benchmark
from rse_pf.auth.tokens import SigningKey
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent, AgentConfig, AgentContext
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.task import AgentState, Phase
from rse_pf.aws.fleet.tasks import store_errors
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.object_store import MemoryStore
from rse_pf.pnp.problems import make_problem
from rse_pf.scaling.health import CLOUD_INTERVAL_S, CLOUD_TIMEOUT_S, Health, cloud_checks, observe
from rse_pf.scaling.operator_alarms import STORE_PERIOD_S, operator_alarms
from tests.alarm_states import AlarmRule, replay

__all__ = ["Outage", "Report", "measure"]

ALARM_WITHIN_S = 60.0
BUCKET = "maps"
_KEY = SigningKey.from_seed(b"outage of the bucket, 32 letters", "outage")
_START_S, _STOP_S = 60.0, 20.0
_POSE_EACH_S, _OBJECT_EACH_S, _POSE_DEADLINE_S = 0.5, 1.0, 2.0
_DATA_TIMEOUT_S = 30.0
_GRACE_S = 0
"""Of the health rule here: every server is past its own."""


@dataclass(frozen=True, kw_only=True)
class Outage:
    """How many servers, and for how long S3 is well, failing, and well again; seconds."""

    servers: int = 4
    before_s: float = 10.0
    outage_s: float = 60.0
    after_s: float = 15.0
    data_path: str = ""
    """Checked in place of the path of `cloud_checks`, to see what another one does."""


@dataclass(kw_only=True)
class Report:
    """What happened; each figure is of the whole run."""

    ended: list[str] = field(default_factory=list)
    poses: Counter[str] = field(default_factory=Counter)
    """By source of the answer, or by the code of the error."""
    data: Counter[str] = field(default_factory=Counter)
    """Status and code of each answer of the data service."""
    data_during: Counter[str] = field(default_factory=Counter)
    data_after: Counter[str] = field(default_factory=Counter)
    """Of the requests that began during, and at least five seconds after, the outage."""
    alarm_after_s: float | None = None
    quiet_again: bool = False

    @property
    def holds(self) -> bool:
        """Return whether every bar is met."""
        typed = all(" " in status or status.startswith("2") for status in self.data)
        return bool(
            not self.ended and set(self.poses) == {"cloud"} and typed and self.data_during
            and self.alarm_after_s is not None and self.alarm_after_s <= ALARM_WITHIN_S
            and set(self.data_after) <= {"200", "201"} and self.data_after
        )  # fmt: skip


class CloudWatch:
    """Takes the numbers of the agents, with the time of each."""

    def __init__(self) -> None:
        self.data: list[tuple[float, dict[str, Any]]] = []

    def put_metric_data(self, **arguments: Any) -> dict[str, Any]:
        """Keep the numbers of one call."""
        self.data += [(time.monotonic(), argument) for argument in arguments["MetricData"]]
        return {}


class LocalInstance(Instance):
    """An instance without metadata."""

    def instance_id(self) -> str:
        """Return a constant."""
        return "i-here"


@benchmark(Bar("holds", equals=True))
def run_benchmark(*, servers: int = 4, outage_s: float = 60.0, data_path: str = "") -> dict[str, Any]:
    """Run once."""
    chosen = Outage(servers=servers, outage_s=outage_s, data_path=data_path)
    with tempfile.TemporaryDirectory() as folder:
        report = measure(chosen, Path(folder))
    return {
        "ended": report.ended, "poses": report.poses, "data_during": report.data_during,
        "data_after": report.data_after, "alarm_after_s": report.alarm_after_s, "holds": report.holds,
    }  # fmt: skip


def measure(outage: Outage, folder: Path) -> Report:
    """Run the servers, let S3 fail, and return what was seen."""
    settings = PlatformSettings.from_dict(
        {
            "serving": {"port": 0, "control_port": 0, "workers": 1}, "data": {"port": 0},
            "live": {"warm_standby": False}, "health": {"grace_s": _GRACE_S},
        }
    )  # fmt: skip
    with PlayedS3() as s3, contextlib.ExitStack() as stack:
        environment = {
            "AWS_ENDPOINT_URL_S3": s3.url, "AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing",
            "AWS_EC2_METADATA_DISABLED": "true",
        }  # fmt: skip
        stack.enter_context(_environment(environment))
        make_client("s3", settings.cloud.region).create_bucket(
            Bucket=BUCKET, CreateBucketConfiguration={"LocationConstraint": settings.cloud.region}
        )
        servers = [
            stack.enter_context(_server(folder, f"server-{number}", settings))
            for number in range(outage.servers)
        ]
        return asyncio.run(_Run(outage, settings, servers, s3).run())


class _Run:
    """One run: everything that asks, and what came of it."""

    def __init__(
        self, outage: Outage, settings: PlatformSettings, servers: list[Mapping[str, int]], s3: PlayedS3
    ) -> None:
        self._outage, self._settings, self._servers, self._s3 = outage, settings, servers, s3
        self._report = Report()
        self._cloudwatch = CloudWatch()
        self._over = threading.Event()
        self._fails_s = self._well_s = float("inf")

    async def run(self) -> Report:
        outage, over = self._outage, self._over
        threads = [
            threading.Thread(target=target, args=(number, server), daemon=True)
            for number, server in enumerate(self._servers)
            for target in (self._check, self._store, self._look)
        ]
        began_s = time.monotonic()
        for thread in threads:
            thread.start()
        poses = [asyncio.create_task(self._pose(n, server)) for n, server in enumerate(self._servers)]
        await asyncio.sleep(outage.before_s)
        self._fails_s = time.monotonic()
        self._s3.mood = "unavailable"
        await asyncio.sleep(outage.outage_s / 2)
        self._s3.mood = "silent"
        await asyncio.sleep(outage.outage_s / 2)
        self._s3.mood = "well"
        self._well_s = time.monotonic()
        await asyncio.sleep(outage.after_s)
        over.set()
        await asyncio.gather(*poses)
        for writer in threads:
            await asyncio.to_thread(writer.join, _DATA_TIMEOUT_S)
        self._judge_alarm(began_s, time.monotonic())
        return self._report

    async def _pose(self, number: int, server: Mapping[str, int]) -> None:
        """Ask one server for poses, as a robot that solves none itself."""
        problem = make_problem(seed=number, noise_px=0.5, outlier_ratio=0.2)
        url = f"ws://127.0.0.1:{server['port']}{self._settings.serving.path}"
        async with client_sdk.connect(url, token=_token(f"poses-{number}", self._settings)) as robot:
            while not self._over.is_set():
                begins_s = time.monotonic()
                try:
                    answer = await robot.solve_pnp(
                        problem.points_world, problem.pixels, problem.camera, deadline_s=_POSE_DEADLINE_S
                    )
                    self._report.poses[answer.source] += 1
                except RsePfError as error:
                    self._report.poses[error.code] += 1
                await asyncio.sleep(max(0.0, begins_s + _POSE_EACH_S - time.monotonic()))

    def _check(self, number: int, server: Mapping[str, int]) -> None:
        """Ask what the load balancer asks; an unhealthy server is ended by its group."""
        rule = self._settings.health
        paths = {name: path for name, (_, path) in cloud_checks(self._settings).items()}
        if self._outage.data_path:
            paths["data"] = self._outage.data_path
        ports = {"robots": server["control_port"], "data": server["data_port"]}
        health = {name: Health(started_s=0.0, state="healthy", last_ok=True) for name in paths}
        while not self._over.is_set():
            begins_s = time.monotonic()
            for name, path in paths.items():
                ok = _status(f"http://127.0.0.1:{ports[name]}{path}", CLOUD_TIMEOUT_S) == "200"
                health[name] = observe(health[name], ok, rule, now_s=time.monotonic())
                if health[name].state == "unhealthy":
                    self._report.ended.append(f"server-{number}: {name}")
                    return
            self._over.wait(max(0.0, begins_s + CLOUD_INTERVAL_S - time.monotonic()))

    def _store(self, number: int, server: Mapping[str, int]) -> None:
        """Store a new object each second, as a robot that does not try again."""
        base = f"http://127.0.0.1:{server['data_port']}/data/v1/objects/"
        token = _token(f"data-{number}", self._settings)
        count = 0
        while not self._over.is_set():
            begins_s = time.monotonic()
            content = f"{number} {count}".encode()
            count += 1
            url = base + hashlib.sha256(content).hexdigest()
            status = _status(url, _DATA_TIMEOUT_S, "PUT", content, {"Authorization": f"Bearer {token}"})
            self._report.data[status] += 1
            if self._fails_s <= begins_s < self._well_s:
                self._report.data_during[status] += 1
            if begins_s >= self._well_s + 5.0:
                self._report.data_after[status] += 1
            self._over.wait(max(0.0, begins_s + _OBJECT_EACH_S - time.monotonic()))

    def _look(self, number: int, server: Mapping[str, int]) -> None:
        """Run the task of the agent, at its own period."""
        context = AgentContext(
            machine=LocalInstance(server["control_port"], None, server["data_port"]),
            clients={"cloudwatch": self._cloudwatch}, artifacts=MemoryStore(), settings=self._settings,
            config=AgentConfig(group="rse-pf", hook="", keys_name="keys", keys_file=Path("none")),
            log=lambda event, **fields: None, state=AgentState(phase=Phase.SERVING),
        )  # fmt: skip
        agent = Agent(context, (store_errors.task,))
        self._over.wait(number * STORE_PERIOD_S / len(self._servers))
        while not self._over.is_set():
            agent.attempt("store-errors")
            self._over.wait(STORE_PERIOD_S)

    def _judge_alarm(self, began_s: float, ended_s: float) -> None:
        """Replay the alarm on what was published, in periods of CloudWatch."""
        (alarm,) = [
            operator_alarm
            for operator_alarm in operator_alarms(self._settings)
            if operator_alarm.name == "store"
        ]
        rule = AlarmRule(
            expression=alarm.expression, comparison=alarm.comparison, threshold=alarm.threshold,
            periods=alarm.periods, datapoints=alarm.datapoints, missing=alarm.missing,
        )  # fmt: skip
        count = int((ended_s - began_s) // alarm.period_s)
        sums: list[float | None] = [None] * count
        for at_s, datum in self._cloudwatch.data:
            period = int((at_s - began_s) // alarm.period_s)
            if period < count:
                sums[period] = (sums[period] or 0.0) + datum["Value"]
        states = replay(rule, {alarm.series[0].name: sums}, "OK")
        if "ALARM" in states:
            fires_s = began_s + (states.index("ALARM") + 1) * alarm.period_s + DELAY_S
            self._report.alarm_after_s = round(fires_s - self._fails_s, 1)
        self._report.quiet_again = bool(states) and states[-1] == "OK"


def _token(robot: str, settings: PlatformSettings) -> str:
    return _KEY.issue(robot, now=time.time(), token_id=robot, settings=settings.auth)


def _status(
    url: str, timeout_s: float, method: str = "GET", body: bytes | None = None,
    headers: Mapping[str, str] | None = None,
) -> str:  # fmt: skip
    """Return the status and, of an error, the code in its JSON; ``none`` without any answer."""
    request = urllib.request.Request(url, data=body, method=method, headers=dict(headers or {}))
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as answer:
            return str(answer.status)
    except urllib.error.HTTPError as error:
        with error, contextlib.suppress(ValueError, KeyError, TypeError):
            return f"{error.code} {json.loads(error.read())['code']}"
        return f"{error.code}"
    except OSError:
        return "none"


@contextlib.contextmanager
def _environment(more: Mapping[str, str]) -> Iterator[None]:
    """Set the variables by which botocore finds S3, here and in the servers."""
    before = {name: os.environ.get(name) for name in more}
    os.environ.update(more)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _server(folder: Path, name: str, settings: PlatformSettings) -> Iterator[Mapping[str, int]]:
    """Run both processes of one server; yield ``port``, ``control_port`` and ``data_port``."""
    home = folder / name
    home.mkdir()
    (home / "keys.json").write_text(_KEY.key_set().to_json())
    (home / "settings.json").write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}))
    common = [
        "--settings", str(home / "settings.json"), "--keys", str(home / "keys.json"),
        "--store", f"s3:{BUCKET}",
    ]  # fmt: skip
    files = {verb: home / f"{verb}.json" for verb in ("serve", "data")}
    command = [sys.executable, "-m", "rse_pf.cli.main"]
    processes = []
    try:
        for verb, file in files.items():
            more = ["--server-id", name] if verb == "serve" else []
            with (home / f"{verb}.log").open("wb") as log:
                processes.append(
                    subprocess.Popen(
                        [*command, verb, *common, "--announce", str(file), *more], stdout=log, stderr=log
                    )
                )
        pids = {verb: _read_pids(file, processes, home) for verb, file in files.items()}
        yield {
            "port": pids["serve"]["port"], "control_port": pids["serve"]["control_port"],
            "data_port": pids["data"]["port"],
        }  # fmt: skip
    finally:
        for process in processes:
            process.terminate()
        for child in processes:
            try:
                child.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def _read_pids(file: Path, processes: list[subprocess.Popen[bytes]], home: Path) -> dict[str, int]:
    until_s = time.monotonic() + _START_S
    while not file.exists():
        if time.monotonic() > until_s or any(process.poll() is not None for process in processes):
            logs = "\n".join(path.read_text()[-2000:] for path in home.glob("*.log"))
            raise RuntimeError(f"{file.name} is not ready:\n{logs}")
        time.sleep(0.05)  # polls, with a deadline
    return dict(json.loads(file.read_text()))
