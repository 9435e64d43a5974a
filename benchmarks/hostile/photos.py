"""Robots flood the data service with photos and hostile images; how long do others wait?

    python -m benchmarks hostile.photos [--seconds 10] [--rounds 6] [--attackers 4] [--identities 1]

One data server (``rse-pf data``) on loopback.  A robot of another tenant stores 64 KiB five times a second,
and then localises a photo twice a second, each first alone and then beside *attackers* connections of
*identities* robots.  Every second connection sends photos that can be localised, the others all images of
`tests/hostile/hostile_images.py`, as fast as the service answers.  The phases alternate.  The hostile robots
run at the lowest priority: in the field their work costs a server nothing.

Defends: the p99 of PUT and of photos beside the flood is at most 1.2 times that of the quiet phases; no
hostile image is localised, and none ends a process.
"""

from __future__ import annotations

import http.client
import itertools
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

from benchmarks.data.floods import (
    HOSTILE,
    VICTIM,
    Client,
    Server,
    hostile,
    run_threads,
    store_pictures,
    token_of,
)
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from benchmarks.maps.photos import world_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.identity import RobotId
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.object_store import DirectoryStore

__all__: list[str] = []

LENS = urlencode({"fx": 525, "fy": 525, "cx": 319.5, "cy": 239.5})
PATH = f"/localise/rooms?{LENS}"
_PHOTO_EVERY_S = 0.5
_LOWEST_PRIORITY = 19


@benchmark(
    Bar("put_p99_ratio", at_most=1.2, unit="times quiet"),
    Bar("photo_p99_ratio", at_most=1.2, unit="times quiet"),
    Bar("hostile_images_found", equals=0),
    Bar("processes_ended", equals=0),
)
def run_benchmark(
    *,
    seconds: Annotated[float, "of each phase"] = 10.0,
    rounds: int = 6,
    attackers: Annotated[int, "connections of the flood"] = 4,
    identities: Annotated[int, "robots that the flood comes from"] = 4,
    only: Annotated[str, "put or photo; '' for both"] = "",
) -> dict[str, Any]:
    """Measure the phases in turns."""
    key, statuses = SigningKey.from_seed(os.urandom(32), "key-1"), Counter[str]()
    keyframes, photos = world_of(0)
    took: dict[str, list[float]] = {"put": [], "put_beside": [], "photo": [], "photo_beside": []}
    with tempfile.TemporaryDirectory() as made:
        store = DirectoryStore(Path(made) / "objects")
        for tenant in (VICTIM.tenant, HOSTILE.tenant):
            MapRegistry(store, tenant).commit(
                "rooms", encode_map(MapVersion(keyframes=tuple(keyframes))), parent=None, author="bench",
                created_s=0.0,
            )  # fmt: skip
        (Path(made) / "photo.jpg").write_bytes(photos[0].jpeg)
        with Server(Path(made), key) as server:
            victim = Client(server.port, token_of(key, VICTIM))
            store_pictures(victim, 2.0)
            localise_photos(victim, photos[1].jpeg, 2.0)
            tokens = [
                token_of(key, RobotId(HOSTILE.tenant, f"phone-{number % identities}"))
                for number in range(attackers)
            ]
            flood = server.port, tokens, str(Path(made) / "photo.jpg")
            for _ in range(rounds):
                if only in ("", "put"):
                    took["put"] += store_pictures(victim, seconds)
                    with hostile(flood_of_photos, flood, statuses):
                        took["put_beside"] += store_pictures(victim, seconds)
                if only in ("", "photo"):
                    took["photo"] += localise_photos(victim, photos[1].jpeg, seconds)
                    with hostile(flood_of_photos, flood, statuses):
                        took["photo_beside"] += localise_photos(victim, photos[1].jpeg, seconds)
            victim.close()
            log = (Path(made) / "log").read_text()
    figures: dict[str, Any] = {name: spread(times) for name, times in took.items() if times}
    figures["photos_beside_ms"] = list(map(round, took["photo_beside"]))
    for name in ("put", "photo") if not only else (only,):
        figures[f"{name}_p99_ratio"] = figures[f"{name}_beside"]["p99"] / figures[name]["p99"]
    found = sum(count for what, count in statuses.items() if what.startswith("image 200 ok"))
    return figures | {
        "statuses": dict(sorted(statuses.items())), "hostile_images_found": found,
        "processes_ended": log.count('"crashed"'),
    }  # fmt: skip


def localise_photos(client: Client, photo: bytes, seconds: float) -> list[float]:
    """Localise a photo twice a second; return how long each took (ms); raises SystemExit if one fails."""
    times, until, due = [], time.monotonic() + seconds, time.monotonic()
    while due < until:
        time.sleep(max(0.0, due - time.monotonic()))  # the rate is a parameter of the measurement
        began = time.monotonic()
        status, content = client.ask("POST", PATH, photo)
        times.append(1000 * (time.monotonic() - began))
        if status != 200 or b'"verdict":"ok"' not in content:
            raise SystemExit(f"the other robot's photo ended in {status}: {content[:200]!r}")
        due += _PHOTO_EVERY_S
    return times


def flood_of_photos(
    port: int, tokens: list[str], photo: str, begun: Event, stop: Event, results: Any
) -> None:
    """Send photos, and over every second connection hostile images, until *stop*."""
    os.nice(_LOWEST_PRIORITY)
    results.put(dict(send_photos(port, tokens, Path(photo).read_bytes(), stop.is_set, begun)))


def send_photos(
    port: int, tokens: Sequence[str], photo: bytes, is_over: Callable[[], bool], begun: Event
) -> Counter[str]:
    """Send *photo*, and over every second connection hostile images; return the statuses."""
    from tests.hostile.hostile_images import hostile_images

    statuses, images = Counter[str](), list(hostile_images().values())

    def work(row: int) -> None:
        client = Client(port, tokens[row])
        for number in itertools.count(row):
            if is_over():
                break
            image = photo if row % 2 == 0 else images[number % len(images)]
            try:
                status, content = client.ask("POST", PATH, image)
            except (OSError, http.client.HTTPException):
                statuses["cut"] += 1
                client.close()
                continue
            verdict = " ok" if b'"verdict":"ok"' in content else ""
            statuses[f"{'image' if row % 2 else 'photo'} {status}{verdict}"] += 1
        client.close()

    run_threads(work, len(tokens), begun)
    return statuses
