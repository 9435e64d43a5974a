"""The driver of roslibpy as it is, over the rosbridge endpoint: ``roslibpy_driver.py TRANSPORT SCENARIO``.

roslibpy connects again by itself; what had no answer then is sent again here, as every ROS program has to.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
from pathlib import Path
from typing import Any

import roslibpy

CLAIMS = ["pnp", "typed-error", "busy", "deadline", "stream", "renew", "not-finite"]
PER_S = 10.0
MAX_UNANSWERED = 6


def say(**event: Any) -> None:
    print(json.dumps(event), flush=True)


class Call:
    """One command, which is sent until it has an answer."""

    def __init__(self, service: str, payload: Any) -> None:
        self.service, self.payload = service, payload
        self.began = time.monotonic()
        self.reply: Any = None
        self.code = ""
        self.answered: set[int] = set()
        self.done = threading.Event()
        self.number = 0


class Run:
    """A client, what it sent, and what was answered."""

    def __init__(self, transport: str) -> None:
        self.given = json.loads(Path(os.environ["RSE_PF_INPUT"]).read_text(encoding="utf-8"))
        url = os.environ["RSE_PF_URL"].removesuffix("/ws") + "/rosbridge"
        self.ros = roslibpy.Ros(url, transport=transport)
        # roslibpy would wait for up to an hour.
        self.ros.factory.set_max_delay(1.0)
        self.token = os.environ["RSE_PF_TOKEN"]
        self.connections = self.sent = self.twice = 0
        self.slot_s = 0.0
        self.calls: dict[int, Call] = {}
        self.ended: list[Call] = []
        self.codes: dict[str, int] = {}
        self.lock = threading.Lock()
        self.ros.on("ready", self.connected)
        self.ros.run(timeout=10)

    def connected(self, proto: Any) -> None:
        proto.send_ros_message(roslibpy.Message({"op": "auth", "mac": self.token, "level": "", "t": 0}))
        self.connections += 1
        if self.connections > 1:
            say(event="moved", server="")
            with self.lock:
                waiting = list(self.calls.values())
            for call in waiting:
                self.send(call)

    def again(self, call: Call, retry_s: float) -> None:
        """Send a refused call once more; all sends keep this distance from now on."""
        number = call.number
        with self.lock:
            self.slot_s = max(time.monotonic(), self.slot_s) + retry_s
            wait_s = self.slot_s - time.monotonic()
        self.ros.call_later(wait_s, lambda: call.number == number and self.send(call))

    @property
    def may_send(self) -> bool:
        """Whether no refused call waits for its turn."""
        return len(self.calls) < MAX_UNANSWERED and time.monotonic() >= self.slot_s

    def send(self, call: Call) -> None:
        with self.lock:
            self.sent += 1
            number = call.number = self.sent
            self.calls[id(call)] = call
        service = roslibpy.Service(self.ros, f"/{call.service}", f"rse_pf/{call.service}")
        service.call(
            roslibpy.ServiceRequest(call.payload),
            callback=lambda reply: self.answered(call, number, dict(reply), "ok"),
            errback=lambda error: self.refused(call, number, error),
        )

    def refused(self, call: Call, number: int, error: Any) -> None:
        code = error["code"] if isinstance(error, dict) else "disconnected"
        if code in ("busy", "unauthorized", "worker-lost"):
            self.again(call, max(0.05, (error.get("retry_after_ms") or 0.0) / 1e3))
        else:
            self.answered(call, number, error, code)

    def answered(self, call: Call, number: int, reply: Any, code: str) -> None:
        with self.lock:
            self.calls.pop(id(call), None)
            self.twice += number in call.answered
            call.answered.add(number)
            if len(call.answered) > 1:  # it was sent again after a reconnect, and answered before
                return
            call.reply, call.code = reply, code
            self.codes[code] = self.codes.get(code, 0) + 1
            self.ended.append(call)
            call.ms = 1e3 * (time.monotonic() - call.began)  # type: ignore[attr-defined]
        call.done.set()

    def ask(self, service: str, payload: Any, within_s: float = 10.0) -> Call:
        call = Call(service, payload)
        self.send(call)
        if not call.done.wait(within_s):
            raise TimeoutError(f"no answer to {service}")
        return call

    def command(self, number: int) -> tuple[str, Any]:
        found = self.given["commands"][number % len(self.given["commands"])]
        return found["service"], found["payload"]

    def settle(self, within_s: float) -> None:
        end_s = time.monotonic() + within_s
        while self.calls and time.monotonic() < end_s:
            time.sleep(0.02)

    def done(self, offered: int, **more: Any) -> None:
        times = sorted(call.ms for call in self.ended) or [0.0]  # type: ignore[attr-defined]
        say(
            event="done", sent=offered, answered=len(self.ended), twice=self.twice, lost=len(self.calls),
            codes=self.codes, p50_ms=times[len(times) // 2], p99_ms=times[int(0.99 * (len(times) - 1))],
            resent=self.sent - offered, connections=self.connections, **more,
        )  # fmt: skip


def pnp(run: Run) -> None:
    worst = 0.0
    for number, expected in enumerate(run.given["expected"]):
        reply = run.ask(*run.command(number)).reply
        assert reply["verdict"] == expected["verdict"], reply
        pairs = zip(reply["T_camera_world"], expected["T_camera_world"], strict=True)
        worst = max([worst, *(abs(a - b) for a, b in pairs)])
    assert worst <= 1e-6, worst
    run.done(len(run.given["expected"]), worst=worst)


def typed_error(run: Run) -> None:
    unknown = run.ask("nothing-here", {}).reply
    assert unknown["hint"]
    service, payload = run.command(0)
    few = {**payload, "points_world": payload["points_world"][:9], "pixels": payload["pixels"][:6]}
    run.ask(service, few)
    run.done(2)


def busy(run: Run) -> None:
    """Offer 80 a second; one waits while too many are unanswered, as a paced robot does."""
    end_s, offered = time.monotonic() + float(os.environ["RSE_PF_SECONDS"]), 0
    while time.monotonic() < end_s:
        if run.may_send:
            run.send(Call(*run.command(offered)))
            offered += 1
        time.sleep(1 / 80)
    run.settle(20)
    run.done(offered)


def deadline(run: Run) -> None:
    """Send the field ``timeout`` of rosbridge, which roslibpy itself does not send."""
    for number in range(20):
        service, payload = run.command(number)
        call = Call(service, payload)
        with run.lock:
            run.sent += 1
            run.calls[id(call)] = call
        message = {
            "op": "call_service", "id": f"d:{number}", "service": f"/{service}", "args": payload,
            "timeout": 1e-5,  # any wait in the server is longer
        }  # fmt: skip
        run.ros.call_async_service(
            roslibpy.Message(message),
            lambda reply, call=call: run.answered(call, 0, dict(reply), "ok"),
            lambda error, call=call: run.answered(call, 0, error, error["code"]),
        )
        time.sleep(0.36 if number % 6 == 5 else 0.0)  # in bursts: the server counts from the arrival
    run.settle(10)
    run.done(20)


def stream(run: Run) -> None:
    stop = threading.Event()

    def obey() -> None:
        for line in sys.stdin:
            order = json.loads(line)
            if order["do"] == "stop":
                stop.set()
                return
            run.token = order["token"]
            run.ros.send_on_ready(roslibpy.Message({"op": "auth", "mac": run.token, "level": "", "t": 0}))

    threading.Thread(target=obey, daemon=True).start()
    offered, said_s = 0, 0.0
    while not stop.wait(1 / PER_S):
        # What the endpoint never saw, because the socket died under it, is sent again.
        if run.may_send and run.ros.is_connected:
            run.send(Call(*run.command(offered)))
            offered += 1
        if time.monotonic() - said_s >= 0.25:
            said_s = time.monotonic()
            say(event="count", answered=len(run.ended))
    run.settle(20)
    run.done(offered)


def not_finite(run: Run) -> None:
    messages: queue.Queue[Any] = queue.Queue()
    for topic, kind in (("/scan", "sensor_msgs/msg/LaserScan"), ("/fix", "sensor_msgs/msg/NavSatFix")):
        roslibpy.Topic(run.ros, topic, kind).subscribe(messages.put)
    run.ask("echo", {"value": 1})  # the subscriptions are made
    say(event="ready")
    assert messages.get(timeout=10) == {"ranges": [1.0, None, None, None]}
    assert messages.get(timeout=10) == {"latitude": None}
    run.done(1)


SCENARIOS = {
    "pnp": pnp, "typed-error": typed_error, "busy": busy, "deadline": deadline, "stream": stream,
    "renew": stream, "not-finite": not_finite,
}  # fmt: skip


def main() -> int:
    transport, scenario = sys.argv[1], sys.argv[2]
    if scenario == "--claims":
        print(json.dumps(CLAIMS))
        return 0
    if scenario not in SCENARIOS:
        say(event="unsupported")
        return 3
    try:
        run = Run(transport)
        if scenario != "not-finite":  # which is ready when it has subscribed
            say(event="ready")
        SCENARIOS[scenario](run)
    except Exception as error:  # noqa: BLE001  the last line of a driver says what failed
        say(event="error", message=f"{type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # the reactor of roslibpy runs on
