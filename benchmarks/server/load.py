"""The load generator `load.c` from Python: compile it at first use, write its files, run it, read its report.

`compile_generator` raises ConfigurationError without a C compiler; a benchmark then says so and is skipped.
`run_load` waits for a run of fixed length.  `LoadProcess` is a run that a benchmark stops itself, and whose
samples are divided into windows afterwards.  Both are killed with their caller, and connect to loopback only.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import signal
import struct
import subprocess
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rse_pf.config import SessionSettings
from rse_pf.errors import ConfigurationError
from rse_pf.extensions.experiments.load.payloads import make_payloads
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.wire import SUBPROTOCOLS, Command, Hello, Message, Ping, make_codec
from rse_pf.wire.preencoded import encode_command

__all__ = [
    "OUTCOMES", "SAMPLE", "GroupReport", "LoadPlan", "LoadProcess", "LoadReport", "Percentiles", "RobotGroup",
    "command_file", "compile_generator", "group_of", "hello_file", "ping_file", "plan_of", "read_samples",
    "run_load", "write_messages",
]  # fmt: skip

Mode = Literal["open", "early", "closed"]

# Source of the load generator.
SOURCE = Path(__file__).with_name("load.c")
# Options of the C compiler.
FLAGS = ("-O2", "-std=c11", "-Wall", "-Wextra", "-Werror")
# Options of the linker.
LIBRARIES = ("-lz", "-lm")
SAMPLE = np.dtype(
    [("planned_s", "<f8"), ("latency_s", "<f4"), ("late_s", "<f4"), ("group", "<u4"), ("outcome", "<u4")]
)
"""One message in a file of samples: times of the monotonic clock; the latency is NaN without an answer."""
OUTCOMES = ("ok", "failed", "lost", "unsent")
"""Names of the values of the field *outcome* of `SAMPLE`."""

# Default folder of the compiled generator.
_BUILD = Path(__file__).resolve().parents[2] / "build" / "benchmarks"
_COMPILE_S = 60.0  # time limit for compiling the generator
_MARGIN_S = 20.0  # time beyond the plan in which the generator has to exit
_OPENING_S = 60.0  # time limit in which all robots have to connect
# How the generator decodes answers, by codec.
_REPLIES = {"zlib": "zlib", "json": "json", "bin": "msgpack", "peer": "peer"}


def compile_generator(folder: Path = _BUILD) -> Path:
    """Return the compiled generator; compile it if *folder* does not have this version.

    Raises:
        ConfigurationError: There is no C compiler, or it cannot compile the source.
    """
    digest = hashlib.sha256(SOURCE.read_bytes() + " ".join(FLAGS).encode()).hexdigest()[:16]
    program = folder / f"load-{digest}"
    if program.exists():
        return program
    compiler = shutil.which("cc")
    if compiler is None:
        raise ConfigurationError("the load generator needs a C compiler", hint="install gcc and zlib1g-dev")
    folder.mkdir(parents=True, exist_ok=True)
    made = folder / f"load-{digest}.{threading.get_ident()}.new"
    command = [compiler, *FLAGS, str(SOURCE), "-o", str(made), *LIBRARIES]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=_COMPILE_S, check=False)
    if ended.returncode:
        raise ConfigurationError(
            f"{compiler} cannot compile {SOURCE.name}",
            hint=(ended.stderr.strip().splitlines() or ["no message"])[0] + "; zlib.h is in zlib1g-dev",
        )
    made.replace(program)
    return program


def write_messages(file: Path, messages: Iterable[bytes]) -> Path:
    """Write *messages* to *file*, each after its length, and return *file*; message k must have the id k."""
    file.write_bytes(b"".join(struct.pack("<I", len(message)) + message for message in messages))
    return file


def hello_file(folder: Path, codec_name: str) -> Path:
    """Write a file with the Hello of a robot, and return its path."""
    return _encode(folder / f"hello.{codec_name}", codec_name, [Hello()])


def ping_file(folder: Path, codec_name: str) -> Path:
    """Write a file with the ping of a robot, and return its path."""
    return _encode(folder / f"ping.{codec_name}", codec_name, [Ping(sent_s=1.0)])


def command_file(folder: Path, scenario: LoadScenario) -> Path:
    """Write a file with the commands of a robot of *scenario*, as the SDK sends them; return its path."""
    codec, session = make_codec(scenario.codec), SessionSettings()
    commands = [
        Command(
            id=number, service=scenario.service, payload=made.payload, stream="pose", keep=scenario.keep,
            deadline_ms=1e3 * scenario.deadline_s,
        )
        for number, made in enumerate(make_payloads(scenario, session))
    ]  # fmt: skip
    file = folder / f"{scenario.service}-{round(100 * scenario.outliers)}.{scenario.codec}"
    return write_messages(file, (encode_command(codec, command) for command in commands))


def _encode(file: Path, codec_name: str, messages: Sequence[Message]) -> Path:
    codec = make_codec(codec_name)
    return write_messages(file, [codec.encode(message) for message in messages])


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotGroup:
    """Robots with the same load: *rate* messages a second each (open loop), or one after each answer."""

    name: str
    robots: int
    mode: Mode
    rate: float = 0.0
    payload: Path | None = None

    def option(self) -> str:
        """Return the group as an argument of the program `load`."""
        return f"{self.name}:{self.robots}:{self.mode}:{self.rate:g}:{self.payload or '-'}"


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadPlan:
    """One run of the generator against one port of loopback.

    *codec* is ``zlib``, ``json``, ``bin``, or ``peer`` for the paper's design, which has no sub-protocol of
    WebSocket.  The window begins *warm_up_s* after the last robot has connected, and lasts *seconds*.
    Messages that are planned within it count; those without an answer *drain_s* after its end are lost.
    *sources* is the number of addresses from which connections come, in turn.
    """

    port: int
    groups: tuple[RobotGroup, ...]
    codec: str = "bin"
    path: str = "/ws"
    hello: Path | None = None
    tokens: Path | None = None
    seconds: float = 4.0
    warm_up_s: float = 0.5
    drain_s: float = 4.0
    opening_s: float = _OPENING_S
    sources: int = 1
    first_source: int = 1
    at_once: int = 64
    join_every_s: float = 0.0
    seed: int = 1
    samples: Path | None = None
    obeys: bool = False
    """Whether robots wait as failures demand; commands that they leave out count as unsent."""

    def command(self, program: Path) -> list[str]:
        """Return the command line that runs this plan."""
        values: dict[str, object] = {
            "port": self.port, "path": self.path, "reply": _REPLIES[self.codec], "seconds": self.seconds,
            "warm-up": self.warm_up_s, "drain": self.drain_s, "opening": self.opening_s,
            "sources": self.sources, "first-source": self.first_source, "at-once": self.at_once,
            "join-every": self.join_every_s, "seed": self.seed,
            "hello": self.hello, "tokens": self.tokens, "samples": self.samples, "obey": int(self.obeys),
            "subprotocol": SUBPROTOCOLS.get(self.codec),
        }  # fmt: skip
        made = [str(program)]
        for name, value in values.items():
            made += [] if value is None else [f"--{name}", str(value)]
        for group in self.groups:
            made += ["--group", group.option()]
        return made


def group_of(scenario: LoadScenario, folder: Path, name: str = "robots") -> RobotGroup:
    """Return the robots of *scenario*; their commands are written to *folder*.

    Raises:
        ConfigurationError: *scenario* has an emulated network link, which this generator does not support.
    """
    if scenario.link is not None:
        raise ConfigurationError(
            f"the load generator in C emulates no network link ({scenario.link})", hint="use rse-pf swarm"
        )
    return RobotGroup(
        name=name, robots=scenario.robots, mode="early" if scenario.join_every_s else "open",
        rate=scenario.fps, payload=command_file(folder, scenario),
    )  # fmt: skip


def plan_of(scenario: LoadScenario, folder: Path, port: int) -> LoadPlan:
    """Return the plan that drives *scenario* against *port*; raises ConfigurationError as `group_of`."""
    return LoadPlan(
        port=port, groups=(group_of(scenario, folder),), codec=scenario.codec,
        hello=hello_file(folder, scenario.codec), seconds=scenario.seconds, seed=scenario.seed,
        drain_s=scenario.deadline_s, join_every_s=scenario.join_every_s,
        opening_s=_OPENING_S + scenario.robots * scenario.join_every_s,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of times, ms; NaN without times."""

    n: int
    p50: float
    p95: float
    p99: float
    p999: float
    max: float

    @classmethod
    def of(cls, document: dict[str, Any]) -> Percentiles:
        """Return the percentiles in *document*, an object of a report."""
        names = ("p50", "p95", "p99", "p999", "max")
        return cls(
            document["n"], *(math.nan if document[name] is None else float(document[name]) for name in names)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupReport:
    """The outcomes of the messages that one group planned within the window.

    *lost* messages were sent and not answered; for *unsent* ones there was no open connection.  *late_ms* is
    how late this generator itself sent.  *answered_in_window* counts answers by the time of their arrival.
    """

    name: str
    robots: int
    ok: int
    failed: int
    lost: int
    unsent: int
    answered_in_window: int
    latency_ms: Percentiles
    late_ms: Percentiles


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadReport:
    """The result of a run; *closed*, *refused*, *codes* count closes, handshake statuses, failure codes."""

    robots: int
    connected: int
    opening_s: float
    window_s: tuple[float, float]
    cpu_s: float
    timed_out: bool
    unmatched: int
    refused: dict[str, int]
    closed: dict[str, int]
    codes: dict[str, int]
    groups: tuple[GroupReport, ...]

    @classmethod
    def from_json(cls, text: str) -> LoadReport:
        """Parse the output of the generator."""
        document = json.loads(text)
        groups = tuple(
            GroupReport(
                **{**group, "latency_ms": Percentiles.of(group["latency_ms"])}
                | {"late_ms": Percentiles.of(group["late_ms"])}
            )
            for group in document.pop("groups")
        )
        return cls(**{**document, "window_s": tuple(document["window_s"]), "groups": groups})

    def group(self, name: str) -> GroupReport:
        """Return the report of the group *name*."""
        return next(group for group in self.groups if group.name == name)


class LoadProcess:
    """A running generator: ``with LoadProcess(plan) as load`` runs it until `stop`, or for the plan's time.

    *on_mark* is called in a thread with ``begin`` and ``end`` when the window begins and ends.
    """

    def __init__(self, plan: LoadPlan, on_mark: Callable[[str], None] = lambda mark: None) -> None:
        self.plan = plan
        self._on_mark = on_mark
        self._begun = threading.Event()
        self._errors: list[str] = []

    def __enter__(self) -> LoadProcess:
        self._process = subprocess.Popen(
            self.plan.command(compile_generator()),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._marks = threading.Thread(target=self._read_marks, daemon=True)
        self._marks.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._marks.join(_MARGIN_S)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def wait_begun(self) -> None:
        """Wait until the window begins; raises ConfigurationError if it does not begin in time."""
        limit_s = self.plan.opening_s + self.plan.warm_up_s + _MARGIN_S
        if not self._begun.wait(limit_s) or self._process.poll() not in (None, 0):
            raise ConfigurationError("the load generator did not begin", hint=" ".join(self._errors)[-300:])

    def result(self) -> LoadReport:
        """Wait for the end of the plan's time and return the report."""
        plan = self.plan
        limit_s = plan.opening_s + plan.warm_up_s + plan.seconds + plan.drain_s + _MARGIN_S
        try:
            self._process.wait(limit_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
        assert self._process.stdout is not None
        output = self._process.stdout.read()
        self._marks.join(_MARGIN_S)
        if self._process.wait() != 0 or not output:
            raise ConfigurationError("the load generator failed", hint=" ".join(self._errors)[-300:])
        return LoadReport.from_json(output)

    def stop(self) -> LoadReport:
        """End the window now and return the report."""
        self._process.send_signal(signal.SIGTERM)
        return self.result()

    def _read_marks(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                mark = line.split(" ", 1)[0]
                if mark in ("begin", "end"):
                    self._on_mark(mark)
                    self._begun.set()
                else:
                    self._errors.append(line.strip())
        self._begun.set()


def run_load(plan: LoadPlan, on_mark: Callable[[str], None] = lambda mark: None) -> LoadReport:
    """Run *plan* to its end and return the report; raises ConfigurationError if the generator fails."""
    with LoadProcess(plan, on_mark) as load:
        return load.result()


def read_samples(file: Path) -> npt.NDArray[np.void]:
    """Return the messages of a run, an array of `SAMPLE`, in the order of their outcomes."""
    return np.fromfile(file, dtype=SAMPLE)
