"""What the recorder of a server costs alone: the stream of a worker's pipe, read as its process reads it.

    python -m benchmarks recording.recorder [--commands 6000] [--runs 5] [--codec zlib]

The stream is that of 100 robots whose `pnp` commands (200 matches, 30 % wrong) were answered.  ``told`` is
what a worker with the native core hands over, ``untold`` what one without it does.  Both take turns; CPU time
is that of this process, with its writing to disk, without starting.  A quiet machine is not needed for the
ratio.

Defends: what a worker tells saves the recorder half of its work, and the file is the same.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any, Literal

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import interleaved, spread
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.identity import RobotId
from rse_pf.pnp.problems import make_problem
from rse_pf.recording.recorder_process import MessageRecorder, PipeRecorder
from rse_pf.recording.redact import Pseudonyms
from rse_pf.recording.tap import RecordingTap
from rse_pf.recording.writer import RecordingWriter
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import make_request, wire_types
from rse_pf.wire import Command, Result, make_codec

_ROBOTS, _PROBLEMS = 100, 60
_READ_BYTES = 1 << 15
_STEP_NS = 1_000_000


def answer_commands(codec_name: str) -> list[tuple[bytes, Command, bytes, Result]]:
    """Return commands and their answers, encoded and decoded."""
    registry = builtin_services(PlatformSettings())
    codec = make_codec(codec_name, pnp=wire_types(registry))
    pairs = []
    for seed in range(_PROBLEMS):
        p = make_problem(seed=seed, outlier_ratio=0.3)
        payload = make_request(p.points_world, p.pixels, p.camera, binary=codec_name == "bin")
        asked = codec.encode(Command(id=seed, service="pnp", payload=payload, stream="pose", keep=True))
        command = codec.decode_from_robot(asked)
        assert isinstance(command, Command)
        result = dispatch(registry, command, itertools.count(100.0).__next__, server="s", received_s=99.5)
        assert isinstance(result, Result)
        pairs.append((asked, command, codec.encode(result), result))
    return pairs


def stream(codec_name: str, commands: int, *, is_told: bool) -> bytes:
    """Return the bytes of a pipe."""
    read, write = os.pipe()
    os.set_blocking(read, False)
    clock = itertools.count(1_790_000_000_000_000_000, _STEP_NS)
    tap = RecordingTap(write, call_later=lambda seconds, call: None, time_ns=lambda: next(clock))
    robots = [tap.opened(codec_name, RobotId("default", f"robot-{k}")) for k in range(_ROBOTS)]
    pairs, parts = answer_commands(codec_name), []
    for number in range(commands):
        asked, command, answer, result = pairs[number % _PROBLEMS]
        tap.up(robots[number % _ROBOTS], asked)
        if is_told:
            tap.is_plain(asked, command.id, f"{command.stream} {command.trace}")
        tap.down(robots[number % _ROBOTS], answer)
        if is_told:
            tap.has_pose(answer, result.id, result.reply.T_camera_world.tobytes())
        tap.hand_over()
        parts.append(os.read(read, 1 << 20))
    os.close(read)
    os.close(write)
    return b"".join(parts)


def cost_us(data: bytes, commands: int, folder: Path) -> tuple[float, int]:
    """Return the CPU time of a command, and the bytes of the file."""
    writer = RecordingWriter(folder, "s", started_ns=1, max_file_bytes=1 << 40, max_bytes=1 << 40)
    recorder = MessageRecorder(writer, Pseudonyms(b"k" * 32), SessionSettings(), "s")
    worker = PipeRecorder(recorder)
    began = time.process_time()
    for at in range(0, len(data), _READ_BYTES):
        worker.read(data[at : at + _READ_BYTES])
        writer.flush(time.time_ns())
    spent = time.process_time() - began
    writer.close()
    return 1e6 * spent / commands, sum(path.stat().st_size for path in folder.iterdir())


@benchmark(Bar("ratio", at_most=0.5))
def run_benchmark(
    *,
    commands: int = 6000,
    runs: Annotated[int, "of each"] = 5,
    codec: Literal["zlib", "json", "bin"] = "zlib",
) -> dict[str, Any]:
    """Measure both streams in turns."""
    streams = {name: stream(codec, commands, is_told=name == "told") for name in ("untold", "told")}
    spent: dict[str, list[float]] = {name: [] for name in streams}
    kilobytes = {}
    for _, name in interleaved(list(streams), runs):
        with tempfile.TemporaryDirectory() as folder:
            us, size = cost_us(streams[name], commands, Path(folder))
            spent[name].append(us)
            kilobytes[name] = size / commands / 1e3
    least = {name: min(times_us) for name, times_us in spent.items()}
    return {
        "us": {name: spread(times_us) for name, times_us in spent.items()}, "least_us": least,
        "kilobytes": kilobytes, "ratio": least["told"] / least["untold"],
    }  # fmt: skip
