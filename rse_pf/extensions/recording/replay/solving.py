"""Solve a recorded command again, and compare the answer with the recorded one byte by byte.

As in servers, in the Lambda function and in robots, a command is decoded by the codec of its connection,
answered by `rse_pf.service.dispatch`, and its answer is encoded by the same codec.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from rse_pf.config import PlatformSettings, PnpSettings
from rse_pf.errors import (
    BadRequest,
    LimitExceeded,
    PnpError,
    RsePfError,
)
from rse_pf.extensions.recording.reader import RecordedCommand
from rse_pf.geometry import pose_difference
from rse_pf.limits.budget import Budget, inflate_within
from rse_pf.pnp import PnpOptions, available_engines
from rse_pf.pnp.engines import engine_for
from rse_pf.service import Registry, dispatch, request_of
from rse_pf.services import pnp
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest
from rse_pf.wire import Codec, Command, Failure, Result, as_type, make_codec

__all__ = ["TIMES_AND_PLACES", "Again", "Overrides", "Resolver", "pnp_reply", "solver_codes"]

TIMES_AND_PLACES = ("server", "queue_ms", "compute_ms", "received_s", "sent_s", "trace")
"""Fields of answers with times, server and trace, which are not compared: they differ each time."""
_MAX_TRIED_ITERATIONS = 100_000  # most RANSAC iterations of a replay: the largest option; servers allow fewer
_POSES_SERVICE = "pnp"  # name of the service that computes poses


class Overrides(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Options of the solver that replace those of a recorded command; None keeps the recorded option."""

    engine: str | None = None
    inlier_px: float | None = None
    max_iterations: int | None = None

    @property
    def changes(self) -> bool:
        """Whether any option replaces a recorded one."""
        return self != Overrides()

    def of(self, options: PnpOptions | None) -> PnpOptions:
        """Return *options* (None for the defaults) with the replaced ones.

        Raises BadRequest if a number is out of range.
        """
        given = {name: value for name, value in msgspec.structs.asdict(self).items() if value is not None}
        return msgspec.structs.replace(options or PnpOptions(), **given)


@dataclass(frozen=True, slots=True, kw_only=True)
class Again:
    """The result of solving a recorded command again.

    Attributes:
        answer: The new answer; None if the command cannot be solved again.
        why_not: Why the command cannot be solved again; "" if it can.
        is_equal: Whether the new answer has the recorded bytes except for `TIMES_AND_PLACES`.
        difference: Phrase on how the new answer differs; "" if it is equal.
    """

    answer: Result | Failure | None = None
    why_not: str = ""
    is_equal: bool = False
    difference: str = ""


class Resolver:
    """Solve recorded commands again, with the engine that solved them first."""

    def __init__(
        self, settings: PlatformSettings | None = None, *, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """Prepare to solve.

        Args:
            settings: Settings of the server that answered; None for the defaults.
            clock: Clock in seconds with which the time of an answer is measured.
        """
        self._settings = settings or PlatformSettings()
        self._clock = clock
        self._budget = Budget.of_messages(self._settings.session)
        self._registries: dict[str, Registry] = {}
        self._codecs: dict[str, Codec] = {}
        self._engines = available_engines()

    @property
    def engines(self) -> tuple[str, ...]:
        """Names of the PnP engines that are installed on this machine."""
        return self._engines

    @property
    def default_engine(self) -> str:
        """The engine in the settings of the server, or the first installed one if it is not installed."""
        preferred = self._settings.pnp.engine
        return preferred if preferred in self._engines else self._engines[0]

    def again(self, recorded: RecordedCommand, overrides: Overrides | None = None) -> Again:
        """Solve *recorded* again, with the options of *overrides* if it is a `pnp` command.

        Contents of *recorded* that cannot be decoded or solved raise nothing: `Again.why_not` is the reason.

        Raises:
            BadRequest: *overrides* name an unknown engine.
            MissingExtra: That engine is not installed.
            ConfigurationError: The library of that engine has a wrong version.
        """
        overrides = overrides or Overrides()
        if overrides.engine is not None and overrides.engine not in self._engines:
            engine_for(overrides.engine)  # raises an error that names what is missing
        try:
            reply = recorded.reply
            command = recorded.command
        except RsePfError as error:
            return Again(why_not=f"its bytes cannot be read: {error.message}")
        why_not = self._why_not(command, reply)
        if why_not:
            return Again(why_not=why_not)
        engine = self._engine_of(command, reply)
        if engine not in self._engines and not overrides.engine:
            return Again(why_not=f"the engine {engine} that solved it is not on this machine")
        if overrides.changes and command.service == _POSES_SERVICE:
            answer = self._try(command, overrides, engine)
        else:
            registry = self._registry(engine if engine in self._engines else self._engines[0])
            answer = dispatch(registry, command, self._clock)
        if reply is None:
            return Again(answer=answer, difference="it was never answered")
        if self._bytes_of(recorded.codec, answer, reply) == self._text(recorded.codec, recorded.reply_bytes):
            return Again(answer=answer, is_equal=True)
        return Again(answer=answer, difference=difference_of(reply, answer) or "the bytes differ")

    def request(self, recorded: RecordedCommand) -> PnpRequest | None:
        """Return the decoded request of a `pnp` command; None for another service.

        Raises RsePfError if it cannot be decoded.
        """
        command = recorded.command
        if command.service != _POSES_SERVICE:
            return None
        request: PnpRequest = request_of(command.payload, self._registry(self._engines[0]).get("pnp"))
        return request

    def _why_not(self, command: Command, reply: Result | Failure | None) -> str:
        """Return why *command*, which was answered by *reply*, cannot be solved again; "" if it can."""
        service = next((s for s in self._registry(self._engines[0]) if s.name == command.service), None)
        if service is None:
            return "its service is installed on the server"
        if service.kind != "stateless":
            return "its service keeps state or stored objects"
        if isinstance(reply, Failure) and reply.code not in solver_codes():
            return f"the server did not solve it: {reply.code}"
        if isinstance(reply, Result) and reply.object:
            return "its reply is a stored object"
        return ""

    def _engine_of(self, command: Command, reply: Result | Failure | None) -> str:
        """Return the engine that the recorded *reply* names, else `default_engine`."""
        if command.service == _POSES_SERVICE and isinstance(reply, Result) and isinstance(reply.reply, dict):
            engine = reply.reply.get("engine", "")
            if isinstance(engine, str) and engine:
                return engine
        return self.default_engine

    def _try(self, command: Command, overrides: Overrides, engine: str) -> Result | Failure:
        engine = engine if engine in self._engines else self._engines[0]
        registry = Registry()
        pnp.register(registry, PnpSettings(engine=engine), max_iterations=_MAX_TRIED_ITERATIONS)
        try:
            request = request_of(command.payload, registry.get(_POSES_SERVICE))
            options = overrides.of(request.options)
        except RsePfError:
            return dispatch(registry, command, self._clock)
        return dispatch(
            registry,
            msgspec.structs.replace(command, payload=msgspec.structs.replace(request, options=options)),
            self._clock,
        )

    def _registry(self, engine: str) -> Registry:
        """Return the built-in services of a server that uses *engine*."""
        if engine not in self._registries:
            self._registries[engine] = builtin_services(self._settings.replace(pnp={"engine": engine}))
        return self._registries[engine]

    def _codec(self, name: str) -> Codec:
        if name not in self._codecs:
            self._codecs[name] = make_codec(name, self._settings.session)
        return self._codecs[name]

    def _bytes_of(self, codec: str, answer: Result | Failure, recorded: Result | Failure) -> bytes | None:
        """Encode *answer* with the `TIMES_AND_PLACES` of *recorded*, before it is deflated.

        None if one of the two is a result and the other a failure.
        """
        if type(answer) is not type(recorded):
            return None
        unchanged = {name: getattr(recorded, name) for name in TIMES_AND_PLACES if hasattr(recorded, name)}
        return self._text(codec, self._codec(codec).encode(msgspec.structs.replace(answer, **unchanged)))

    def _text(self, codec: str, data: bytes | None) -> bytes:
        """Inflate a message of the codec ``zlib``, since versions may deflate differently; return others."""
        assert data is not None
        return bytes(inflate_within(data, self._budget)) if codec == "zlib" else data


def pnp_reply(answer: Result | Failure | None) -> PnpReply | None:
    """Return the reply of the service `pnp` in *answer*; None if it holds none, or arrays of a wrong size."""
    if not isinstance(answer, Result):
        return None
    if isinstance(answer.reply, PnpReply):
        return answer.reply
    try:
        reply = as_type(answer.reply, PnpReply)
    except RsePfError:
        return None
    fits = reply.T_camera_world.size == 16 and reply.covariance.size == 21
    return reply if fits else None


def solver_codes() -> frozenset[str]:
    """Return the codes of failures that depend on the command alone, and so occur again."""
    kinds: list[type[RsePfError]] = [PnpError, *PnpError.__subclasses__(), BadRequest, LimitExceeded]
    return frozenset(kind.code for kind in kinds)


def difference_of(before: Result | Failure, after: Result | Failure) -> str:
    """Return a phrase on how *after* differs from *before*.

    It compares codes of failures, pose, verdict, number of inliers and engine; "" if these are equal.
    """
    if isinstance(before, Failure) and isinstance(after, Failure):
        return "" if before.code == after.code else f"{before.code} became {after.code}"
    if isinstance(before, Failure):
        return f"{before.code} became a pose"
    if isinstance(after, Failure):
        return f"the pose became {after.code}"
    old, new = pnp_reply(before), pnp_reply(after)
    if old is None or new is None:
        return ""
    parts = []
    metres, degrees = pose_difference(new.solution().T_camera_world, old.solution().T_camera_world)
    if metres > 0 or degrees > 0:
        parts.append(f"the pose moved by {metres * 1e3:.3g} mm and {degrees:.3g} deg")
    if (old.verdict, old.reason) != (new.verdict, new.reason):
        parts.append(f"{_verdict(old)} became {_verdict(new)}")
    if old.inliers.size != new.inliers.size:
        parts.append(f"{old.inliers.size} inliers became {new.inliers.size}")
    if old.engine != new.engine:
        parts.append(f"{old.engine} became {new.engine}")
    return ", ".join(parts)


def _verdict(reply: PnpReply) -> str:
    return f"{reply.verdict} ({reply.reason})" if reply.reason else reply.verdict
