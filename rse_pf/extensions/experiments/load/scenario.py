"""The description of a load (how many robots send which commands), as a value and as a JSON file.

Two load generators read it: `rse_pf.extensions.experiments.load.swarm` runs robots with the real SDK, and the
generator in C of ``benchmarks`` sends the same messages at the same rate for more robots.  The address of the
platform is not part of the description.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.faults.network_emulator import profile_named
from rse_pf.wire import CODECS

__all__ = ["LoadScenario", "read_scenario", "write_scenario"]

SERVICES = ("pnp", "echo")
"""Services that the robots of a load can call: their correct answers are known.

So replies are checked.
"""

_MAX_ROBOTS = 10_000  # largest number of robots of a load
_MAX_PROCESSES = 16  # largest number of processes that generate a load
_MAX_FPS = 200.0  # largest number of commands per second of each robot
_MAX_MATCHES = 5000  # largest number of matches of a PnP problem, or of numbers of an echo
_MAX_S = 86400.0  # longest load, in seconds: a day


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadScenario:
    """A load: the number of robots and what each of them sends; raises UsageError for a value out of range.

    Robot k connects ``k * join_every_s`` seconds after the start, and sends ``fps`` commands per second.
    ``seconds`` count from when all robots have joined.  ``matches`` and ``outliers`` (a ratio, 0 to 0.9) are
    those of each PnP problem.  ``keep`` asks the platform to answer every frame, not only the newest.
    ``link`` names a profile of `rse_pf.extensions.experiments.faults.network_emulator`; None emulates no
    network. ``processes`` is the number of processes of the generator in Python.
    """

    robots: int = 10
    fps: float = 5.0
    seconds: float = 20.0
    codec: str = "zlib"
    matches: int = 200
    outliers: float = 0.3
    seed: int = 0
    join_every_s: float = 0.0
    deadline_s: float = 5.0
    keep: bool = True
    service: str = "pnp"
    processes: int = 1
    link: str | None = None

    def __post_init__(self) -> None:
        """Check that every field is in range."""
        _within("robots", self.robots, 1, _MAX_ROBOTS)
        _within("fps", self.fps, 0.01, _MAX_FPS)
        _within("seconds", self.seconds, 0.01, _MAX_S)
        _within("matches", self.matches, 4, _MAX_MATCHES)
        _within("outliers", self.outliers, 0.0, 0.9)
        _within("seed", self.seed, 0, 2**31)
        _within("join_every_s", self.join_every_s, 0.0, 3600.0)
        _within("deadline_s", self.deadline_s, 0.01, 3600.0)
        _within("processes", self.processes, 1, _MAX_PROCESSES)
        for name, value, known in (("codec", self.codec, CODECS), ("service", self.service, SERVICES)):
            if value not in known:
                raise UsageError(f"no {name} named {value!r}", hint=f"choose one of {', '.join(known)}")
        if self.link is not None:
            profile_named(self.link)


def read_scenario(file: Path) -> LoadScenario:
    """Read a JSON object whose members are fields of `LoadScenario`.

    Fields that the object lacks have their defaults.

    Raises:
        UsageError: The file cannot be read, holds something else, or a value is out of range.
    """
    hint = "write one JSON object, as in scenario.json in the results of rse-pf swarm"
    try:
        members = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
        known = [field.name for field in fields(LoadScenario)]
        for name in members:
            if name not in known:
                raise UsageError(f"{file}: a scenario has no {name!r}", hint=f"it has {', '.join(known)}")
        return msgspec.convert(members, LoadScenario)
    except OSError as error:
        raise UsageError(
            f"cannot read {file}: {error.strerror}", hint="name the file of a scenario"
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{file} is no scenario: {error}", hint=hint) from error


def write_scenario(file: Path, scenario: LoadScenario) -> Path:
    """Write *scenario* to *file* as the JSON that `read_scenario` reads; return *file*."""
    file.write_text(json.dumps(asdict(scenario), indent=2) + "\n", encoding="utf-8")
    return file


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise UsageError(
            f"{name} = {value:g} is not within {low:g}..{high:g}",
            hint=f"give a value from {low:g} to {high:g}",
        )
