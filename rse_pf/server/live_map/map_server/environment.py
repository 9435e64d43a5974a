"""Hold what a map server runs with: its threads, clocks, stores, and the functions that send its updates."""

from __future__ import annotations

import asyncio
import enum
import itertools
import os
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import PriorityQueue
from typing import Any, TypeVar

from rse_pf.config import LiveSettings
from rse_pf.geometry import Array
from rse_pf.live_map.events import MapStarted
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.versions import started_from
from rse_pf.maps.format import MapVersion
from rse_pf.maps.registry import MapRegistry
from rse_pf.server.live_map.map_server.keyframe_objects import KeyframeObjects
from rse_pf.server.log import JsonLog
from rse_pf.slam.optimise import OptimiseOptions
from rse_pf.slam.pose_graph import PoseGraph
from rse_pf.storage.quotas import TenantAccount

__all__ = [
    "FIRST_RETRY_S",
    "LIVE_MAP",
    "GraphOptimiser",
    "MapImplementation",
    "MapServerEnvironment",
    "MapServerThreads",
    "Sleep",
    "Urgency",
    "next_retry_s",
]

FIRST_RETRY_S = 0.05
"""Seconds after which an operation of the object store that failed is tried again for the first time."""
_MAX_RETRY_S = 1.0
"""Longest wait in seconds between two tries of a failing object store: a map continues soon after an
outage."""
_MATCHING_THREADS = 3
"""Number of threads that match keyframes: one more than the measurements of loop closures that run at the
same time, so that a robot can be relocalised meanwhile.  Matching and solving release Python's interpreter
lock (GIL), so these threads run in parallel."""
_BACKGROUND_NICE = 10
"""Niceness of the thread that writes snapshots and versions, because nobody waits for them.  The threads that
measure loop closures keep the normal priority, because robots wait for the corrections."""

Sleep = Callable[[float], Coroutine[Any, Any, None]]
"""An asynchronous function that waits for the given number of seconds."""
GraphOptimiser = Callable[[PoseGraph, OptimiseOptions], Array]
"""A function that optimises a pose graph and returns its ``(n, 4, 4)`` poses in the frame of the graph."""
_T = TypeVar("_T")


class Urgency(enum.IntEnum):
    """Priority of work in the thread that holds the map; work with a smaller value is done first."""

    APPLY = 0  # apply the events of a durable log entry
    VALIDATE = 1  # validate a keyframe before it is logged
    ANSWER = 2  # answer a request that only reads the map
    MEASURE = 3  # choose candidates for the loop closures of a keyframe
    BACKGROUND = 4  # prepare a version, or the optimisation of the whole graph


class MapServerThreads:
    """The threads in which a map server computes and waits for the object store.

    Every thread does one thing at a time.  There is one thread for the map, one for the log, one for the
    lease, one for floor plans, one for background work, and three for `match`.  They end with the process.
    """

    def __init__(self) -> None:
        self._log = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._lease = ThreadPoolExecutor(1, thread_name_prefix="lease")
        self._plan = ThreadPoolExecutor(1, thread_name_prefix="plan")
        self._background = ThreadPoolExecutor(
            1, thread_name_prefix="background", initializer=_lower_thread_priority
        )
        self._matching = ThreadPoolExecutor(_MATCHING_THREADS, thread_name_prefix="look")
        self._map_work: PriorityQueue[tuple[int, int, Callable[[], None]]] = PriorityQueue()
        self._order = itertools.count()

    def start(self) -> None:
        """Start the thread of the map; every other thread starts with its first work."""
        threading.Thread(target=self._run_map_work, name="map", daemon=True).start()

    def compute(self, urgency: Urgency, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in the thread of the map, the only thread that reads or changes the map.

        Work of the same urgency is done in the order of the calls.  If the caller that awaits the result is
        cancelled, the work is done all the same.  An exception of *act* is raised where the result is
        awaited.
        """
        future: Future[_T] = Future()

        def run() -> None:
            try:
                result = act()
            except BaseException as error:  # noqa: BLE001  raised again where the result is awaited
                future.set_exception(error)
            else:
                future.set_result(result)

        self._map_work.put((urgency, next(self._order), run))
        return asyncio.shield(asyncio.wrap_future(future))

    def match(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act* in one of three threads for matching; *act* must work on copies of the map's data."""
        return self._run(self._matching, act)

    def store(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act*, which may block on the object store, in the thread that writes entries of the log."""
        return self._run(self._log, act)

    def lease(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act*, which may block on the object store, in the thread that renews the lease."""
        return self._run(self._lease, act)

    def plan(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act*, which may block on the object store, in the thread that makes floor plans.

        It is a thread of its own, because a publication keeps that of `background` for seconds.
        """
        return self._run(self._plan, act)

    def background(self, act: Callable[[], _T]) -> Awaitable[_T]:
        """Call *act*, which may block, in the low-priority thread for snapshots, versions and deletions.

        The thread does one thing at a time, in the order of the calls.
        """
        return self._run(self._background, act)

    def _run(self, pool: ThreadPoolExecutor, act: Callable[[], Any]) -> Awaitable[Any]:
        return asyncio.get_running_loop().run_in_executor(pool, act)

    def _run_map_work(self) -> None:
        while True:
            self._map_work.get()[2]()


def _lower_thread_priority() -> None:
    """Set the niceness of the calling thread to 10; on Linux each thread has a niceness of its own."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _BACKGROUND_NICE)


def next_retry_s(wait_s: float) -> float:
    """Return the seconds until the next try of a failing object store: twice the last wait, at most 1 s."""
    return min(_MAX_RETRY_S, 2 * wait_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapImplementation:
    """The functions that make a map; tests use an implementation without SLAM.

    Attributes:
        empty: Makes a map without keyframes.
        restore: Makes a map from the head of a snapshot and a function that reads its parts by name; raises
            BadRequest if the snapshot is damaged.
        started_from: Makes the first event of a map that starts from a version of the registry, given the
            version and its name.
    """

    empty: Callable[[], LiveMap]
    restore: Callable[[bytes, Callable[[str], bytes]], LiveMap]
    started_from: Callable[[MapVersion, str], MapStarted]


LIVE_MAP = MapImplementation(empty=LiveMap, restore=LiveMap.restore_parts, started_from=started_from)
"""The implementation that map servers use in operation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapServerEnvironment:
    """The values and functions that a map server is given, so that tests can replace them.

    Attributes:
        map_name: Name of the live map.
        settings: Section ``live`` of the settings.
        implementation: Makes the map.
        threads: Threads for computation and for the object store.
        maps: Registry in which versions of the map are published.
        clock: Returns monotonic time in seconds.
        wall_clock: Returns Unix time in seconds.
        sleep: Waits for a number of seconds.
        account: Storage account of the tenant; charged before a log entry or a version is written.
        objects: Points and images that robots store together with their keyframes.
        log: Log of the server.
        send_update: Sends an update payload to every worker that has subscribers of the map.
        on_renewal: Called after each successful renewal of the lease, with the number of renewals so far.
        on_use: Called with True when commands begin to arrive, and with False when none has arrived for a
            sixth of ``live.idle_s``.
        optimise: Optimises the whole pose graph of the map; called in a thread for matching.
    """

    map_name: str
    settings: LiveSettings
    implementation: MapImplementation
    threads: MapServerThreads
    maps: MapRegistry
    clock: Callable[[], float]
    wall_clock: Callable[[], float]
    sleep: Sleep
    account: TenantAccount
    objects: KeyframeObjects
    log: JsonLog
    send_update: Callable[[dict[str, Any]], None]
    on_renewal: Callable[[int], None]
    on_use: Callable[[bool], None]
    optimise: GraphOptimiser
