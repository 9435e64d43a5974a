"""The robot's side of the platform: `connect`, then ask services and get typed answers.

Promises that every command ends in exactly one answer or one typed error, within its deadline.
"""

from __future__ import annotations

import asyncio
import random as random_module
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from importlib import metadata
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from client_sdk.connection import Connection, Token
from client_sdk.offload import CloudFirst
from client_sdk.stats import Stats, StatsKeeper
from rse_pf.errors import Disconnected, RsePfError, UsageError, error_from_code
from rse_pf.service import Registry, dispatch
from rse_pf.settings import SessionSettings
from rse_pf.wire import CODECS, Command, Failure, FromServer, Result, as_type, make_codec
from rse_pf.wire.robot_session import Answered, RobotSession

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from rse_pf.geometry import Camera
    from rse_pf.pnp import PnpOptions, PnpSolution

__all__ = ["Answer", "PoseAnswer", "Robot", "connect"]

Source = Literal["cloud", "robot"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """A reply and how it came: who answered, and where the time went (ms; None if unknown).

    ``why`` says, if *source* is ``robot``, why the cloud did not answer.
    """

    reply: Any
    source: Source
    server: str
    round_trip_ms: float
    queue_ms: float
    compute_ms: float
    up_ms: float | None = None
    down_ms: float | None = None
    payload_bytes: int = 0
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseAnswer:
    """A pose with its evidence, and how it came; the fields are those of `Answer`."""

    solution: PnpSolution
    source: Source
    server: str
    round_trip_ms: float
    queue_ms: float
    compute_ms: float
    up_ms: float | None = None
    down_ms: float | None = None
    payload_bytes: int = 0
    why: str = ""


def connect(
    url: str,
    *,
    token: Token = None,
    codec: str = "zlib",
    settings: SessionSettings | None = None,
    offload: CloudFirst | None = None,
    clock: Callable[[], float] = time.monotonic,
    random: random_module.Random | None = None,
) -> Robot:
    """Return a robot to be used as ``async with connect(...) as robot``, or awaited.

    Args:
        url: ``ws://HOST:PORT/ws`` or ``wss://HOST/ws``.
        token: The robot's token, or an async callable that gives one (a run outlives a token).
        codec: ``zlib`` (the paper's), ``json`` or ``bin``.
        settings: Limits and patience; None means the defaults.
        offload: `CloudFirst` lets the robot answer itself when the cloud cannot.
        clock: Seconds, monotonic.
        random: Jitter of the reconnects.

    Raises:
        UsageError: The address or the codec cannot be used.
    """
    return Robot(
        url,
        token=token,
        codec=codec,
        settings=settings or SessionSettings(),
        offload=offload,
        clock=clock,
        random=random or random_module.Random(),
    )


class Robot:
    """A connected robot; make one with `connect`."""

    def __init__(
        self,
        url: str,
        *,
        token: Token,
        codec: str,
        settings: SessionSettings,
        offload: CloudFirst | None,
        clock: Callable[[], float],
        random: random_module.Random,
    ) -> None:
        if codec not in CODECS:
            raise UsageError(f"no codec named {codec!r}", hint=f"choose one of {', '.join(CODECS)}")
        self._session = RobotSession(
            codec=make_codec(codec, settings), settings=settings, sdk=f"rse-pf-python/{_version()}"
        )
        self._connection = Connection(
            url, token=token, session=self._session, on_answer=self._answered, clock=clock, random=random
        )
        self._settings = settings
        self._offload = offload
        self._clock = clock
        self._registry: Registry | None = None
        self._waiting: dict[int, asyncio.Future[Answered]] = {}
        self._keeper = StatsKeeper()
        self._open = False

    async def __aenter__(self) -> Robot:
        """Connect; raises Unauthorized or ConnectError."""
        try:
            await self._connection.open()
        except BaseException:
            await self._connection.close()
            raise
        self._open = True
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the connection; commands that wait end with Disconnected."""
        await self.close()

    def __await__(self) -> Generator[Any, None, Robot]:
        return self.__aenter__().__await__()

    async def close(self) -> None:
        """Close the connection; commands that wait end with Disconnected."""
        self._open = False
        for event in self._session.abandon("disconnected", "the robot closed its connection"):
            if isinstance(event, Answered):
                self._answered(event)
        await self._connection.close()

    async def solve_pnp(
        self,
        points_world: npt.NDArray[np.float64],
        pixels: npt.NDArray[np.float64],
        camera: Camera,
        options: PnpOptions | None = None,
        *,
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
            deadline_s: Seconds until the answer is of no use.
            stream: Within a stream the newest frame wins and older answers are dropped.
            keep: Answer this frame even if newer ones follow.

        Raises:
            PnpError: The correspondences give no pose.
            CommandFailed: Busy, stale, expired or worse, typed.
        """
        from rse_pf.services.pnp import PnpReply, make_request

        request = make_request(
            points_world, pixels, camera, options, binary=self._session.codec.name == "bin"
        )
        got = await self.call("pnp", request, PnpReply, deadline_s=deadline_s, stream=stream, keep=keep)
        return PoseAnswer(
            solution=got.reply.solution(),
            source=got.source,
            server=got.server,
            round_trip_ms=got.round_trip_ms,
            queue_ms=got.queue_ms,
            compute_ms=got.compute_ms,
            up_ms=got.up_ms,
            down_ms=got.down_ms,
            payload_bytes=got.payload_bytes,
            why=got.why,
        )

    async def call(
        self,
        service: str,
        request: Any,
        reply_type: type[Any] | None = None,
        *,
        deadline_s: float | None = None,
        stream: str = "",
        keep: bool = False,
    ) -> Answer:
        """Ask *service*; many calls may wait at the same time.

        Args:
            service: Its name, such as ``pnp``.
            request: A `msgspec.Struct`, or plain lists and dicts.
            reply_type: Type of the reply; None leaves it plain.
            deadline_s: Seconds until the answer is of no use; None means the setting.
            stream: Within a stream the newest command wins; empty means no stream.
            keep: Answer this one even if newer ones follow.

        Raises:
            RsePfError: The typed failure of the command.
        """
        if not self._open:
            raise Disconnected("the robot is not connected", hint="use async with client_sdk.connect(...)")
        if self._connection.fatal is not None:
            raise self._connection.fatal
        wait_s = self._settings.answer_timeout_s if deadline_s is None else deadline_s
        if not wait_s > 0:
            raise UsageError(f"deadline_s = {wait_s} is not above 0", hint="give the seconds it may take")
        self._keeper.sent += 1
        started = self._clock()
        if self._offload is None:
            answer = await self._ask_cloud(service, request, wait_s, stream, keep)
        else:
            answer = await self._ask_both(self._offload, service, request, wait_s, stream, keep)
        return self._typed(answer, reply_type, started)

    @property
    def stats(self) -> Stats:
        """A snapshot of the robot's traffic."""
        keeper, session, connection = self._keeper, self._session, self._connection
        link = session.current
        clock = link.clock_offset if link else None
        last = link.last_exchange if link else None
        delays = clock.delays_s(last) if clock is not None and last is not None else None
        return Stats(
            sent=keeper.sent,
            answered=keeper.answered,
            failed=sum(keeper.failures.values()),
            answered_by_robot=keeper.answered_by_robot,
            failures_by_code=dict(keeper.failures),
            unanswered=session.unanswered,
            resent=session.resent,
            dropped_answers=session.dropped_answers,
            reconnects=connection.reconnects,
            moves=connection.moves,
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
            server=link.server if link else "",
            last_error=connection.last_error,
        )

    async def _ask_cloud(
        self, service: str, request: Any, wait_s: float, stream: str, keep: bool
    ) -> Answer | Failure:
        now = self._clock()
        identity = self._session.submit(
            service, request, now=now, deadline_s=wait_s, stream=stream, keep=keep
        )
        future: asyncio.Future[Answered] = asyncio.get_running_loop().create_future()
        self._waiting[identity] = future
        self._connection.flush()
        try:
            ended = await future
        finally:
            self._waiting.pop(identity, None)
            self._session.cancel(identity)
        if isinstance(ended.answer, Failure):
            return ended.answer
        return self._from_cloud(ended, ended.answer)

    async def _ask_both(
        self, offload: CloudFirst, service: str, request: Any, wait_s: float, stream: str, keep: bool
    ) -> Answer | Failure:
        """Ask the cloud, and after the planned time the robot's own solver; the first answer wins."""
        p95_ms, mine_ms = (self._keeper.percentile(name, 0.95) for name in ("round_trip_ms", "robot_ms"))
        plan = offload.plan(
            deadline_s=wait_s,
            connected=self._session.current is not None,
            expected_round_trip_s=None if p95_ms is None else p95_ms / 1e3,
            robot_solve_s=None if mine_ms is None else mine_ms / 1e3,
        )
        if plan.where == "robot" or plan.robot_after_s is None:
            return await self._ask_robot(offload, service, request, plan.why)
        cloud = asyncio.create_task(self._ask_cloud(service, request, wait_s, stream, keep))
        try:
            done, _ = await asyncio.wait({cloud}, timeout=plan.robot_after_s)
            if done and not self._is_cloud_trouble(cloud.result()):
                return cloud.result()
            why = plan.why
            if done:
                why = f"the cloud answered {getattr(cloud.result(), 'code', '')}"
            return await self._ask_robot(offload, service, request, why)
        finally:
            cloud.cancel()
            await asyncio.gather(cloud, return_exceptions=True)

    async def _ask_robot(self, offload: CloudFirst, service: str, request: Any, why: str) -> Answer | Failure:
        if self._registry is None:
            self._registry = offload.registry or _own_services()
        codec, registry = self._session.codec, self._registry
        command = Command(id=0, service=service, payload=request)

        def work() -> FromServer:
            """The same bytes and the same dispatch as on a server."""
            same = codec.decode_from_robot(codec.encode(command))
            assert isinstance(same, Command)
            return codec.decode_from_server(codec.encode(dispatch(registry, same, self._clock)))

        ended = await asyncio.to_thread(work)
        if isinstance(ended, Failure):
            return ended
        assert isinstance(ended, Result)
        self._keeper.add("robot_ms", ended.compute_ms)
        return Answer(
            reply=ended.reply,
            source="robot",
            server="robot",
            round_trip_ms=ended.compute_ms,
            queue_ms=0.0,
            compute_ms=ended.compute_ms,
            why=why,
        )

    @staticmethod
    def _is_cloud_trouble(answer: Answer | Failure) -> bool:
        """A failure of the cloud may be mended on the robot; a failure of the request may not."""
        troubles = ("busy", "expired", "worker-lost", "internal", "disconnected", "unknown-service")
        return isinstance(answer, Failure) and answer.code in troubles

    def _from_cloud(self, ended: Answered, result: Result) -> Answer:
        keeper = self._keeper
        up_ms, down_ms = (None if s is None else max(0.0, s * 1e3) for s in (ended.up_s, ended.down_s))
        round_trip_ms = (self._clock() - ended.sent_s) * 1e3
        keeper.add_payload(ended.wire_bytes)
        for name, value in (
            ("round_trip_ms", round_trip_ms), ("up_ms", up_ms), ("queue_ms", result.queue_ms),
            ("compute_ms", result.compute_ms), ("down_ms", down_ms),
        ):  # fmt: skip
            keeper.add(name, value)
        return Answer(
            reply=result.reply,
            source="cloud",
            server=result.server,
            round_trip_ms=round_trip_ms,
            queue_ms=result.queue_ms,
            compute_ms=result.compute_ms,
            up_ms=up_ms,
            down_ms=down_ms,
            payload_bytes=ended.wire_bytes,
        )

    def _typed(self, answer: Answer | Failure, reply_type: type[Any] | None, started: float) -> Answer:
        if isinstance(answer, Failure):
            self._keeper.failures[answer.code] += 1
            raise error_from_code(
                answer.code, answer.message, hint=answer.hint, retry_after_ms=answer.retry_after_ms
            )
        self._keeper.answered += 1
        self._keeper.answered_by_robot += answer.source == "robot"
        changes: dict[str, Any] = {"round_trip_ms": (self._clock() - started) * 1e3}
        if reply_type is not None:
            try:
                changes["reply"] = as_type(answer.reply, reply_type)
            except RsePfError:
                self._keeper.failures["bad-message"] += 1
                raise
        values = {name: getattr(answer, name) for name in Answer.__slots__}
        return Answer(**{**values, **changes})

    def _answered(self, event: Answered) -> None:
        future = self._waiting.get(event.id)
        if future is not None and not future.done():
            future.set_result(event)


def _own_services() -> Registry:
    from rse_pf.services.builtin import builtin_services
    from rse_pf.settings import PlatformSettings

    return builtin_services(PlatformSettings())


def _version() -> str:
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "0"
