"""Measure a robot's front end: features, their points, and matches with the frame before; CPU of one thread.

Defends: on the kitchen recording at most half the CPU of version 0.1.0, and every byte of its features and
matches.  All ways take turns on each frame; the load average stands beside the figures.

    git worktree add ../0.1.0 7523456
    python -m benchmarks solver.frontend ../shared/data/7scenes_redkitchen --before ../0.1.0 --n 500
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from client_sdk import frontend
from client_sdk.datasets import Dataset, open_dataset
from rse_pf import native
from rse_pf.errors import ConfigurationError
from rse_pf.geometry import Array
from rse_pf.native_front_end import FrontEndCore, open_front_end

ARRAYS = ("points_world", "pixels")


@dataclass(slots=True, eq=False)
class Way:
    """One way to do the work, and what it took, in microseconds a frame."""

    name: str
    module: ModuleType
    core: FrontEndCore | None = None
    before: Any = None
    extract_us: list[float] = field(default_factory=list)
    match_us: list[float] = field(default_factory=list)
    other_bytes: int = 0

    def step(self, frame: Any, *, wide: bool) -> list[bytes]:
        """Do the work of one frame and return its bytes; the first frame has no matches."""
        make = self.module.FrontEndOptions
        # As many as 0.1.0 sent, so that all matches are compared.
        options = replace(make.wide_baseline() if wide else make(), max_matches=700)
        self.module.front_end_core = lambda: self.core  # type: ignore[attr-defined]
        spent_us, features = cpu_us(lambda: self.module.extract(frame, options))
        results: list[Array] = [features.pixels, features.descriptors, features.points_camera]
        if self.before is not None:
            self.extract_us.append(spent_us)
            spent_us, matches = cpu_us(lambda: self.module.match(self.before, features, options))
            self.match_us.append(spent_us)
            results += [getattr(matches, name) for name in ARRAYS]
        self.before = features
        return [result.tobytes() for result in results]


def cpu_us(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the calling thread's CPU time of *work*, in microseconds, and its result."""
    begin = time.thread_time_ns()
    result = work()
    return (time.thread_time_ns() - begin) / 1e3, result


def front_end_of(tree: Path) -> ModuleType:
    """Return the front end of another checkout; what it imports is this checkout's."""
    spec = importlib.util.spec_from_file_location("frontend_before", tree / "client_sdk" / "frontend.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"{tree} is no checkout of RSE-PF")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def ways(before: Path | None) -> list[Way]:
    """Return the reference and all ways of this checkout; without *before* its path without the library."""
    modules = [Way("numpy and OpenCV", frontend)]
    if before is not None:
        modules.insert(0, Way("before", front_end_of(before)))
    path = native.find_library()
    if path is None:
        raise SystemExit("the native core is not built: make -C native")
    try:
        modules += [
            Way("core", frontend, open_front_end(path)),
            Way("core, AVX2", frontend, open_front_end(path, "avx2")),
            Way("core, portable", frontend, open_front_end(path, "portable")),
        ]
    except ConfigurationError as error:
        raise SystemExit(error.report()) from None
    return modules


def rows(dataset: Dataset, frames: int) -> Iterator[int]:
    """Yield as many rows as asked for, there and back again."""
    there = list(range(len(dataset)))
    for number in range(frames):
        lap, row = divmod(number, len(there))
        yield there[-1 - row if lap % 2 else row]


def measure(dataset: Dataset, compared: list[Way], pairs: int, *, wide: bool) -> list[dict[str, Any]]:
    """Return CPU and differing frames of all ways; the first one is the reference."""
    cv2 = frontend.load_opencv()
    cv2.setNumThreads(1)  # all work on the thread that is measured
    orb_us: list[float] = []
    for number, row in enumerate(rows(dataset, pairs + 1)):
        frame = dataset.read(row)
        # The first one pays for cold caches, so they take turns.
        turn = number % len(compared)
        results = {way.name: way.step(frame, wide=wide) for way in compared[turn:] + compared[:turn]}
        for way in compared:
            way.other_bytes += results[way.name] != results[compared[0].name]
        features = 4000 if wide else 1000
        orb = cv2.ORB_create(nfeatures=features, scaleFactor=1.2, nlevels=8, fastThreshold=10)
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        orb_us.append(cpu_us(partial(orb.detectAndCompute, gray, None))[0])
    whole = {way.name: np.add(way.extract_us, way.match_us) for way in compared}
    reference = np.median(whole[compared[0].name])
    figures = [
        {
            "way": way.name,
            "extract_us": spread(way.extract_us),
            "match_us": spread(way.match_us),
            "frame_us": spread(whole[way.name]),
            "share": float(np.median(whole[way.name]) / reference),
            "frames_with_other_bytes": way.other_bytes,
        }
        for way in compared
    ]
    return [*figures, {"way": "ORB alone", "frame_us": spread(orb_us)}]


@benchmark(
    Bar("share", at_most=0.5, unit="of the CPU of 0.1.0"),
    Bar("frames_with_other_bytes", equals=0),
)
def run_benchmark(
    *,
    recording: Annotated[Path, "folder of a recording"],
    before: Annotated[Path | None, "a checkout of version 0.1.0, the reference"] = None,
    n: Annotated[int, "pairs of frames"] = 500,
    wide: Annotated[bool, "four times the features, as for wide baselines"] = False,
) -> dict[str, Any]:
    """Compare all ways on one recording."""
    figures = measure(open_dataset(recording), ways(before), n, wide=wide)
    ours = figures[-2]
    compared = {} if before is None else {key: ours[key] for key in ("share", "frames_with_other_bytes")}
    return {"recording": recording.name, "ways": figures, **compared}
