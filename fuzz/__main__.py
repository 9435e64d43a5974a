"""Fuzz one target: ``python -m fuzz codec --seconds 60``.

The engine is atheris (guided by coverage) or Hypothesis.  A failure ends with an exit code other than 0 and
the input in a file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import sys
import time
import traceback
from pathlib import Path

from fuzz.meter import BARS, Meter

_INPUTS_PER_SEED = 500  # number of damaged inputs that Hypothesis makes from one seed
_TARGETS = (
    "codec", "frames", "stream", "geometry", "maps", "keyframes", "snapshots", "graph", "cloud",
    "match", "depth", "describe", "track", "stereo", "live",
)  # fmt: skip
"""Names of `fuzz.targets.TARGETS`, repeated here because atheris has to instrument that import."""
_OF_THE_CORE = frozenset({"match", "depth", "describe", "track", "stereo"})
"""Targets that compare the native core with Python; they are skipped without the core."""


def main(arguments: list[str] | None = None) -> int:
    """Run one target and print the cost of its inputs."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("target", choices=_TARGETS)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=["hypothesis", "atheris"], default="hypothesis")
    parser.add_argument("--found", type=Path, default=Path("out/fuzz"), help="folder of inputs that failed")
    parser.add_argument("--replay", type=Path, help="run this one input and print its cost")
    options = parser.parse_args(arguments)
    if options.replay:
        return _replay(options)
    if options.engine == "atheris":
        _with_atheris(options)
    return _with_hypothesis(options)


def _with_hypothesis(options: argparse.Namespace) -> int:
    from fuzz.damage import run_damaged
    from fuzz.targets import TARGETS

    if _lacks_core(options.target):
        return 0
    meter, run = Meter(), TARGETS[options.target]
    inputs, last_input = 0, b""

    def one_input(data: bytes) -> None:
        nonlocal inputs, last_input
        inputs, last_input = inputs + 1, data
        run(data, meter)

    end, seed = time.monotonic() + options.seconds, options.seed
    while time.monotonic() < end:
        try:
            run_damaged(options.target, one_input, first=seed, inputs=_INPUTS_PER_SEED)
        except Exception:  # noqa: BLE001  any error is a failure of the target
            print(f"{options.target}: {_write_input(options.found, last_input)} failed after {inputs} inputs")
            traceback.print_exc()
            return 1
        seed += 1
    load = os.getloadavg()[0]
    print(f"{options.target}: {inputs} inputs in {options.seconds:g} s, load {load:.1f}, no failures")
    print(f"  {meter.line()}")
    max_ms, max_mib = BARS.get(options.target, (math.inf, math.inf))
    limits = {"slowest_ms": (meter.worst_ms, max_ms), "max_mib": (meter.worst_mib, max_mib)}
    exceeded = {name: round(worst, 2) for name, (worst, limit) in limits.items() if worst > limit}
    if exceeded:
        print(f"  above the limits of {max_ms:g} ms and {max_mib:g} MiB: {json.dumps(exceeded)}")
        for data in (meter.slowest, meter.largest):
            print(f"  {_write_input(options.found, data)}")
    return 0


def _lacks_core(target: str) -> bool:
    """Return whether *target* needs the native core and the core cannot be loaded; print a line if so."""
    from rse_pf.native import find_library

    lacks = target in _OF_THE_CORE and find_library() is None
    if lacks:
        print(f"{target}: skipped: the native core is not built, or cannot be loaded")
    return lacks


def _replay(options: argparse.Namespace) -> int:
    from fuzz.targets import TARGETS

    meter = Meter()
    TARGETS[options.target](options.replay.read_bytes(), meter)
    print(meter.line())
    return 0


def _write_input(folder: Path, data: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / hashlib.sha256(data).hexdigest()[:16]
    file.write_bytes(data)
    return file


def _with_atheris(options: argparse.Namespace) -> None:
    """Run libFuzzer in this process; libFuzzer ends the process itself."""
    import atheris

    with atheris.instrument_imports(include=["rse_pf"]):
        from fuzz.targets import TARGETS
    from fuzz.samples import CORPUS, MAX_INPUT_BYTES, samples

    if _lacks_core(options.target):
        sys.exit(0)
    meter, run = Meter(), TARGETS[options.target]
    folder = options.found / f"{options.target}-corpus"
    folder.mkdir(parents=True, exist_ok=True)
    for data in samples(options.target):
        _write_input(folder, data)

    def one_input(data: bytes) -> None:
        worst = meter.worst_ms
        try:
            run(data, meter)
        except Exception:
            # If libFuzzer is loaded before Python, it exits without writing the input that raised an
            # exception.
            print(f"{options.target}: {_write_input(options.found, data)} failed", file=sys.stderr)
            raise
        if meter.worst_ms > max(worst, 1.0):
            print(meter.line(), file=sys.stderr)

    command = [
        sys.argv[0], f"-max_total_time={options.seconds:.0f}", f"-seed={options.seed}",
        f"-max_len={MAX_INPUT_BYTES}",
        f"-artifact_prefix={options.found}/", "-timeout=10", "-rss_limit_mb=1024", "-print_final_stats=1",
        str(folder), str(CORPUS / options.target),
    ]  # fmt: skip
    atheris.Setup(command, one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
