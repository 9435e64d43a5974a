"""The robot's side of the platform: `connect`, then call services and get typed answers.

Every command ends with exactly one answer or one typed error, within its deadline.
"""

from __future__ import annotations

import asyncio
import os
import random as random_module
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from client_sdk.commands.answer_types import Answer, PoseAnswer
from client_sdk.commands.subscriptions import RobotSubscriptions, Updates
from client_sdk.commands.traffic_stats import Stats, StatsKeeper
from client_sdk.concurrency.event_loop_thread import not_connected_here
from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.enrolment import read_enrolment
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.connection import Connection, ForRobot, OnChange
from client_sdk.network.dial_errors import DialError
from client_sdk.network.handshake import Token
from client_sdk.offloading.burst_client import Burst
from client_sdk.offloading.burst_policy import check_burst_url
from client_sdk.offloading.command_router import Asking, Call, OnProgress
from client_sdk.offloading.local_services import LocalServices
from client_sdk.offloading.offload_policy import CloudFirst
from client_sdk.recording import make_recorder, sdk_version
from client_sdk.transfer.small_objects import RobotObjects
from rse_pf.config import SessionSettings
from rse_pf.errors import Disconnected, RsePfError, UsageError, error_from_code
from rse_pf.wire import CODECS, Failure, Welcome, as_type, make_codec
from rse_pf.wire.client_session import Answered, ClientSession
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated
from rse_pf.wire.rate_limit import REASONS

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from client_sdk.frontend import Frame, FrontEndOptions
    from client_sdk.live.live_mapper import LiveMapper
    from client_sdk.live.options import LiveOptions
    from client_sdk.mapper import Mapper
    from client_sdk.monocular.scale import MarkerScale, OdometryScale
    from client_sdk.point_map import MapOptions
    from client_sdk.slots import FeaturesFunction, LoopsFunction, MotionFunction, OptimiserFunction
    from client_sdk.tracking.monocular_tracker import MonocularOptions
    from rse_pf.geometry import Camera
    from rse_pf.pnp import DepthNoise, PnpOptions

__all__ = ["MAX_DEADLINE_S", "OnProgress", "Robot", "connect"]


MAX_DEADLINE_S = 3600.0


class Robot:
    """A connected robot; make one with `connect`."""

    def __init__(
        self,
        url: str | Sequence[str] = "",
        *,
        token: Token = None,
        enrolment: str | Path | None = None,
        codec: str = "zlib",
        settings: SessionSettings | None = None,
        timings: ConnectTimings | None = None,
        offload: CloudFirst | None = None,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        random: random_module.Random | None = None,
        on_change: OnChange = None,
        record: str | Path | None = None,
        thumbnails: bool = False,
        burst_url: str | None = None,
    ) -> None:
        """Describe a robot to be used as ``async with connect(...) as robot``, or awaited.

        A first connect that is refused raises.  A robot that was connected once tries for ever, whatever the
        servers say; `failure` tells what they say.

        Args:
            url: ``ws://HOST:PORT/ws`` or ``wss://HOST/ws``; of several the robot uses the nearest,
                and keeps a connection to each of the others.
            token: The robot's token, or an async callable that gives one (a run outlives a token).
            enrolment: File of ``rse-pf robot enrol --out``, instead of *url* and *token*; with a list of
                addresses, these count and not the one of the file.
            codec: ``zlib`` (the paper's), ``json`` or ``bin``.
            settings: Limits and timeouts of the platform; None means the defaults.
            timings: How patient the robot is when it connects; None means the defaults.
            offload: `CloudFirst` lets the robot answer itself when the cloud cannot.
            clock: Seconds, monotonic.
            wall_clock: Unix seconds: the clock by which *token* signs.
            random: Source of the jitter of reconnects.
            on_change: Called with ``link-lost``, ``refused``, ``link-back``, ``moved`` or ``stands-by``,
                and the reason or the server.  `Stats.callback_errors` counts what it raises.
            record: Folder for a recording of what this robot says and hears, for rse-pf replay.
            thumbnails: Whether small pictures of the frames of its `mapper` are recorded, too.
            burst_url: ``https://HOST/burst``, a function that answers while no server can, also before the
                first connection; None takes the one that the servers name, and "" none.

        Raises:
            UsageError: The address or the codec cannot be used, or there are an address and an enrolment.
        """
        urls = [url] if isinstance(url, str) else list(url)
        is_list = not isinstance(url, str)
        if not (urls != [""] if enrolment is None else (is_list or not url) and token is None):
            raise UsageError(
                "connect needs either an address or an enrolment",
                hint="connect(url, token=...), connect([url, url], token=...) or connect(enrolment=FILE)",
            )
        if codec not in CODECS:
            raise UsageError(f"no codec named {codec!r}", hint=f"choose one of {', '.join(CODECS)}")
        settings, random = settings or SessionSettings(), random or random_module.Random()
        self._session = ClientSession(
            codec=make_codec(codec, settings), settings=settings, sdk=f"rse-pf-python/{sdk_version()}"
        )
        self._recorder = make_recorder(record, thumbnails, settings)
        self.callbacks = Callbacks(settings.ping_timeout_s)
        self._connection = Connection(
            urls,
            token=token,
            session=self._session,
            timings=timings or ConnectTimings(),
            on_answer=self._take_answer,
            clock=clock,
            random=random,
            wall_clock=wall_clock,
            on_change=on_change,
            callbacks=self.callbacks,
            recorder=self._recorder,
        )
        self._urls, self._enrolment = urls, enrolment
        self._offload = offload
        self._clock = clock
        self._local = None if offload is None else LocalServices(offload.registry, clock)
        self._subscriptions = RobotSubscriptions(self._session, self._connection.flush, clock)
        self._keeper = StatsKeeper(random)
        self._burst = Burst(
            codec=self._session.codec, read_token=self._read_token, clock=clock, random=random,
            own=lambda: (self._connection.url, self._connection.dialler.ssl_context),
            max_answer_bytes=settings.max_message_bytes, url=check_burst_url(burst_url, urls[0]),
        )  # fmt: skip
        self._asking = Asking(
            session=self._session, flush=self._connection.flush, keeper=self._keeper, clock=clock,
            offload=offload, local=self._local, burst=self._burst, callbacks=self.callbacks,
        )  # fmt: skip
        self._objects = RobotObjects(
            self._read_token, lambda: (self._connection.url, self._connection.dialler.ssl_context)
        )
        self._open = False
        self._process = os.getpid()

    async def __aenter__(self) -> Robot:
        """Connect; with an offload or a *burst_url*, return also while no server answers.

        Raises:
            Unauthorized: The token is missing, wrong or expired.
            ConnectError: No server answers, and nobody stands in for one.
            MissingExtra: There is an offload, and no solver for it.
            UsageError: The file of the enrolment cannot be used.
        """
        try:
            if self._recorder is not None:
                self._recorder.start()
            if self._enrolment is not None:
                access = read_enrolment(self._enrolment)
                urls = self._urls if self._urls != [""] else [access.url]
                self._connection.use(urls, access.token, access.ssl_context)
            if self._local is not None:
                await self._local.prepare()
            await self._connection.open(
                may_be_down=self._offload is not None or self._burst.address is not None
            )
            self._asking.hear_welcome()
        except BaseException:
            await self.close()
            raise
        self._open, self._process = True, os.getpid()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connection; unanswered commands end with Disconnected."""
        await self.close()

    def __await__(self) -> Generator[Any, None, Robot]:
        return self.__aenter__().__await__()

    async def close(self) -> None:
        """Close the connection; unanswered commands end with Disconnected.

        In a child of a fork nothing happens: the connection belongs to the parent.
        """
        if os.getpid() != self._process:
            return
        self._open = False
        for event in self._session.abandon("disconnected", "the robot closed its connection"):
            if isinstance(event, Answered | SubscriptionEnded):
                self._take_answer(event)
        await self._connection.close()
        await self._asking.close()
        self._objects.close()
        if self._local is not None:
            self._local.close()
        if self._recorder is not None:
            await asyncio.to_thread(self._recorder.stop)

    async def solve_pnp(
        self,
        points_world: npt.NDArray[np.float64],
        pixels: npt.NDArray[np.float64],
        camera: Camera,
        options: PnpOptions | None = None,
        *,
        depths_m: npt.NDArray[np.float64] | None = None,
        depth_noise: DepthNoise | None = None,
        deadline_s: float | None = None,
        stream: str = "pose",
        keep: bool = False,
    ) -> PoseAnswer:
        """Estimate the camera pose of one frame in the cloud.

        Args:
            points_world: ``(n, 3)``, metres, world frame.
            pixels: ``(n, 2)``, undistorted pixels of the same points.
            camera: Intrinsics of the image.
            options: RANSAC settings; None means the server's.
            depths_m: ``(n,)``, metres, what a depth camera measured at the pixels, 0 where there is none; the
                pose is refined with it.  The world frame is then that of the camera that measured the points.
            depth_noise: Of both depth cameras; None means a Kinect's.
            deadline_s: Seconds within which the answer is needed.
            stream: Within a stream the newest frame wins, and older answers are dropped.
            keep: Answer this frame even if newer ones follow.

        Raises:
            PnpError: The correspondences give no pose.
            CommandFailed: The typed failure of the command, such as Busy, Stale or Expired.
        """
        from rse_pf.services.pnp import PnpReply, make_request

        request = make_request(
            points_world, pixels, camera, options, depths_m=depths_m, depth_noise=depth_noise,
            binary=self._session.codec.name == "bin",
        )  # fmt: skip
        answer = await self.call("pnp", request, PnpReply, deadline_s=deadline_s, stream=stream, keep=keep)
        return PoseAnswer.of(answer, answer.reply.solution())

    async def call(
        self,
        service: str,
        request: Any,
        reply_type: type[Any] | None = None,
        *,
        deadline_s: float | None = None,
        stream: str = "",
        keep: bool = False,
        on_progress: OnProgress | None = None,
    ) -> Answer:
        """Call *service* and wait for the reply; any number of calls may run concurrently.

        A long service (``merge``, ``optimise``) runs as a job: it has no deadline but *deadline_s*, survives
        reconnects and the death of its server, and ends when the call is cancelled or its deadline passes.

        Args:
            service: Its name, such as ``pnp``.
            request: A `msgspec.Struct`, or plain lists and dicts.
            reply_type: Type of the reply; None leaves it plain.
            deadline_s: Seconds within which the answer is needed; None means ``session.answer_timeout_s``,
                or no deadline for a long service.
            stream: Within a stream the newest command wins; empty means no stream.
            keep: Answer this one even if newer ones follow.
            on_progress: Called with the progress of a long service; with it the default deadline is none.

        Raises:
            RsePfError: The typed failure of the command.
        """
        self._check_open()
        wait_s = self._session.settings.answer_timeout_s if deadline_s is None else deadline_s
        if not 0 < wait_s <= MAX_DEADLINE_S:
            raise UsageError(
                f"deadline_s = {wait_s} is not within 0..{MAX_DEADLINE_S:g}",
                hint="give the number of seconds that the call may take",
            )
        self._keeper.sent += 1
        call = Call(
            service=service,
            request=request,
            deadline_s=wait_s,
            stream=stream,
            keep=keep,
            is_open_ended=deadline_s is None,
            on_progress=on_progress,
        )
        started = self._clock()
        try:
            refusal = self._connection.refusal
            if refusal is not None and not (self._local is not None and self._local.offers(service)):
                raise error_from_code(refusal.code, refusal.message, hint=refusal.hint)
            return self._type_reply(await self._asking.ask(call), reply_type, started)
        except RsePfError as error:
            self._keeper.failures[error.code] += 1
            raise

    def mapper(
        self,
        *,
        deadline_s: float | None = None,
        camera: Camera | None = None,
        options: FrontEndOptions | None = None,
        monocular: MonocularOptions | None = None,
        depth: bool | None = None,
        scale: OdometryScale | MarkerScale | None = None,
        map_options: MapOptions | None = None,
        T_world_start: npt.NDArray[np.float64] | None = None,
        keyframes_of: str = "",
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> Mapper:
        """Return a `Mapper` that asks this robot for its poses, within *deadline_s* each.

        The other arguments are those of `Mapper`; *options* are bounded for the codec of this robot.
        """
        from client_sdk.frontend import FrontEndOptions
        from client_sdk.mapper import Mapper, ask_robot

        bounded = (options or FrontEndOptions()).sent_with(self._session.codec.name)
        return Mapper(
            ask=ask_robot(self.solve_pnp, deadline_s), camera=camera, options=bounded, monocular=monocular,
            depth=depth, scale=scale, map_options=map_options, T_world_start=T_world_start,
            keyframes_of=keyframes_of, recorder=self._recorder, features=features,
            motion=motion, loops=loops, optimiser=optimiser,
        )  # fmt: skip

    def live_map(
        self,
        name: str,
        *,
        deadline_s: float | None = None,
        camera: Camera | None = None,
        depth: bool | None = None,
        spool: str | Path | None = None,
        options: FrontEndOptions | None = None,
        live: LiveOptions | None = None,
        map_options: MapOptions | None = None,
        T_world_start: npt.NDArray[np.float64] | None = None,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
    ) -> LiveMapper:
        """Return a `LiveMapper` for ``async with robot.live_map(name) as mapper``.

        It asks this robot for its poses, within *deadline_s* each, and shares the map *name* with all robots
        of the tenant that do the same.  The other arguments are those of `LiveMapper`.
        """
        from client_sdk.frontend import FrontEndOptions
        from client_sdk.live.live_mapper import LiveMapper
        from client_sdk.live.options import LiveOptions
        from client_sdk.mapper import ask_robot

        codec = self._session.codec.name
        bounded = (options or FrontEndOptions.live()).sent_with(codec)
        return LiveMapper(
            self, name, ask=ask_robot(self.solve_pnp, deadline_s), camera=camera, depth=depth,
            options=bounded,
            live=(live or LiveOptions()).sent_with(codec),
            spool=None if spool is None else Path(spool), map_options=map_options,
            T_world_start=T_world_start, features=features, motion=motion, loops=loops,
            store=self.store_object, clock=self._clock,
        )  # fmt: skip

    async def store_object(self, data: bytes) -> str:
        """Store *data*, at most 256 KiB, as an object of this robot by the data service; return its digest.

        `DataClient` stores larger ones, and repeats what fails.

        Raises:
            ConnectError: The platform has no data service, or it does not answer.
            StoreFull, QuotaExceeded, LimitExceeded, Unauthorized, Forbidden: It refuses the object.
        """
        return await self._objects.store(data)

    def record_frame(self, frame: Frame, T_odom_camera: npt.NDArray[np.float64] | None = None) -> None:
        """Record a thumbnail of *frame*, if allowed, and its pose ``(4, 4)`` by odometry, if there is one.

        A `mapper` of this robot does the first by itself.  Without ``record`` nothing happens.
        """
        if self._recorder is not None:
            self._recorder.frame(frame.timestamp_s, frame.rgb, T_odom_camera)

    @property
    def connected(self) -> bool:
        """Whether there is a connection to a server now; without one, commands wait for the next."""
        return self._session.current is not None

    @property
    def welcome(self) -> Welcome | None:
        """What the present server says of this robot: name, tenant, scopes, limits; None without a server."""
        return None if self._session.current is None else self._session.current.welcome

    @property
    def failure(self) -> RsePfError | None:
        """Why the servers refuse this robot now, such as `Unauthorized`; None while they do not.

        Until it is connected again every command raises this error at once, unless the robot can answer it
        itself.  It goes on trying: nothing that a server says ends a robot.
        """
        return self._connection.refusal

    def post(
        self,
        service: str,
        request: Any,
        on_end: Callable[[Answered], None],
        *,
        deadline_s: float | None = None,
        stream: str = "",
        keep: bool = False,
    ) -> int:
        """Send a command without waiting and return its id; *on_end* is called once with its end.

        Meant for load generators: no task, no future, no statistics, and *request* may be a
        `PreencodedCommand`.  As with `call`, a command waits while the connection is lost; it is never
        answered by the robot itself.

        Raises:
            Disconnected: The robot is not open, or its servers refuse it.
            LimitExceeded: The message would be larger than the limit.
        """
        self._check_open(is_refused=self._connection.refusal is not None)
        identity = self._session.submit(
            service, request, now=self._clock(), deadline_s=deadline_s, stream=stream, keep=keep
        )
        self._asking.waiting[identity] = on_end
        self._connection.flush()
        return identity

    def subscribe(self, topic: str) -> Updates:
        """Ask for the updates of *topic*, such as ``live/MAP``; call it in the robot's event loop.

        ``async for key, value in robot.subscribe(topic)`` gets the present values first, and then each newer
        one.  The subscription survives reconnects and moves.

        Raises:
            Disconnected: The robot is not open.
        """
        self._check_open()
        return self._subscriptions.begin(topic)

    @property
    def stats(self) -> Stats:
        """A snapshot of the robot's traffic."""
        keeper, session, connection = self._keeper, self._session, self._connection
        current = session.current
        clock = current.clock_offset if current else None
        last = current.last_exchange if current else None
        delays = clock.delays_s(last) if clock is not None and last is not None else None
        return Stats(
            sent=keeper.sent,
            answered=keeper.answered,
            failed=sum(keeper.failures.values()),
            sent_to_burst=self._burst.rules.spent,
            answered_by_burst=keeper.answered_by_burst,
            answered_by_robot=keeper.answered_by_robot,
            failures_by_code=dict(keeper.failures),
            unanswered=session.unanswered,
            resent=session.resent,
            dropped_answers=session.dropped_answers,
            held_back={reason: session.held_back[reason] for reason in REASONS},
            duplicates=keeper.duplicates,
            reconnects=connection.reconnects,
            moves=connection.moves,
            region_changes=connection.region_changes,
            bytes_out=connection.bytes_out,
            bytes_in=connection.bytes_in,
            payload_bytes_median=keeper.percentile("payload_bytes", 0.5),
            payload_bytes_max=keeper.payload_bytes_max,
            round_trip_ms=keeper.percentiles("round_trip_ms"),
            up_ms=keeper.percentiles("up_ms"),
            queue_ms=keeper.percentiles("queue_ms"),
            compute_ms=keeper.percentiles("compute_ms"),
            down_ms=keeper.percentiles("down_ms"),
            clock_offset_s=clock.offset_s if clock else None,
            clock_uncertainty_s=clock.uncertainty_s if clock else None,
            delay_up_s=delays[0] if delays else None,
            delay_down_s=delays[1] if delays else None,
            server=current.server if current else "",
            region=connection.region if current else "",
            last_error=connection.last_error,
            callback_errors=self.callbacks.errors,
        )

    def _check_open(self, *, is_refused: bool = False) -> None:
        if not self._open or is_refused:
            raise Disconnected("the robot is not connected", hint="use async with client_sdk.connect(...)")
        if os.getpid() != self._process:
            raise not_connected_here(self._process)

    def _type_reply(self, answer: Answer | Failure, reply_type: type[Any] | None, started: float) -> Answer:
        """Return the answer with its reply typed and the caller's round trip; raise if it is a failure."""
        if isinstance(answer, Failure):
            raise error_from_code(
                answer.code, answer.message, hint=answer.hint, retry_after_ms=answer.retry_after_ms
            )
        is_stored = answer.reply is None and answer.object != ""
        reply = answer.reply if reply_type is None or is_stored else as_type(answer.reply, reply_type)
        answer = replace(answer, reply=reply, round_trip_ms=(self._clock() - started) * 1e3)
        keeper = self._keeper
        keeper.answered += 1
        keeper.answered_by_burst += answer.source == "burst"
        keeper.answered_by_robot += answer.source == "robot"
        if answer.source == "cloud":
            keeper.add_payload(answer.payload_bytes)
            for name in ("round_trip_ms", "up_ms", "queue_ms", "compute_ms", "down_ms"):
                keeper.add(name, getattr(answer, name))
        return answer

    async def _read_token(self) -> str | None:
        try:
            return await self._connection.dialler.read_token()
        except DialError as failed:
            raise failed.error from None

    def _take_answer(self, event: ForRobot) -> None:
        if isinstance(event, Updated | SubscriptionEnded):
            self._subscriptions.take(event)
            return
        self._asking.answered(event)


connect = Robot
"""Return a robot for ``async with connect(url, token=...) as robot``; its arguments are those of `Robot`."""
