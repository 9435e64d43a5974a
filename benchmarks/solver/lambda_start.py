"""CPU time of a cold start of the serverless PnP: import, set-up, first solve.

Each run is a fresh process; fetching the keys from S3 is left out: it takes time, but no CPU.  Runs with
bytecode, as the package of the function has it, and runs that compile all sources take turns.
``python -m benchmarks solver.lambda_start --out FILE``; ``--folder build/lambda --python python3.13``
measures the package itself, and `--base TREE` another tree of the sources beside it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread

RUNS = 10
BAR_S = 0.5
ONE_START = """
import time
began = time.process_time()
import base64, json, sys, zlib
from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.config import PlatformSettings
imported = time.process_time()
told = json.loads(sys.stdin.read())
keys = KeyCache(lambda: told["keys"], 60.0)
answering = Answering(PlatformSettings(), keys, lambda day, wanted, most: wanted)
answered = answering.answer(told["event"], now_s=told["now_s"], left_ms=9e3, clock=time.monotonic)
solved = time.process_time()
assert answered.status == 200, answered
print(json.dumps({"import_s": imported - began, "first_s": solved - imported, "all_s": solved,
                  "cv2": "cv2" in sys.modules, "result": b"result" in zlib.decompress(answered.body)}))
"""


def order() -> str:
    """Return keys and one event, as JSON: a problem of 200 matches, a third of them wrong."""
    import base64

    from rse_pf.auth.tokens import SigningKey
    from rse_pf.config import PlatformSettings
    from rse_pf.pnp.problems import make_problem
    from rse_pf.services.pnp import make_request
    from rse_pf.wire import SUBPROTOCOLS, Command, make_codec

    key, now_s = SigningKey.from_seed(bytes(32), "k"), 1_800_000_000.0
    problem = make_problem(seed=1)
    request = make_request(problem.points_world, problem.pixels, problem.camera)
    body = make_codec("zlib").encode(Command(id=1, service="pnp", payload=request))
    token = key.issue("robot-1", now=now_s, token_id="t", settings=PlatformSettings().auth)
    headers = {"authorization": f"Bearer {token}", "content-type": SUBPROTOCOLS["zlib"]}
    event = {"headers": headers, "body": base64.b64encode(body).decode(), "isBase64Encoded": True}
    return json.dumps({"keys": key.key_set().to_json(), "event": event, "now_s": now_s})


def start(python: str, folder: Path, bytecode: Path | None, sent: str) -> dict[str, Any]:
    """Return the figures of one process in *folder*; its bytecode is in *bytecode*, or nowhere."""
    environment = {"PATH": os.environ["PATH"], "PYTHONPYCACHEPREFIX": str(bytecode or "/nonexistent")}
    if bytecode is None:
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
    done = subprocess.run(
        [python, "-c", ONE_START], input=sent, capture_output=True, text=True, check=True,
        cwd=folder, env=environment,
    )  # fmt: skip
    row: dict[str, Any] = json.loads(done.stdout)
    assert row["result"]
    assert not row["cv2"]
    return row


@benchmark(Bar("bytecode.all_s.p50", at_most=BAR_S, unit="s of CPU"))
def run_benchmark(
    *, folder: Annotated[Path, "the sources that are measured"] = Path(),
    base: Annotated[Path | None, "other sources, measured in turns"] = None,
    python: str = sys.executable,
) -> dict[str, Any]:  # fmt: skip
    """Start fresh processes in turns."""
    sent = order()
    trees = {"": folder.resolve(), **({"base, ": base} if base else {})}
    rows: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as bytecode:
        for number in range(-1, RUNS):
            for name, tree in trees.items():
                for kind, cache in (("bytecode", Path(bytecode)), ("compiling", None)):
                    row = start(python, tree, cache, sent)
                    if number >= 0:  # the first run writes the bytecode
                        rows.setdefault(name + kind, []).append(row)
    return {
        kind: {name: spread(row[name] for row in taken) for name in ("import_s", "first_s", "all_s")}
        for kind, taken in rows.items()
    }
