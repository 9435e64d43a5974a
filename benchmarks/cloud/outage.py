"""Robots behind one address while the platform is away: who is connected again, and when.

    python -m benchmarks cloud.outage [--robots 40] [--outage 60] [--old-rule]

A local platform of two servers stands behind a relay that plays the load balancer and its web firewall: in
the outage every connection is cut and each handshake is answered with 503, as an ALB without a healthy target
does; the rate rules are those of the template, synthesised for this run (``--old-rule`` plays 0.1.0's: 403
above 2000 requests in five minutes).  Each robot asks echo once a second.  One robot more is disabled during
the outage.  All robots are in one process, which shares the cores with the platform.

Defends: every robot has an answer within 30 s after the outage; the disabled robot ends with a typed error.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import client_sdk
from benchmarks.cloud.local_platform import LocalPlatform
from benchmarks.cloud.played_firewall import PlayedFirewall, PlayedRule, Reply, rules_of_template
from benchmarks.frame.registry import Bar, benchmark
from rse_pf.errors import Forbidden, RsePfError, Unauthorized

__all__ = ["FrontDoor", "most_within"]

BAR_S = 30.0
WAIT_S = 300.0
ASK_EVERY_S = 1.0
BEFORE_S = 3.0
SITE = "203.0.113.7"
BALANCER = "arn:aws:elasticloadbalancing:eu-west-1:111122223333:loadbalancer/app/front/0"
UNAVAILABLE = Reply(
    status=503,
    headers={"Content-Type": "text/html"},
    body=b"<html>503 Service Temporarily Unavailable</html>",
)


class FrontDoor:
    """A relay to a local platform that plays the firewall, and the load balancer in an outage."""

    def __init__(self, port: int, firewall: PlayedFirewall, host: str = "127.0.0.1") -> None:
        self.firewall = firewall
        self._host = host
        self.is_out = False
        self.dials: list[float] = []
        self.answered: Counter[int] = Counter()
        self._target = port
        self._writers: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self.url = ""

    async def __aenter__(self) -> FrontDoor:
        """Listen on a free port."""
        self._server = await asyncio.start_server(self._serve, self._host, 0, backlog=1024)
        self.url = f"ws://{self._host}:{self._server.sockets[0].getsockname()[1]}/ws"
        return self

    async def __aexit__(self, *_: object) -> None:
        """Cut everything."""
        assert self._server is not None
        self._server.close()
        self.cut()

    def cut(self) -> None:
        """End every connection, as a load balancer without targets does."""
        for writer in list(self._writers):
            writer.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        there: asyncio.StreamWriter | None = None
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            path = head.split(b" ", 2)[1].decode("ascii", "replace")
            now = time.monotonic()
            self.dials.append(now)
            reply = self.firewall.judge(SITE, path, now) or (UNAVAILABLE if self.is_out else None)
            if reply is not None:
                self.answered[reply.status] += 1
                writer.write(_write(reply))
                await writer.drain()
                return
            back, there = await asyncio.open_connection("127.0.0.1", self._target)
            self._writers.add(there)
            there.write(head)
            await asyncio.gather(_pump(reader, there), _pump(back, writer))
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            for stream in (writer, there):
                if stream is not None:
                    self._writers.discard(stream)
                    stream.close()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(65536):
        writer.write(data)
        await writer.drain()
    writer.close()


def _write(reply: Reply) -> bytes:
    headers = {**reply.headers, "Content-Length": str(len(reply.body)), "Connection": "close"}
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    return f"HTTP/1.1 {reply.status} Refused\r\n{lines}\r\n".encode() + reply.body


def template_rules() -> list[PlayedRule]:
    """Synthesise the web firewall, as the stack of the servers does, and return the rules of the template."""
    os.environ.setdefault("JSII_SILENCE_WARNING_END_OF_LIFE_NODE_VERSION", "1")
    import aws_cdk as cdk

    from rse_pf.config import PlatformSettings
    from stacks.web_firewall import WebFirewall

    with tempfile.TemporaryDirectory() as folder:
        app = cdk.App(outdir=folder)
        stack = cdk.Stack(app, "Front")
        WebFirewall(stack, "Waf", alb_arn=BALANCER, settings=PlatformSettings())
        app.synth()
        return rules_of_template(json.loads(Path(folder, "Front.template.json").read_text(encoding="utf-8")))


def old_rules() -> list[PlayedRule]:
    """Return the only rule of 0.1.0."""
    reply = Reply(status=403, headers={}, body=b"<html>403 Forbidden</html>")
    return [PlayedRule(name="rate", limit=2000, window_s=300.0, statement=None, of_all=False, reply=reply)]


async def drive(
    local: LocalPlatform, rules: list[PlayedRule], *, robots: int, outage_s: float
) -> dict[str, Any]:
    """Cut *robots* robots off for *outage_s*; return when each had an answer again."""
    enrolment = local.folder / "disabled.enrolment"
    await asyncio.to_thread(local.robot, "enrol", "disabled", "--out", str(enrolment))
    back_after_s: dict[int, float] = {}
    failures: Counter[str] = Counter()
    is_over, all_back = asyncio.Event(), asyncio.Event()
    ended_at = 0.0

    async def ask(number: int, robot: client_sdk.Robot) -> None:
        while number not in back_after_s:
            began, was_over = time.monotonic(), is_over.is_set()
            try:
                await robot.call("echo", {"value": number}, deadline_s=2.0)
                if was_over:
                    back_after_s[number] = time.monotonic() - ended_at
            except RsePfError as error:
                failures[error.code] += 1
            await asyncio.sleep(max(0.0, ASK_EVERY_S - (time.monotonic() - began)))
        if len(back_after_s) == robots:
            all_back.set()

    async with FrontDoor(local.port, PlayedFirewall(rules)) as front:
        fleet = [
            client_sdk.connect(front.url, token=local.token(f"robot-{number}")) for number in range(robots)
        ]
        disabled = client_sdk.connect([front.url], enrolment=enrolment)
        for robot in (*fleet, disabled):
            await robot
        asking = [asyncio.create_task(ask(number, robot)) for number, robot in enumerate(fleet)]
        await asyncio.sleep(BEFORE_S)  # a quiet time before the outage
        front.is_out, began = True, time.monotonic()
        front.cut()
        await asyncio.to_thread(local.robot, "disable", "disabled")
        await asyncio.sleep(outage_s - (time.monotonic() - began))
        ended_at, front.is_out = time.monotonic(), False
        is_over.set()
        done, _ = await asyncio.wait({asyncio.create_task(all_back.wait())}, timeout=WAIT_S)
        ended_as = await _end_of(disabled, time.monotonic() + WAIT_S)
        for task in asking:
            task.cancel()
        dials = sorted(dial for dial in front.dials if dial >= began)
        await asyncio.gather(*(robot.close() for robot in (*fleet, disabled)))
        times = sorted(back_after_s.values())
        return {
            "robots": robots,
            "outage_s": outage_s,
            "answered": len(times),
            "all_back_after_s": round(times[-1], 2) if done else None,
            "p50_back_after_s": round(times[len(times) // 2], 2) if times else None,
            "dials_in_outage": sum(dial < ended_at for dial in dials),
            "most_dials_in_a_minute": most_within(dials, 60.0),
            "limit_of_dials": rules[0].limit,
            "window_s": rules[0].window_s,
            "answers_without_a_server": {str(status): n for status, n in sorted(front.answered.items())},
            "blocked": front.firewall.blocked,
            "failures_of_calls": dict(failures),
            "disabled_robot_ended_as": ended_as,
        }


async def _end_of(robot: client_sdk.Robot, until: float) -> str:
    """Return as what *robot* ended, or the last it said."""
    reason = ""
    while time.monotonic() < until:
        try:
            await robot.call("echo", {}, deadline_s=1.0)
        except (Unauthorized, Forbidden) as error:
            return error.code
        except RsePfError as error:
            reason = error.code
        await asyncio.sleep(0.2)  # polls, with a deadline
    return f"not ended: {reason}"


def most_within(times: list[float], window_s: float) -> int:
    """Return the most of *times* (s, in order) in one window."""
    return max((sum(begin <= seconds < begin + window_s for seconds in times) for begin in times), default=0)


@benchmark(
    Bar("all_back_after_s", at_most=BAR_S, unit="s"),
    Bar("without_answer", equals=0),
    Bar("disabled_robot_is_refused", equals=True),
)
def run_benchmark(
    *, robots: int = 40, outage: Annotated[float, "seconds"] = 60.0,
    old_rule: Annotated[bool, "play the rule of 0.1.0"] = False,
) -> dict[str, Any]:  # fmt: skip
    """Run one outage."""
    rules = old_rules() if old_rule else template_rules()
    with (
        tempfile.TemporaryDirectory(prefix="outage-") as folder,
        LocalPlatform("bench-outage", Path(folder)) as local,
    ):
        figures = asyncio.run(drive(local, rules, robots=robots, outage_s=outage))
    figures["without_answer"] = robots - figures["answered"]
    figures["disabled_robot_is_refused"] = figures["disabled_robot_ended_as"] in ("unauthorized", "forbidden")
    return figures
