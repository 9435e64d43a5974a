"""Report one recorded command as one value, from which HTML, terminal output and JSON are made."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.reader import RecordedCommand
from rse_pf.extensions.recording.replay.picture import match_picture
from rse_pf.extensions.recording.replay.solving import Again, Overrides, Resolver, pnp_reply
from rse_pf.geometry import Array, pose_difference
from rse_pf.pnp import PnpOptions, WeakLimits
from rse_pf.pnp.engines import engine_for, native_options
from rse_pf.pnp.native_solver import Evidence, native_solver
from rse_pf.pnp.options import MIN_CORRESPONDENCES
from rse_pf.pnp.rules import Rule, evaluate_rules
from rse_pf.services.pnp import PnpReply, PnpRequest
from rse_pf.wire import Failure, Result

__all__ = ["Attempt", "CommandReport", "report_of"]

_TRIED_INLIER_PX = (2.0, 4.0, 8.0, 16.0)  # inlier thresholds, px, with which a command is solved again
_TRIED_ITERATIONS = (100, 1000, 10_000)  # numbers of RANSAC iterations with which a command is solved again
_MAX_NUMBER = 1e12  # largest absolute value in a report; infinite numbers are replaced by it
_LIMITS = WeakLimits()  # limits of the rules that decide whether a pose is weak


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """The result of solving a command with one engine, or with one changed option.

    Attributes:
        name: Name of the engine, or the changed option.
        verdict: ``ok``, ``weak``, ``not solved``, the code of a failure, or ``answered`` without a pose.
        reason: Why the pose is weak or the command was not solved, or the message of the failure.
        inliers: Number of inliers.
        rmse_px: Root mean square reprojection error of the inliers, px.
        moved_m: Distance from the recorded position, metres; None if one of the two poses is missing.
        moved_deg: Rotation from the recorded orientation, degrees; None if one of the two poses is missing.
    """

    name: str
    verdict: str
    reason: str = ""
    inliers: int = 0
    rmse_px: float = 0.0
    moved_m: float | None = None
    moved_deg: float | None = None


class CommandReport(msgspec.Struct, frozen=True, kw_only=True):
    """One recorded command: its request and answer, and the results of solving it again.

    ``is_equal`` says whether solving it again with the recorded options gave the recorded bytes; ``tried`` is
    the result with the options of the caller, ``engines`` and ``options`` those with other engines and
    options.
    """

    id: str
    robot: str
    server: str
    version: str
    service: str
    codec: str
    sent_s: float
    round_trip_ms: float | None
    queue_ms: float
    compute_ms: float
    command_bytes: int
    reply_bytes: int
    verdict: str
    reason: str
    hint: str
    engine: str
    matches: int
    inliers: int
    rmse_px: float
    is_equal: bool
    why_not: str
    difference: str
    tried: Attempt | None = None
    tried_name: str = ""
    engines: tuple[Attempt, ...] = ()
    options: tuple[Attempt, ...] = ()
    rules: tuple[Rule, ...] = ()
    has_thumbnail: bool = False
    picture_png: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """The matches and options of a command, and its pose with inliers and rules: recorded, or solved again.

    ``T_camera_world`` is None, and ``inliers`` empty, if there is no pose.
    """

    points: Array
    pixels: Array
    request: PnpRequest
    options: PnpOptions
    T_camera_world: Array | None
    inliers: npt.NDArray[np.intp]
    rules: tuple[Rule, ...]


def report_of(
    command: RecordedCommand,
    resolver: Resolver,
    overrides: Overrides | None = None,
    *,
    with_picture: bool = True,
) -> CommandReport:
    """Report *command*; contents that cannot be decoded or solved raise nothing.

    Args:
        command: The recorded command.
        resolver: Solves the command again.
        overrides: Options of the solver to try in addition; None for none.
        with_picture: Whether to draw the matches.

    Raises:
        BadRequest: *overrides* name an unknown engine.
        MissingExtra: That engine, or Pillow for the picture, is not installed.
    """
    overrides = overrides or Overrides()
    again = resolver.again(command)
    reply, service = _read(command)
    pose = pnp_reply(reply)
    problem = _problem(command, resolver, pose)
    base = _base(command, again, reply, pose, service)
    if problem is None:
        return base
    tried = _attempt("", resolver.again(command, overrides), pose) if overrides.changes else None
    picture = b""
    if with_picture:
        picture = match_picture(
            camera=problem.request.camera, points_world=problem.points, pixels=problem.pixels,
            inliers=problem.inliers, T_camera_world=problem.T_camera_world, thumbnail=command.thumbnail,
        )  # fmt: skip
    return msgspec.structs.replace(
        base,
        matches=len(problem.pixels),
        tried=tried,
        tried_name=_name_of(overrides),
        engines=_engines(command, resolver, pose),
        options=_options(command, resolver, problem, pose),
        rules=problem.rules,
        picture_png=picture,
    )


def _base(
    command: RecordedCommand,
    again: Again,
    reply: Result | Failure | None,
    pose: PnpReply | None,
    service: str,
) -> CommandReport:
    verdict, reason, hint = "unanswered", "", ""
    if isinstance(reply, Failure):
        verdict, reason, hint = reply.code, reply.message, reply.hint
    elif pose is not None:
        verdict, reason = pose.verdict, pose.reason
    elif reply is not None:
        verdict = "answered"
    result = reply if isinstance(reply, Result) else None
    return CommandReport(
        id=command.id, robot=command.robot, server=command.server,
        version=command.about.get("version", ""), service=service,
        codec=command.codec, sent_s=command.sent_s, round_trip_ms=command.round_trip_ms,
        queue_ms=0.0 if result is None else _plain(result.queue_ms),
        compute_ms=0.0 if result is None else _plain(result.compute_ms),
        command_bytes=len(command.command_bytes), reply_bytes=len(command.reply_bytes or b""),
        verdict=verdict, reason=reason, hint=hint, engine="" if pose is None else pose.engine,
        matches=0, inliers=0 if pose is None else int(pose.inliers.size),
        rmse_px=0.0 if pose is None else _plain(pose.rmse_px),
        is_equal=again.is_equal, why_not=again.why_not, difference=again.difference,
        has_thumbnail=command.thumbnail is not None,
    )  # fmt: skip


def _read(command: RecordedCommand) -> tuple[Result | Failure | None, str]:
    """Return the decoded answer and the name of the service; ``(None, "")`` if they cannot be decoded."""
    try:
        return command.reply, command.command.service
    except RsePfError:
        return None, ""


def _problem(command: RecordedCommand, resolver: Resolver, pose: PnpReply | None) -> _Problem | None:
    """Return the matches of a `pnp` command with its pose; None for another service or malformed contents.

    *pose* is the recorded answer; if it is None, the command is solved again.
    """
    try:
        request = resolver.request(command)
    except RsePfError:
        return None
    if (
        request is None
        or request.points_world.size != request.pixels.size // 2 * 3
        or request.pixels.size % 2
    ):
        return None
    points = np.asarray(request.points_world, dtype=np.float64).reshape(-1, 3)
    pixels = np.asarray(request.pixels, dtype=np.float64).reshape(-1, 2)
    options = request.options or PnpOptions()
    n = len(pixels)
    if pose is not None:
        recorded: Array = np.asarray(pose.T_camera_world, dtype=np.float64).reshape(4, 4)
        T_camera_world: Array | None = recorded
        rows = np.asarray(pose.inliers).astype(np.intp)
        inliers = rows[(rows >= 0) & (rows < n)]
        found = _evidence(points, pixels, request, options, recorded)
    else:
        found = _evidence(points, pixels, request, options, options.engine or resolver.default_engine)
        inliers = np.empty(0, dtype=np.intp) if found is None else found.inliers
        T_camera_world = None if found is None or not inliers.size else found.T_camera_world
    rules: tuple[Rule, ...] = ()
    if found is not None or n < MIN_CORRESPONDENCES:
        rules = evaluate_rules(n, found, inlier_px=options.inlier_px, weak=_LIMITS)
    return _Problem(
        points=points, pixels=pixels, request=request, options=options,
        T_camera_world=T_camera_world, inliers=inliers,
        rules=tuple(msgspec.structs.replace(rule, measured=_plain(rule.measured)) for rule in rules),
    )  # fmt: skip


def _evidence(
    points_world: Array, pixels: Array, request: PnpRequest, options: PnpOptions, pose: Array | str
) -> Evidence | None:
    """Return the evidence for *pose*: a recorded pose ``(4, 4)``, or the name of an engine that computes one.

    None if there are too few matches, or if the solver raises an error.
    """
    if len(pixels) < MIN_CORRESPONDENCES:
        return None
    try:
        if isinstance(pose, str):
            return engine_for(pose)(points_world, pixels, request.camera, options, _LIMITS)
        limits = native_options(options, _LIMITS)
        return native_solver().evaluate(points_world, pixels, request.camera, limits, pose)
    except RsePfError:
        return None


def _attempt(name: str, again: Again, recorded: PnpReply | None) -> Attempt:
    if again.answer is None:
        return Attempt(name=name, verdict="not solved", reason=again.why_not)
    if isinstance(again.answer, Failure):
        return Attempt(name=name, verdict=again.answer.code, reason=again.answer.message)
    pose = pnp_reply(again.answer)
    if pose is None:
        return Attempt(name=name, verdict="answered")
    metres, degrees = None, None
    if recorded is not None:
        metres, degrees = map(
            _plain, pose_difference(pose.solution().T_camera_world, recorded.solution().T_camera_world)
        )
    return Attempt(
        name=name, verdict=pose.verdict, reason=pose.reason, inliers=int(pose.inliers.size),
        rmse_px=_plain(pose.rmse_px), moved_m=metres, moved_deg=degrees,
    )  # fmt: skip


def _engines(command: RecordedCommand, resolver: Resolver, pose: PnpReply | None) -> tuple[Attempt, ...]:
    return tuple(
        _attempt(name, resolver.again(command, Overrides(engine=name)), pose) for name in resolver.engines
    )


def _options(
    command: RecordedCommand, resolver: Resolver, problem: _Problem, pose: PnpReply | None
) -> tuple[Attempt, ...]:
    engine = (pose.engine if pose is not None else "") or problem.options.engine or resolver.default_engine
    chosen = engine if engine in resolver.engines else None
    tries = [
        *(
            Overrides(engine=chosen, inlier_px=px)
            for px in _TRIED_INLIER_PX
            if px != problem.options.inlier_px
        ),
        *(
            Overrides(engine=chosen, max_iterations=most)
            for most in _TRIED_ITERATIONS
            if most != problem.options.max_iterations
        ),
    ]
    return tuple(
        _attempt(
            _name_of(msgspec.structs.replace(attempt, engine=None)), resolver.again(command, attempt), pose
        )
        for attempt in tries
    )


def _name_of(overrides: Overrides) -> str:
    given = {
        "engine": overrides.engine,
        "inlier-px": None if overrides.inlier_px is None else f"{overrides.inlier_px:g}",
        "max-iterations": overrides.max_iterations,
    }
    return " ".join(f"--{name} {value}" for name, value in given.items() if value is not None)


def _plain(value: float) -> float:
    """Return *value* as a finite number that JSON can hold: 0 for NaN, at most 1e12 in absolute value."""
    number = float(value)
    if math.isnan(number):
        return 0.0
    return max(-_MAX_NUMBER, min(_MAX_NUMBER, number))
