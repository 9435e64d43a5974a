"""The recordings that a comparison reads: all formats of the SDK, and rendered worlds (``world:SEED``)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from client_sdk.datasets import CameraChoice, Dataset, open_dataset
from client_sdk.simulator import rendered_drive
from rse_pf.errors import UsageError

__all__ = ["drives_of", "open_recording"]

# Pattern of the name of a rendered world, with its seed.
_WORLD = re.compile(r"world:(\d{1,9})")
# Number of frames of a rendered world.
_WORLD_FRAMES = 80
# Ratio of a requested rate to that of the recording above which the rate is reported as too high.
_MAX_RATE_RATIO = 1.05


def drives_of(
    words: Sequence[str],
    rates_hz: Sequence[float],
    *,
    camera: CameraChoice | None = None,
    imu: bool | None = None,
) -> list[Dataset]:
    """Return each of the recordings *words* at each of *rates_hz*.

    Without rates, each recording is returned at its own rate.  Rates that give the same frames of a recording
    give one drive; a note says that a rate is above that of its recording.  *camera* and *imu* are those of
    `open_dataset`.

    Raises:
        UsageError: A recording cannot be read, or two recordings have the same name.
    """
    drives: list[Dataset] = []
    names: dict[str, str] = {}
    for word in words:
        dataset = open_recording(word, camera=camera, imu=imu)
        if dataset.name in names:
            raise UsageError(
                f"two recordings are called {dataset.name}: {names[dataset.name]} and {word}",
                hint="name each once, or rename a folder",
            )
        names[dataset.name] = word
        drives += _at_rates(dataset, rates_hz)
    return drives


def open_recording(word: str, *, camera: CameraChoice | None = None, imu: bool | None = None) -> Dataset:
    """Return the recording that *word* names, a path or ``world:SEED``.

    Raises:
        UsageError: The recording cannot be read or contradicts itself, or the seed is malformed.
    """
    world = _WORLD.fullmatch(word)
    if world is not None:
        return rendered_drive(0, 1, _WORLD_FRAMES, int(world[1]))
    if word.startswith("world:"):
        raise UsageError(f"{word} names no rendered world", hint="write world: and a seed, such as world:3")
    dataset = open_dataset(word, camera=camera, imu=imu)
    dataset.check()
    return dataset


def _at_rates(recording: Dataset, rates_hz: Sequence[float]) -> list[Dataset]:
    drives: list[Dataset] = []
    own_hz = recording.rate_hz
    for rate_hz in rates_hz or (own_hz,):
        drive = recording.thinned(rate_hz)
        if rate_hz > _MAX_RATE_RATIO * own_hz:
            note = f"--rate {rate_hz:g} is above the recording's {own_hz:.3g} Hz: all frames are played"
            drive = replace(drive, notes=(*drive.notes, note))
        if all(drive.rows != other.rows for other in drives):
            drives.append(drive)
    return drives
