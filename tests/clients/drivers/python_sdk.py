"""The driver of the Python SDK."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from client_sdk import DataClient, connect
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings
from rse_pf.errors import RsePfError
from rse_pf.wire import SUBPROTOCOLS, make_codec

CLAIMS = [
    "golden", "pnp", "typed-error", "undecodable", "busy", "deadline", "newest", "stream", "renew",
    "expired", "revoked", "updates", "progress", "data", "returns",
]  # fmt: skip
PER_S = 10.0
LATE_S = 30.0
SOON_S = 1.0


def say(**event: Any) -> None:
    print(json.dumps(event), flush=True)


class Run:
    """A robot, what it counted, and the token that it shows next."""

    def __init__(self, *, is_renewed: bool, is_own: bool) -> None:
        self.given = json.loads(Path(os.environ["RSE_PF_INPUT"]).read_text(encoding="utf-8"))
        self.token = os.environ["RSE_PF_TOKEN"]
        self.sent = self.answered = 0
        self.codes: dict[str, int] = {}
        self.times: list[float] = []
        token = self.signed if is_own else self.fresh if is_renewed else self.token
        self.robot = connect(os.environ["RSE_PF_URL"], token=token, on_change=self.changed)

    async def fresh(self) -> str:
        return self.token

    async def signed(self) -> str:
        """Return a token of the robot's own key."""
        own = self.given["own_key"]
        key, auth = (
            SigningKey.from_json(json.dumps(own)),
            AuthSettings(audience=own["aud"]),
        )
        return key.issue(own["sub"], now=time.time(), token_id=os.urandom(8).hex(), settings=auth)

    def changed(self, what: str, why: str) -> None:
        if what == "link-back":
            say(event="back")
        if what == "refused":
            say(event="refused", why=why)
        if what == "moved":
            say(event="moved", server=why)

    async def ask(self, service: str, payload: Any, **more: Any) -> Any:
        """Return the reply, or the error, which is counted by its code."""
        self.sent += 1
        began = time.monotonic()
        try:
            found = (await self.robot.call(service, payload, **more)).reply
            code = "ok"
        except RsePfError as error:
            found, code = error, error.code
        self.answered += 1
        self.codes[code] = self.codes.get(code, 0) + 1
        self.times.append(1e3 * (time.monotonic() - began))
        return found

    def command(self, number: int) -> tuple[str, Any]:
        commands = self.given["commands"]
        found = commands[number % len(commands)]
        return found["service"], found["payload"]

    def done(self, **more: Any) -> None:
        times = sorted(self.times) or [0.0]
        say(
            event="done", sent=self.sent, answered=self.answered, twice=0, lost=self.sent - self.answered,
            codes=self.codes, p50_ms=times[len(times) // 2], p99_ms=times[int(0.99 * (len(times) - 1))],
            repeated=self.robot.stats.duplicates, resent=self.robot.stats.resent, **more,
        )  # fmt: skip


async def golden(run: Run) -> None:
    messages = json.loads(Path(run.given["golden"]).read_text(encoding="utf-8"))
    count = 0
    for name, message in messages.items():
        kind = message["meaning"]["type"]
        for subprotocol, encoded in message["bytes"].items():
            codec = next(each for each, known in SUBPROTOCOLS.items() if known == subprotocol)
            wire, data = make_codec(codec), base64.b64decode(encoded)
            by_robot = ("hello", "command", "cancel", "ping", "renew", "subscribe", "unsubscribe")
            found = wire.decode_from_robot(data) if kind in by_robot else wire.decode_from_server(data)
            assert type(found).__name__.lower() == kind, name
            count += 1
    run.sent = run.answered = count


async def pnp(run: Run) -> None:
    worst = 0.0
    for number, expected in enumerate(run.given["expected"]):
        reply = await run.ask(*run.command(number))
        assert reply["verdict"] == expected["verdict"]
        difference = np.subtract(reply["T_camera_world"], expected["T_camera_world"])
        worst = max(worst, float(np.abs(difference).max()))
    assert worst <= 1e-6, worst


async def typed_error(run: Run) -> None:
    unknown = await run.ask("nothing-here", {})
    assert unknown.hint
    service, payload = run.command(0)
    await run.ask(
        service, {**payload, "points_world": payload["points_world"][:9], "pixels": payload["pixels"][:6]}
    )


async def undecodable(run: Run) -> dict[str, Any]:
    """Send each kind, and a valid command behind it; the trace is not the program's to set."""
    wrong, slowest_s = [], 0.0
    kinds = [each for each in run.given["undecodable"]["json"] if not each["trace"]]
    for kind in kinds:
        payload = msgspec.Raw(base64.b64decode(kind["payload"]))
        began = time.monotonic()
        found = await run.ask(kind["service"], payload, stream=kind["stream"])
        took_s = time.monotonic() - began
        slowest_s = max(slowest_s, took_s)
        is_typed = isinstance(found, RsePfError) and found.code in kind["codes"] and found.hint
        valid = await run.ask("echo", {"value": 1})
        if not is_typed or took_s > SOON_S or valid != {"value": 1}:
            wrong.append([kind["name"], repr(found)[:100], round(took_s, 3), repr(valid)[:50]])
    return {"kinds": len(kinds), "wrong": wrong, "slowest_s": round(slowest_s, 3)}


async def busy(run: Run) -> None:
    end_s, calls = time.monotonic() + float(os.environ["RSE_PF_SECONDS"]), []
    while time.monotonic() < end_s:
        calls.append(asyncio.ensure_future(run.ask(*run.command(len(calls)), deadline_s=LATE_S)))
        await asyncio.sleep(1 / 80)
    await asyncio.gather(*calls)


async def deadline(run: Run) -> None:
    for number in range(20):
        await run.ask(*run.command(number), deadline_s=0.001)


async def newest(run: Run) -> dict[str, Any]:
    are_ok = []
    for _ in range(4):
        calls = [run.ask(*run.command(0), stream="front", deadline_s=LATE_S) for _ in range(12)]
        are_ok.append(not isinstance((await asyncio.gather(*calls))[-1], RsePfError))
        await asyncio.sleep(0.5)
    return {"newest_ok": all(are_ok)}


async def stream(run: Run) -> None:
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    orders = asyncio.ensure_future(obey(run, lines))
    calls: list[asyncio.Future[Any]] = []
    said_s = 0.0
    while not orders.done():
        calls.append(asyncio.ensure_future(run.ask(*run.command(len(calls)), deadline_s=LATE_S)))
        if time.monotonic() - said_s >= 0.25:
            said_s = time.monotonic()
            say(event="count", answered=run.answered)
        await asyncio.sleep(1 / PER_S)
    await asyncio.gather(*calls)


async def obey(run: Run, lines: asyncio.StreamReader) -> None:
    while line := await lines.readline():
        order = json.loads(line)
        if order["do"] == "stop":
            return
        run.token = order["token"]


async def ended(run: Run) -> None:
    """Call until the session has ended for good."""
    while True:
        found = await run.ask("echo", {"value": 1}, deadline_s=5.0)
        if isinstance(found, RsePfError) and found.code in ("unauthorized", "forbidden"):
            return
        await asyncio.sleep(0.1)


async def returns(run: Run) -> None:
    """Call until told to stop; a call may end with the reason of a refusal, or expire."""
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    stopped = asyncio.ensure_future(lines.readline())
    while not stopped.done():
        found = await run.ask("echo", {"value": 1}, deadline_s=1.0)
        if not isinstance(found, RsePfError):
            say(event="count", answered=run.codes["ok"])
        await asyncio.sleep(1 / PER_S)


async def updates(run: Run) -> None:
    async for _ in run.robot.subscribe(f"live/{os.environ['RSE_PF_MAP']}"):
        run.sent = run.answered = 1
        return


async def progress(run: Run) -> None:
    long = run.given["long"]
    seen = asyncio.Event()
    call = asyncio.ensure_future(
        run.robot.call(long["service"], long["payload"], on_progress=lambda done, what: seen.set())
    )
    await asyncio.wait_for(seen.wait(), 10)
    call.cancel()
    try:
        await call
    except asyncio.CancelledError:
        run.codes["cancelled"] = 1  # the SDK's word for it: the call that was cancelled, and its job with it


async def data(run: Run) -> None:
    client = DataClient(os.environ["RSE_PF_DATA_URL"], run.token)
    sent = os.urandom(100_000)
    digest = await asyncio.to_thread(client.upload, sent)
    assert await asyncio.to_thread(client.download, digest) == sent
    client.close()


SCENARIOS = {
    "golden": golden, "pnp": pnp, "typed-error": typed_error, "undecodable": undecodable, "busy": busy,
    "deadline": deadline, "newest": newest, "stream": stream, "renew": stream, "expired": ended,
    "revoked": ended, "returns": returns, "updates": updates, "progress": progress, "data": data,
}  # fmt: skip


async def main(name: str) -> None:
    run = Run(is_renewed=name == "renew", is_own=name == "returns")
    async with run.robot:
        say(event="ready")
        found = await SCENARIOS[name](run)
        run.done(**(found or {}))


if sys.argv[1:] == ["--claims"]:
    print(json.dumps(CLAIMS))
elif __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
