"""Fuzz one target: ``python -m fuzz codec --seconds 60``.

With atheris (coverage finds the way) where it is asked for, else with seeded mutations.  Ends with an exit
code other than 0 and the input in a file when something is found.  Promises to write nowhere else.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
import traceback
from pathlib import Path

from fuzz.meter import MAX_MIB, MAX_MS, Meter


def main(arguments: list[str] | None = None) -> int:
    """Run one target and print what it cost."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("target", choices=["codec", "frames", "stream", "geometry"])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=["mutations", "atheris"], default="mutations")
    parser.add_argument("--found", type=Path, default=Path("out/fuzz"), help="where findings are written")
    parser.add_argument("--replay", type=Path, help="try this one input, and say what it cost")
    options = parser.parse_args(arguments)
    if options.replay:
        return _replayed(options)
    if options.engine == "atheris":
        _with_atheris(options)
    return _with_mutations(options)


def _with_mutations(options: argparse.Namespace) -> int:
    from fuzz.mutations import mutations
    from fuzz.samples import LONGEST, samples
    from fuzz.targets import TARGETS

    meter, run = Meter(), TARGETS[options.target]
    inputs = 0
    end = time.monotonic() + options.seconds
    for data in mutations(samples(options.target), seed=options.seed, longest=LONGEST):
        if time.monotonic() > end:
            break
        inputs += 1
        try:
            run(data, meter)
        except Exception:  # noqa: BLE001  whatever escapes is what we look for
            print(f"{options.target}: {_kept(options.found, data)} after {inputs} inputs")
            traceback.print_exc()
            return 1
    load = os.getloadavg()[0]
    print(f"{options.target}: {inputs} inputs in {options.seconds:g} s, load {load:.1f}, nothing found")
    print(f"  {meter.line()}")
    bars = {"slowest_ms": (meter.worst_ms, MAX_MS), "max_mib": (meter.worst_mib, MAX_MIB)}
    missed = {name: round(worst, 2) for name, (worst, most) in bars.items() if worst > most}
    if options.target == "codec" and missed:
        print(f"  above the bars of {MAX_MS:g} ms and {MAX_MIB:g} MiB: {json.dumps(missed)}")
        for data in (meter.slowest, meter.largest):
            print(f"  {_kept(options.found, data)}")
    return 0


def _replayed(options: argparse.Namespace) -> int:
    from fuzz.targets import TARGETS

    meter = Meter()
    TARGETS[options.target](options.replay.read_bytes(), meter)
    print(meter.line())
    return 0


def _kept(folder: Path, data: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / hashlib.sha256(data).hexdigest()[:16]
    file.write_bytes(data)
    return file


def _with_atheris(options: argparse.Namespace) -> None:
    """Hand the process to libFuzzer, which ends it."""
    import atheris

    with atheris.instrument_imports(include=["rse_pf"]):
        from fuzz.targets import TARGETS
    from fuzz.samples import CORPUS, LONGEST, samples

    meter, run = Meter(), TARGETS[options.target]
    folder = options.found / f"{options.target}-corpus"
    folder.mkdir(parents=True, exist_ok=True)
    for data in samples(options.target):
        _kept(folder, data)

    def one_input(data: bytes) -> None:
        worst = meter.worst_ms
        run(data, meter)
        if meter.worst_ms > max(worst, 1.0):
            print(meter.line(), file=sys.stderr)

    command = [
        sys.argv[0], f"-max_total_time={options.seconds:.0f}", f"-seed={options.seed}", f"-max_len={LONGEST}",
        f"-artifact_prefix={options.found}/", "-timeout=10", "-rss_limit_mb=1024", "-print_final_stats=1",
        str(folder), str(CORPUS / options.target),
    ]  # fmt: skip
    atheris.Setup(command, one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
