"""The scenarios of the raw client: what it is told on stdin, and what it reports on stdout."""

import asyncio
import json
import os
import sys
import time

STREAM_PER_S = 10.0


def inputs():
    with open(os.environ["RSE_PF_INPUT"], encoding="utf-8") as file:
        return json.load(file)


def done(robot, say, **more):
    times = sorted(robot.times) or [0.0]
    say(
        event="done", sent=robot.sent, answered=len(robot.times), twice=0, lost=len(robot.waiting),
        codes=robot.codes, p50_ms=times[len(times) // 2], p99_ms=times[int(0.99 * (len(times) - 1))], **more,
    )  # fmt: skip


async def connected(robot, say):
    await robot.stay_connected()
    say(event="ready")


async def told(robot, until):
    """Obey stdin until it says stop."""
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        order = json.loads(line)
        if order["do"] == "stop":
            break
        robot.token = order["token"]
        await robot.put({"type": "renew", "token": robot.token})
    until.set()


async def pnp(robot, say):
    await connected(robot, say)
    given = inputs()
    worst = 0.0
    for command, expected in zip(given["commands"], given["expected"], strict=True):
        answer = await robot.call(command["service"], command["payload"])
        pairs = zip(answer["reply"]["T_camera_world"], expected["T_camera_world"], strict=True)
        worst = max([worst, *(abs(a - b) for a, b in pairs)])
        assert answer["reply"]["verdict"] == expected["verdict"]
    assert worst <= 1e-6, worst
    done(robot, say, worst=worst)


async def typed_error(robot, say):
    await connected(robot, say)
    unknown = await robot.call("nothing-here", {})
    assert unknown["hint"]
    payload = inputs()["commands"][0]["payload"]
    few = {**payload, "points_world": payload["points_world"][:9], "pixels": payload["pixels"][:6]}
    await robot.call("pnp", few)
    done(robot, say)


async def busy(robot, say):
    await connected(robot, say)
    commands = inputs()["commands"]
    end_s, calls = time.monotonic() + float(os.environ["RSE_PF_SECONDS"]), []
    offered_per_s = 4 * robot.limits.get("max_commands_per_s", 100.0)
    while time.monotonic() < end_s:
        command = commands[len(calls) % len(commands)]
        calls.append(asyncio.ensure_future(robot.call(command["service"], command["payload"])))
        await asyncio.sleep(1 / offered_per_s)
    offered = len(calls)
    for each in calls[robot.sent :]:  # a robot drops what it cannot send in time
        each.cancel()
    await asyncio.wait_for(asyncio.gather(*calls, return_exceptions=True), 10)
    done(robot, say, offered=offered)


async def deadline(robot, say):
    await connected(robot, say)
    command = inputs()["commands"][0]
    for _ in range(20):
        await robot.call(command["service"], command["payload"], deadline_ms=1)
    done(robot, say)


async def newest(robot, say):
    await connected(robot, say)
    command = inputs()["commands"][0]
    # The native core may answer all eight before any of them waits.
    slow = command["payload"] | {"options": {"engine": "opencv"}}
    newest_ok = []
    for burst in range(4):
        calls = [
            robot.call(command["service"], slow, stream="front", seq=8 * burst + number)
            for number in range(8)
        ]
        newest_ok.append((await asyncio.gather(*calls))[-1]["type"] == "result")
        await asyncio.sleep(0.5)
    done(robot, say, newest_ok=all(newest_ok))


async def stream(robot, say):
    await connected(robot, say)
    commands, stop, calls = inputs()["commands"], asyncio.Event(), []
    robot.spawn(told(robot, stop))
    said_s = 0.0
    while not stop.is_set() and not robot.over:
        while not robot.pushed.empty():
            message = robot.pushed.get_nowait()
            if message["type"] == "moved":
                say(event="moved", server=message["server"])
        command = commands[len(calls) % len(commands)]
        calls.append(asyncio.ensure_future(robot.call(command["service"], command["payload"])))
        if time.monotonic() - said_s >= 0.25:
            said_s = time.monotonic()
            say(event="count", answered=len(robot.times))
        await asyncio.sleep(1 / STREAM_PER_S)
    await asyncio.wait_for(asyncio.gather(*calls), 20)
    done(robot, say)


async def ended(robot, say):
    await connected(robot, say)
    while not robot.over:
        await asyncio.sleep(0.02)
    robot.codes[robot.over] = 1
    done(robot, say)


async def updates(robot, say):
    await connected(robot, say)
    topic = f"live/{os.environ['RSE_PF_MAP']}"
    await robot.put({"type": "subscribe", "id": 1000, "topic": topic})
    message = await asyncio.wait_for(robot.pushed.get(), 10)
    assert (message["type"], message["topic"]) == ("update", topic), message
    done(robot, say, key=message["key"])


async def progress(robot, say):
    await connected(robot, say)
    long = inputs()["long"]
    call = asyncio.ensure_future(robot.call(long["service"], long["payload"]))
    message = await asyncio.wait_for(robot.pushed.get(), 10)
    assert message["type"] == "progress", message
    await robot.put({"type": "cancel", "id": message["id"]})
    await asyncio.wait_for(call, 10)
    done(robot, say)


SCENARIOS = {
    "pnp": pnp, "typed-error": typed_error, "busy": busy, "deadline": deadline, "newest": newest,
    "stream": stream, "renew": stream, "expired": ended, "revoked": ended, "updates": updates,
    "progress": progress,
}  # fmt: skip


def say(**event):
    print(json.dumps(event), flush=True)


def run(robot, scenario):
    """Run a scenario with a new robot, or list all."""
    if scenario == "--claims":
        print(json.dumps(list(SCENARIOS)))
    else:
        asyncio.run(drive(robot, scenario))


async def drive(robot, scenario):
    await SCENARIOS[scenario](robot(), say)
