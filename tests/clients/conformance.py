"""Run every client through one table of scenarios against a real platform, and write out/clients.json.

Usage: python tests/clients/conformance.py [--runs N] [--only CLIENT,...] [--scenarios NAME,...] [--out FILE]
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from clients import CLIENTS, REPOSITORY, Client
from driver import Driver
from scenarios import SCENARIOS, Bench, Missed

from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import RsePfError
from rse_pf.local.control.platform import LocalPlatform

SERVERS = 2
PATIENCE_S = 90.0
START_S = 90.0
"""On a machine that does much else, a server took 20 s to start."""
LEEWAY_S = 2
"""So that an expired token is soon refused everywhere; by default after 30 s."""


def main() -> int:
    """Run what the arguments name; return 0 if every client passed what it claims."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=1, help="times that each scenario is run (default: 1)")
    parser.add_argument("--only", default="", help="clients, with commas between (default: all)")
    parser.add_argument("--scenarios", default="", help="scenarios, with commas between (default: all)")
    parser.add_argument("--leave-out", default="", metavar="SCENARIOS", help="scenarios that are not run")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "out" / "clients.json")
    parser.add_argument("--away", type=float, default=20.0, metavar="S", help="of returns/away (default: 20)")
    parser.add_argument("--log", type=Path, help="folder for what the drivers wrote to stderr")
    args = parser.parse_args()
    only = [each for each in args.only.split(",") if each]
    unknown = set(only) - {client.name for client in CLIENTS}
    if unknown:
        parser.error(f"unknown clients: {', '.join(sorted(unknown))}")
    left_out = {each for each in args.leave_out.split(",") if each}
    wanted = [each for each in args.scenarios.split(",") if each] or list(SCENARIOS)
    unknown = {*wanted, *left_out} - set(SCENARIOS)
    if unknown:
        parser.error(f"unknown scenarios: {', '.join(sorted(unknown))}")
    wanted = [each for each in wanted if each not in left_out]
    clients = [client for client in CLIENTS if not only or client.name in only]
    rows: list[dict[str, Any]] = []
    try:
        asyncio.run(run(clients, wanted, args.runs, args.log, rows, args.away))
    except RsePfError as error:
        print(f"the platform did not start: {error}", file=sys.stderr)
        return 2
    finally:  # also after Ctrl-C: what was run is kept
        write(args.out, args.runs, rows)
    failed = [row for row in rows if row["passed"] is False]
    print(f"{sum(row['passed'] is True for row in rows)} passed, {len(failed)} failed; {args.out}")
    for row in failed:
        print(f"FAILED {row['client']} {row['scenario']}: {row['why']}")
    return 1 if failed else 0


def write(out: Path, runs: int, rows: list[dict[str, Any]]) -> None:
    """Write out/clients.json."""
    document = {
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "load_average": round(os.getloadavg()[0], 2), "runs": runs, "rows": rows,
    }  # fmt: skip
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


async def run(
    clients: list[Client],
    wanted: list[str],
    runs: int,
    log: Path | None,
    rows: list[dict[str, Any]],
    away_s: float,
) -> None:
    """Append one row for each client, scenario and run to *rows*."""
    ready: list[tuple[Client, list[str]]] = []
    for client in clients:
        absent = client.missing()
        if absent:
            print(f"{client.name}: skipped: {absent}", flush=True)
            rows += [row(client, each, 0, None, skipped=absent) for each in wanted]
        else:
            ready.append((client, claims(client)))
    if not ready:
        return
    async with platform() as bench:
        bench.away_s = away_s
        for number in range(1, runs + 1):
            for client, claimed in ready:
                for name in wanted:
                    driven = SCENARIOS[name].driven
                    if driven not in claimed:
                        if number == 1:
                            rows.append(row(client, name, 0, None, skipped="not claimed"))
                        continue
                    rows.append(await one(bench, client, name, number, log))
        leaks = bench.tokens_in_files()
    if leaks:
        print(f"tokens in files of the platform: {leaks}")
    platform_row = Client(name="platform", command=())
    rows.append(row(platform_row, "no token in a log", 1, not leaks, why=", ".join(leaks)))


async def one(bench: Bench, client: Client, name: str, number: int, log: Path | None) -> dict[str, Any]:
    """Run one scenario with one client."""
    scenario = SCENARIOS[name]
    await bench.restore()
    began = time.monotonic()
    errors: Any = subprocess.DEVNULL
    with contextlib.ExitStack() as files:
        if log is not None:
            log.mkdir(parents=True, exist_ok=True)
            path = log / f"{client.name}.{name.replace('/', '-')}.{number}.log"
            errors = files.enter_context(path.open("wb"))
        try:
            async with bench.link() as link:
                robot = f"{client.name}-{name.replace('/', '-')}-{number}-{os.urandom(2).hex()}"
                env = bench.environment(robot, link, scenario, client.starts_s)
                if scenario.driven == "returns":
                    await asyncio.wait_for(bench.until_enrolled(), PATIENCE_S)
                async with Driver(client.command, scenario.driven, env, errors) as driver:
                    figures = await asyncio.wait_for(
                        scenario.run(bench, driver, link, robot), PATIENCE_S + bench.away_s
                    )
            made = row(client, name, number, True, figures=figures)
        except Missed as missed:
            made = row(client, name, number, False, why=str(missed))
        except asyncio.TimeoutError:
            made = row(client, name, number, False, why=f"not over within {PATIENCE_S:g} s")
    took = time.monotonic() - began
    print(
        f"{client.name} {name} {number}: {'passed' if made['passed'] else made['why']} ({took:.1f} s)",
        flush=True,
    )
    return made


def row(
    client: Client, scenario: str, number: int, passed: bool | None, *, skipped: str | None = None,
    why: str = "", figures: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return a row of out/clients.json; *passed* is None where nothing was run."""
    return {
        "client": client.name, "scenario": scenario, "run": number, "passed": passed, "skipped": skipped,
        "why": why, "figures": figures or {},
    }  # fmt: skip


def claims(client: Client) -> list[str]:
    """Return the scenarios that the driver of *client* claims."""
    told = subprocess.run([*client.command, "--claims"], capture_output=True, timeout=60, check=True)
    claimed = json.loads(told.stdout)
    assert isinstance(claimed, list)
    return claimed


@contextlib.asynccontextmanager
async def platform() -> AsyncIterator[Bench]:
    """Start a platform of two servers with data service, and end it."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        origin = f"http://127.0.0.1:{free.getsockname()[1]}"
    serving: dict[str, Any] = {"allowed_origins": origin}
    if any((each.group, each.name) == ("serving", "rosbridge") for each in setting_rows()):
        serving["rosbridge"] = True
    settings = PlatformSettings.from_dict(
        {"serving": serving, "auth": {"leeway_s": LEEWAY_S}, "local": {"start_timeout_s": START_S}}
    )
    with tempfile.TemporaryDirectory(prefix="clients-") as folder:
        async with LocalPlatform(
            settings, state=Path(folder) / "p", port=0, servers=SERVERS, data=True
        ) as cloud:
            yield Bench(cloud, origin=origin, folder=Path(folder))


if __name__ == "__main__":
    sys.exit(main())
