"""Do what robots and operators request of a live map, in its map server.

A request that changes the map becomes an event in the log; it is answered when the event is applied.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import msgspec

from rse_pf.errors import Conflict, NotFound
from rse_pf.identity import RobotId, folders_of, shown_name
from rse_pf.live_map.events import KeyframeAdded, MapStarted, RobotForgotten, RobotLeft
from rse_pf.server.live_map.lease import MapLease
from rse_pf.server.live_map.map_server.environment import MapServerEnvironment, Urgency
from rse_pf.server.live_map.map_server.floor_plan import FloorPlanner
from rse_pf.server.live_map.map_server.log import LogWriter
from rse_pf.server.live_map.map_server.messages import (
    decode_prior,
    decode_request,
    paths_reply,
    relocalise_reply,
    show_reply,
    version_reply,
)
from rse_pf.server.live_map.map_server.publisher import NOTE_ALL_LEFT, Publisher, read_start_version
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.slam.keyframe import decode_keyframe
from rse_pf.wire.live_map import (
    PUBLISH,
    KeyframeRequest,
    LiveFloorPlan,
    LiveForget,
    LiveMapRequest,
    LiveRelocalise,
    LiveShow,
    LiveStart,
)

__all__ = ["RequestHandler"]

_EVENT_OVERHEAD_BYTES = 512
"""Bytes that are charged to the tenant's quota for each keyframe in the log, in addition to its own bytes."""


class RequestHandler:
    """Does what robots and operators request of one live map; all methods are called in the event loop."""

    def __init__(
        self,
        environment: MapServerEnvironment,
        state: MapState,
        lease: MapLease,
        writer: LogWriter,
        publisher: Publisher,
        *,
        charge: Callable[[int], Awaitable[None]],
        service_state: Callable[[], str],
        start_task: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        """Begin without requests.

        Args:
            environment: Environment of the map server.
            state: The map.
            lease: Lease of the map server, whose record ``live-show`` reports.
            writer: Writes events to the log and applies them to the map.
            publisher: Publishes versions of the map.
            charge: Charges the tenant's quota with bytes that are written to the log next, or refuses them.
            service_state: Returns the value of ``state`` in updates, such as ``live`` or ``moving``.
            start_task: Runs a coroutine until the service ends.
        """
        self._environment = environment
        self._state = state
        self._lease = lease
        self._writer = writer
        self._publisher = publisher
        self._charge = charge
        self._service_state = service_state
        self._start_task = start_task
        self._floor_planner = FloorPlanner(environment, state)
        self._robot_names: dict[str, str] = {}  # displayed names, keyed by RobotId.folder
        # Keyframes that are being added, keyed by RobotId.folder and keyframe number.
        self._additions: dict[tuple[str, int], asyncio.Task[None]] = {}
        # Folders of robots that have sent keyframes to this process and have not left since then.
        self._present_robots: set[str] = set()

    def name_of(self, folder: str) -> str:
        """Return the name that is displayed for the robot with the `RobotId.folder` *folder*."""
        return self._robot_names.get(folder) or shown_name(folder)

    async def answer(self, robot: RobotId, operation: str, data: bytes) -> dict[str, Any]:
        """Do what a robot or an operator requests, except for ``live-stop``, and return the reply.

        Args:
            robot: Robot that asks.
            operation: Name of the service, such as ``live-keyframe``.
            data: Request in MessagePack, as a worker encodes it.

        Raises:
            RsePfError: The request is refused.
        """
        self._robot_names[robot.folder] = robot.name
        match decode_request(operation, data):
            case KeyframeRequest() as request:
                return await self._take_keyframe(robot, request)
            case LiveRelocalise() as request:
                return await self._relocalise(request)
            case LiveFloorPlan() as request:
                return await self._floor_planner.answer(request)
            case LiveForget() as request:
                return await self._forget_robot(request)
            case LiveStart() as request:
                return await self._start_map(request)
            case LiveShow() as request:
                show = functools.partial(self._show, robot, request.paths)
                return await self._environment.threads.compute(Urgency.ANSWER, show)
            case LiveMapRequest() if operation == PUBLISH:
                record = await self._publisher.publish(f"published by {robot}")
                return version_reply(self._environment.map_name, record)
            case LiveMapRequest():
                return await self._leave(robot)

    async def _take_keyframe(self, robot: RobotId, request: KeyframeRequest) -> dict[str, Any]:
        """Add a keyframe to the map; the reply names the number of the robot's next keyframe.

        If the robot sends a keyframe again while it is being added, both requests wait for the same addition,
        which continues if a request is cancelled.
        """
        event = KeyframeAdded(
            robot=robot.folder, segment=request.segment, number=request.number, data=request.keyframe
        )
        key = event.robot, event.number
        addition = self._additions.get(key)  # not None if the robot sends the keyframe again
        if addition is None:
            self._present_robots.add(event.robot)
            addition = self._additions[key] = asyncio.ensure_future(self._add_keyframe(event))
            addition.add_done_callback(lambda _: self._additions.pop(key))
        await asyncio.shield(addition)
        return {"number": event.number + 1, "version": self._state.position}

    async def _add_keyframe(self, event: KeyframeAdded) -> None:
        """Write a keyframe to the log and wait until it is applied to the map.

        A keyframe that the map has already is not written again.

        Raises:
            RsePfError: The keyframe is refused, for example because it is not valid, or above the quota.
        """
        compute, live_map = self._environment.threads.compute, self._state.live_map
        while True:
            # 1. Validate the keyframe against the map; the robot may have sent it before.
            verdict = await compute(Urgency.VALIDATE, functools.partial(live_map.check_keyframe, event))
            if verdict == "known":
                return
            # 2. Charge, log and apply the keyframe if it is the robot's next one.
            if verdict == "new":
                await self._charge(len(event.data) + _EVENT_OVERHEAD_BYTES)
                await asyncio.shield(self._writer.submit(event, len(event.data)))
                return
            # 3. Otherwise its number is too high: wait for the keyframe before it, if that is being added,
            # and validate this one again.
            previous = self._additions.get((event.robot, event.number - 1))
            if previous is not None:
                await asyncio.wait({previous})
                continue
            # 4. Refuse the keyframe if the one before it was not sent.
            expected = await compute(Urgency.VALIDATE, functools.partial(live_map.next_number, event.robot))
            if event.number > expected:
                raise Conflict(
                    f"keyframe {event.number} arrived, but {expected} is the next one",
                    hint=f"send keyframe {expected} first",
                )

    async def _relocalise(self, request: LiveRelocalise) -> dict[str, Any]:
        view = decode_keyframe(request.keyframe)
        prior = decode_prior(request.prior)
        threads, live_map = self._environment.threads, self._state.live_map
        relocalise = await threads.compute(
            Urgency.ANSWER, functools.partial(live_map.prepare_relocalisation, view, prior)
        )
        position = self._state.position
        return relocalise_reply(await threads.match(relocalise), position)

    async def _leave(self, robot: RobotId) -> dict[str, Any]:
        """Submit the event `RobotLeft` if the map has the robot; make a version due if no robot is left.

        The reply does not wait for the publication.
        """
        if robot.folder in await self._environment.threads.compute(
            Urgency.ANSWER, lambda: self._state.live_map.robots
        ):
            await asyncio.shield(self._writer.submit(RobotLeft(robot=robot.folder)))
        self._present_robots.discard(robot.folder)
        if not self._present_robots:
            self._publisher.request(NOTE_ALL_LEFT)
            self._start_task(self._publisher.publish_due())
        return {}

    async def _forget_robot(self, request: LiveForget) -> dict[str, Any]:
        """Remove all that a robot contributed to the map, and delete its stored points and images.

        A robot that was enrolled several times under one name is removed completely; the reply counts these
        enrolments.

        Raises:
            NotFound: The robot contributed nothing.
            StoreError: The objects could not be deleted; the robot is removed from the map all the same, and
                the next publication deletes them.
        """
        contributors = await self._environment.threads.compute(
            Urgency.ANSWER, lambda: list(self._state.live_map.contributors)
        )
        folders = [folder for folder in contributors if self._robot_names.get(folder) == request.robot]
        folders += [folder for folder in folders_of(request.robot, contributors) if folder not in folders]
        if not folders:
            raise NotFound(
                f"robot {request.robot[:80]!r} contributed nothing to the live map",
                hint="name a robot that rse-pf map live show MAP lists",
            )
        for folder in folders:
            await asyncio.shield(self._writer.submit(RobotForgotten(robot=folder)))
        await self.delete_objects_of_forgotten()
        return {"forgotten": len(folders), "version": self._state.position}

    async def delete_objects_of_forgotten(self) -> None:
        """Delete from the store the points and images of all forgotten robots; raises StoreError."""
        threads, objects = self._environment.threads, self._environment.objects
        forgotten = await threads.compute(Urgency.ANSWER, lambda: self._state.live_map.deletable_objects)
        if forgotten:
            await threads.background(functools.partial(objects.delete_of_forgotten, forgotten))

    async def _start_map(self, request: LiveStart) -> dict[str, Any]:
        """Begin an empty map, or a map with the keyframes of a version; raises Conflict if it has begun.

        An empty map without ``equal_rooms_m`` has no event in the log: the request then changes nothing, and
        may be sent again.
        """
        map_name, background = self._environment.map_name, self._environment.threads.background
        if self._state.changes or self._state.keyframes:
            raise Conflict(
                f"the live map {map_name!r} has begun already",
                hint=f"stop it first: rse-pf map live stop {map_name}",
            )
        if request.source:
            version, source = await background(lambda: read_start_version(self._environment.maps, request))
            event = await background(lambda: self._environment.implementation.started_from(version, source))
        else:
            event = MapStarted(source="", keyframes=())
        if request.source or request.equal_rooms_m:
            event = msgspec.structs.replace(event, equal_rooms_m=request.equal_rooms_m)
            await self._charge(
                sum(len(keyframe.data) + _EVENT_OVERHEAD_BYTES for keyframe in event.keyframes)
            )
            await asyncio.shield(self._writer.submit(event))
        return {"keyframes": self._state.keyframes, "version": self._state.position}

    def _show(self, robot: RobotId, with_paths: bool) -> dict[str, Any]:
        """Return the reply of ``live-show`` for *robot*; called in the thread of the map."""
        reply = show_reply(
            robot,
            self._state,
            self._lease.record,
            service_state=self._service_state(),
            name_of=self.name_of,
            is_present=self._present_robots.__contains__,
        )
        paths = {"paths": paths_reply(self._state, self.name_of)} if with_paths else {}
        return {**reply, "images": self._environment.settings.images, **paths}
