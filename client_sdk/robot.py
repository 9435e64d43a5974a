"""Connect a robot to its platform, call services, and receive typed answers; the main module of the SDK.

Every command ends with exactly one answer or one typed error, within its deadline.
"""

from __future__ import annotations

import asyncio
import os
import random as random_module
import ssl
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from client_sdk.commands.answer_types import Answer, PoseAnswer
from client_sdk.commands.subscriptions import RobotSubscriptions, Updates
from client_sdk.commands.traffic_stats import Stats, TrafficCounter
from client_sdk.concurrency.event_loop_thread import wrong_process_error
from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.enrolment import read_enrolment
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.connection import Connection, OnChange, RobotEvent
from client_sdk.network.dial_errors import DialError
from client_sdk.network.handshake import Token
from client_sdk.offloading.burst_client import BurstClient
from client_sdk.offloading.burst_policy import check_burst_url
from client_sdk.offloading.command_router import CallArguments, CommandRouter, OnProgress
from client_sdk.offloading.local_services import LocalServices
from client_sdk.offloading.offload_policy import CloudFirst
from client_sdk.recording import RobotRecorder, make_robot_recorder
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.config import SessionSettings
from rse_pf.errors import Disconnected, RsePfError, Unauthorized, UsageError, error_from_code
from rse_pf.version import installed_version
from rse_pf.wire import CODECS, Failure, Welcome, as_type, make_codec
from rse_pf.wire.client_session import Answered, ClientSession
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated
from rse_pf.wire.rate_limit import REASONS

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from client_sdk.frontend import Frame, FrontEndOptions, MonocularOptions
    from client_sdk.live.live_mapper import LiveMapper
    from client_sdk.live.options import LiveOptions
    from client_sdk.mapper import Mapper
    from client_sdk.monocular.scale import MarkerScale, OdometryScale
    from client_sdk.plugins import FeaturesFunction, LoopsFunction, MotionFunction, OptimiserFunction
    from client_sdk.point_map import MapOptions
    from rse_pf.geometry import Camera
    from rse_pf.pnp import DepthNoise, PnpOptions

__all__ = ["MAX_DEADLINE_S", "OnProgress", "Robot", "connect"]

MAX_DEADLINE_S = 3600.0
"""Longest deadline of a command in seconds, since messages of the protocol carry no longer one; a call with a
longer one raises a UsageError."""

STORE_TIMEOUT_S = 5.0
"""Longest time for which a request of `Robot.store_object` waits for the next bytes of its answer, in
seconds.  A request that fails is not repeated here, but by the caller."""


class Robot:
    """One robot: its connections, its commands, and its mappers; make one with `connect`."""

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
        record: str | Path | RobotRecorder | None = None,
        thumbnails: bool = False,
        burst_url: str | None = None,
    ) -> None:
        """Describe a robot; ``async with connect(...) as robot``, or awaiting the robot, connects it.

        A first connect that is refused raises.  A robot that was connected once reconnects for ever, whatever
        the servers answer; `failure` holds their last refusal.

        Args:
            url: ``ws://HOST:PORT/ws`` or ``wss://HOST/ws``.  Of a list of addresses (regions) the robot uses
                the one with the shortest round trip, and keeps a connection to each of the others.
            token: The robot's token, or an async function that returns a valid one: a token is valid for
                minutes, and the function is called for each connection and each renewal.
            enrolment: File of ``rse-pf robot enrol --out``, instead of *url* and *token*.  A list of
                addresses in *url* replaces the address in the file.
            codec: Format of messages: ``json``, ``zlib`` (JSON compressed by zlib) or ``bin`` (MessagePack).
            settings: Limits and timeouts of the platform; None means the defaults.
            timings: Timeouts and pauses of attempts to connect; None means the defaults.
            offload: `CloudFirst` lets the robot answer commands itself when the cloud cannot; None never
            does.
            clock: Monotonic seconds.
            wall_clock: Unix seconds; the clock by which *token* signs.
            random: Source of the jitter of reconnects.
            on_change: Function that is called with ``link-lost`` or ``refused`` and the reason, or with
                ``link-back``, ``moved`` or ``stands-by`` and the name of a server.  An exception of it is
                logged and counted in `Stats.callback_errors`.
            record: Folder for a recording of the robot's messages, for rse-pf replay; or a `RobotRecorder` of
                the program; None records nothing.
            thumbnails: Whether the recording in the folder has small pictures of the frames of the robot's
                `mapper`.
            burst_url: ``https://HOST/burst``, the function that answers while no server can, also before the
                first connection.  None takes the address that the servers name, and "" uses no function.

        Raises:
            UsageError: The address or the codec cannot be used, or *enrolment* is combined with *token* or
                with a single address; a list of addresses is allowed.
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
            codec=make_codec(codec, settings), settings=settings, sdk=f"rse-pf-python/{installed_version()}"
        )
        self.callbacks = UserCallbacks(settings.ping_timeout_s)
        self._recorder = make_robot_recorder(
            record,
            thumbnails=thumbnails,
            session=settings,
            version=installed_version(),
            callbacks=self.callbacks,
        )
        self._connection = Connection(
            urls,
            token=token,
            session=self._session,
            timings=timings or ConnectTimings(),
            on_event=self._handle_event,
            clock=clock,
            random=random,
            wall_clock=wall_clock,
            on_change=on_change,
            callbacks=self.callbacks,
            tap=self._recorder,
        )
        self._urls, self._enrolment = urls, enrolment
        self._offload = offload
        self._clock = clock
        self._local = None if offload is None else LocalServices(offload.registry, clock)
        self._subscriptions = RobotSubscriptions(self._session, self._connection.flush, clock)
        self._counter = TrafficCounter(random)
        self._burst = BurstClient(
            codec=self._session.codec,
            read_token=self._read_token,
            read_access=self._read_access,
            clock=clock,
            random=random,
            max_answer_bytes=settings.max_message_bytes,
            url=check_burst_url(burst_url, urls[0]),
        )
        self._router = CommandRouter(
            session=self._session,
            flush=self._connection.flush,
            counter=self._counter,
            clock=clock,
            policy=offload,
            local=self._local,
            burst=self._burst,
            callbacks=self.callbacks,
        )
        self._data_client: DataClient | None = None
        self._data_lock = asyncio.Lock()
        self._is_open = False
        self._process = os.getpid()

    async def __aenter__(self) -> Robot:
        """Connect and return this robot.

        With *offload* or a *burst_url* that is neither None nor empty, it returns also while no server
        answers.

        Raises:
            Unauthorized: The token is missing, wrong or expired.
            Forbidden: The servers forbid this robot to connect.
            UnsupportedProtocol: Robot and servers share no protocol.
            ConnectError: No server answers, and there is neither *offload* nor *burst_url*; or the address
                itself is wrong, such as that of another program.
            MissingExtra: There is *offload*, and no solver is installed.
            UsageError: The enrolment file cannot be used.
        """
        try:
            if self._recorder is not None:
                self._recorder.start()
            if self._enrolment is not None:
                access = read_enrolment(self._enrolment)
                urls = self._urls if self._urls != [""] else [access.url]
                self._connection.set_access(urls, access.token, access.ssl_context)
            if self._local is not None:
                await self._local.prepare()
            await self._connection.open(
                may_be_down=self._offload is not None or self._burst.address is not None
            )
            self._router.read_welcome()
        except BaseException:
            await self.close()
            raise
        self._is_open, self._process = True, os.getpid()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connections; unanswered commands end with Disconnected."""
        await self.close()

    def __await__(self) -> Generator[Any, None, Robot]:
        return self.__aenter__().__await__()

    async def close(self) -> None:
        """Close the connections; unanswered commands end with Disconnected.

        A forked child process does nothing: the connections belong to its parent.
        """
        if os.getpid() != self._process:
            return
        self._is_open = False
        for event in self._session.abandon("disconnected", "the robot closed its connection"):
            if isinstance(event, Answered | SubscriptionEnded):
                self._handle_event(event)
        await self._connection.close()
        await self._router.close()
        if self._data_client is not None:
            self._data_client.close()
        if self._local is not None:
            self._local.close()
        if self._recorder is not None:
            await self._recorder.stop()

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
        """Estimate the camera pose of one frame by PnP with RANSAC, where `call` has it computed.

        Args:
            points_world: ``(n, 3)``, metres, world frame.
            pixels: ``(n, 2)``, undistorted pixels of the same points.
            camera: Intrinsics of the image.
            options: Settings of RANSAC; None means those of the server.
            depths_m: ``(n,)``, metres, depths that a depth camera measured at the pixels, 0 where it measured
                none.  The pose is refined with them; *points_world* must then be in the frame of the camera
                that measured these points.
            depth_noise: Noise of the depths of the points and of *depths_m*; None means that of a Kinect.
            deadline_s: Seconds within which the answer is needed; None means ``session.answer_timeout_s``.
            stream: Name of the sequence of frames; a newer frame of a stream replaces an older one, whose
                command then ends with Stale.
            keep: Whether this frame is answered even if a newer frame of its stream is sent.

        Returns:
            The pose ``T_camera_world`` with covariance, inliers and verdict in ``solution``.

        Raises:
            PnpError: The correspondences give no pose.
            CommandFailed: The typed failure of the command, such as Busy, Stale or Expired.
        """
        from rse_pf.services.pnp import PnpReply, make_request

        request = make_request(
            points_world,
            pixels,
            camera,
            options,
            depths_m=depths_m,
            depth_noise=depth_noise,
            binary=self._session.codec.name == "bin",
        )
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

        A long service (``merge``, ``optimise``) runs as a job: it survives reconnects and crashes of its
        server, and is ended there when the call is cancelled or *deadline_s* has passed.  While no
        server can answer, the burst function of the platform does, or with *offload* the robot itself.

        Args:
            service: Name of the service, such as ``pnp``.
            request: A `msgspec.Struct`, or plain lists and dicts.
            reply_type: Type of the reply; None returns plain lists and dicts.
            deadline_s: Seconds within which the answer is needed; None means ``session.answer_timeout_s``,
                or no deadline for a long service.
            stream: Name of a sequence of commands, of which a newer one replaces an older one; empty means no
                stream.
            keep: Whether this command is answered although newer ones of its stream follow.
            on_progress: Called with the progress of a long service; with it there is no default deadline.

        Raises:
            RsePfError: The typed failure of the command.
        """
        self._check_open()
        wait_s = self._session.settings.answer_timeout_s if deadline_s is None else deadline_s
        if not 0 < wait_s <= MAX_DEADLINE_S:
            raise UsageError(
                f"deadline_s = {wait_s} is not between 0 and {MAX_DEADLINE_S:g}",
                hint="set deadline_s to the number of seconds that the call may take",
            )
        self._counter.sent += 1
        call = CallArguments(
            service=service,
            request=request,
            deadline_s=wait_s,
            stream=stream,
            keep=keep,
            is_open_ended=deadline_s is None,
            on_progress=on_progress,
        )
        began_s = self._clock()
        try:
            refusal = self._connection.refusal
            if refusal is not None and not (self._local is not None and self._local.offers(service)):
                raise error_from_code(refusal.code, refusal.message, hint=refusal.hint)
            return self._type_reply(await self._router.ask(call), reply_type, began_s)
        except RsePfError as error:
            self._counter.failures[error.code] += 1
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
        T_base_camera: npt.NDArray[np.float64] | None = None,
        planar: bool = False,
        keyframes_of: str = "",
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> Mapper:
        """Return a `Mapper` whose poses this robot requests from the cloud, each within *deadline_s* seconds.

        The other arguments are those of `Mapper`.  ``max_matches`` of *options* is lowered to what fits into
        a command of 10 kB in this robot's codec.
        """
        from client_sdk.frontend import FrontEndOptions
        from client_sdk.mapper import Mapper
        from client_sdk.pose_answers import ask_robot

        limited_options = (options or FrontEndOptions()).sent_with(self._session.codec.name)
        return Mapper(
            ask=ask_robot(self.solve_pnp, deadline_s),
            camera=camera,
            options=limited_options,
            monocular=monocular,
            depth=depth,
            scale=scale,
            map_options=map_options,
            T_world_start=T_world_start,
            T_base_camera=T_base_camera,
            planar=planar,
            keyframes_of=keyframes_of,
            recorder=self._recorder,
            features=features,
            motion=motion,
            loops=loops,
            optimiser=optimiser,
        )

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
        T_base_camera: npt.NDArray[np.float64] | None = None,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
    ) -> LiveMapper:
        """Return a `LiveMapper` for ``async with robot.live_map(name) as mapper``.

        This robot requests the poses of the mapper from the cloud, each within *deadline_s* seconds.  The map
        *name* is shared with all robots of the tenant that use the same name.  The other arguments are those
        of `LiveMapper`; ``max_matches`` of *options* and ``features`` of *live* are lowered to what this
        robot's codec carries.
        """
        from client_sdk.frontend import FrontEndOptions
        from client_sdk.live.live_mapper import LiveMapper
        from client_sdk.live.options import LiveOptions
        from client_sdk.pose_answers import ask_robot

        codec = self._session.codec.name
        limited_options = (options or FrontEndOptions.live()).sent_with(codec)
        return LiveMapper(
            self,
            name,
            ask=ask_robot(self.solve_pnp, deadline_s),
            camera=camera,
            depth=depth,
            options=limited_options,
            live=(live or LiveOptions()).sent_with(codec),
            spool=None if spool is None else Path(spool),
            map_options=map_options,
            T_world_start=T_world_start,
            T_base_camera=T_base_camera,
            features=features,
            motion=motion,
            loops=loops,
            store=self.store_object,
            clock=self._clock,
        )

    async def store_object(self, data: bytes) -> str:
        """Store *data* as an object of this robot, and return its sha256 once it is durable.

        One object is stored after the other.  `DataClient` does the same, and repeats requests that fail.

        Raises:
            ConnectError: The platform has no data service, or the service does not answer.
            StoreFull, QuotaExceeded, LimitExceeded, Unauthorized, Forbidden: The service refuses the object.
        """
        async with self._data_lock:
            token = await self._read_token()
            if token is None:
                raise Unauthorized("objects are stored with a token only", hint="enrol the robot")
            url, ssl_context = self._read_access()
            if self._data_client is None or self._data_client.url != url:
                options = DataOptions(timeout_s=STORE_TIMEOUT_S, deadline_s=0.0, ssl_context=ssl_context)
                self._data_client = DataClient(url, token, options)
            self._data_client.token = token
            return await asyncio.to_thread(self._data_client.upload, data)

    def record_frame(self, frame: Frame, T_odom_camera: npt.NDArray[np.float64] | None = None) -> None:
        """Add a thumbnail of *frame* and its pose by odometry to the recording.

        A `mapper` of this robot records thumbnails by itself.  Without ``record`` nothing happens, and
        without ``thumbnails`` no picture is recorded.

        Args:
            frame: Image and time.
            T_odom_camera: ``(4, 4)`` pose of the camera in the odometry frame, metres; None records no pose.
        """
        if self._recorder is not None:
            self._recorder.record_frame(frame.timestamp_s, frame.rgb, T_odom_camera)

    @property
    def connected(self) -> bool:
        """Whether a server is connected now; while none is, commands wait for the next connection."""
        return self._session.current is not None

    @property
    def welcome(self) -> Welcome | None:
        """The Welcome of the connected server: name, tenant, scopes and limits of the robot; or None."""
        return None if self._session.current is None else self._session.current.welcome

    @property
    def failure(self) -> RsePfError | None:
        """Why all servers refuse this robot now, such as `Unauthorized`; None while they do not.

        Until the robot is connected again, every command raises this error at once, unless the robot can
        answer the command itself.  The robot goes on reconnecting: no answer of a server ends it.
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
        """Send a command without waiting for it, and return its id; *on_end* gets its answer or failure once.

        This is for load generators: it makes no task, future or statistics, and *request* may be a
        `PreencodedCommand`.  As with `call`, a command waits while the connection is lost.  Neither the burst
        function nor the robot itself answers it.

        Raises:
            Disconnected: The robot is not open, or its servers refuse it.
            BadMessage: *request* cannot be encoded.
            LimitExceeded: The message would be larger than the limit.
        """
        self._check_open(is_refused=self._connection.refusal is not None)
        identity = self._session.submit(
            service, request, now=self._clock(), deadline_s=deadline_s, stream=stream, keep=keep
        )
        self._router.waiting[identity] = on_end
        self._connection.flush()
        return identity

    def subscribe(self, topic: str) -> Updates:
        """Subscribe to *topic*, such as ``live/MAP``; call this in the robot's event loop.

        ``async for key, value in robot.subscribe(topic)`` receives the present value of each key first, and
        newer values later.  The subscription survives reconnects and changes of the server.

        Raises:
            Disconnected: The robot is not open.
        """
        self._check_open()
        return self._subscriptions.subscribe(topic)

    @property
    def stats(self) -> Stats:
        """A snapshot of the counters and times of this robot's commands and connections."""
        counter, session, connection = self._counter, self._session, self._connection
        current = session.current
        clock = current.clock_offset if current else None
        return Stats(
            sent=counter.sent,
            answered=counter.answered,
            failed=sum(counter.failures.values()),
            sent_to_burst=self._burst.policy.spent,
            answered_by_burst=counter.answered_by_burst,
            answered_by_robot=counter.answered_by_robot,
            failures_by_code=dict(counter.failures),
            unanswered=session.unanswered,
            resent=session.resent,
            dropped_answers=session.dropped_answers,
            held_back={reason: session.held_back[reason] for reason in REASONS},
            duplicates=counter.duplicates,
            reconnects=connection.reconnects,
            moves=connection.moves,
            region_changes=connection.region_changes,
            bytes_out=connection.bytes_out,
            bytes_in=connection.bytes_in,
            payload_bytes_median=counter.percentile("payload_bytes", 0.5),
            payload_bytes_max=counter.payload_bytes_max,
            round_trip_ms=counter.percentiles("round_trip_ms"),
            up_ms=counter.percentiles("up_ms"),
            queue_ms=counter.percentiles("queue_ms"),
            compute_ms=counter.percentiles("compute_ms"),
            down_ms=counter.percentiles("down_ms"),
            clock_offset_s=clock.offset_s if clock else None,
            server=current.server if current else "",
            region=connection.region if current else "",
            last_error=connection.last_error,
            callback_errors=self.callbacks.errors,
        )

    def _check_open(self, *, is_refused: bool = False) -> None:
        if not self._is_open or is_refused:
            raise Disconnected("the robot is not connected", hint="use async with client_sdk.connect(...)")
        if os.getpid() != self._process:
            raise wrong_process_error(self._process)

    def _type_reply(self, answer: Answer | Failure, reply_type: type[Any] | None, began_s: float) -> Answer:
        """Return *answer* with a reply of *reply_type* and the caller's round trip, and count it.

        A failure is raised as its typed error.  *began_s* is when the call began.
        """
        if isinstance(answer, Failure):
            raise error_from_code(
                answer.code, answer.message, hint=answer.hint, retry_after_ms=answer.retry_after_ms
            )
        is_stored = answer.reply is None and answer.object != ""
        reply = answer.reply if reply_type is None or is_stored else as_type(answer.reply, reply_type)
        answer = replace(answer, reply=reply, round_trip_ms=(self._clock() - began_s) * 1e3)
        counter = self._counter
        counter.answered += 1
        counter.answered_by_burst += answer.source == "burst"
        counter.answered_by_robot += answer.source == "robot"
        if answer.source == "cloud":
            counter.add_payload(answer.payload_bytes)
            for name in ("round_trip_ms", "up_ms", "queue_ms", "compute_ms", "down_ms"):
                counter.add(name, getattr(answer, name))
        return answer

    async def _read_token(self) -> str | None:
        try:
            return await self._connection.dialler.read_token()
        except DialError as failed:
            raise failed.error from None

    def _read_access(self) -> tuple[str, ssl.SSLContext | None]:
        """Return the WebSocket address of the servers, and the TLS context for it (None: the default)."""
        return self._connection.url, self._connection.dialler.ssl_context

    def _handle_event(self, event: RobotEvent) -> None:
        if isinstance(event, Updated | SubscriptionEnded):
            self._subscriptions.handle_event(event)
            return
        self._router.handle_event(event)


connect = Robot
"""Another name of `Robot`, for ``async with connect(url, token=...) as robot``, which connects."""
