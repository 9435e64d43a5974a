"""All that is known about one recorded command, as one value: what a page, a terminal or a program shows."""

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
from rse_pf.geometry import Array, pose_difference, transform
from rse_pf.pnp import PnpOptions, WeakLimits
from rse_pf.pnp.engines import engine_for, native_options
from rse_pf.pnp.native_solver import Evidence, native_solver
from rse_pf.pnp.options import MIN_CORRESPONDENCES
from rse_pf.pnp.rules import Rule, evaluate_rules
from rse_pf.services.pnp import PnpReply, PnpRequest
from rse_pf.wire import Failure, Result

__all__ = ["Attempt", "CommandReport", "Histogram", "report_of"]

_INLIER_PX_TRIED = (2.0, 4.0, 8.0, 16.0)
_ITERATIONS_TRIED = (100, 1000, 10_000)
_ERROR_EDGES_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, math.inf)
_DEPTH_BINS = 12
_GRID = (8, 6)
_MAX_NUMBER = 1e12
_LIMITS = WeakLimits()


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """What one engine, or one set of options, gives.

    Attributes:
        name: Of the engine, or what was changed.
        verdict: ``ok``, ``weak``, or the code of a failure.
        reason: Why it is weak, or what the failure says.
        inliers: How many matches agree.
        rmse_px: Of those.
        moved_m: How far the pose is from the recorded one; None where one of the two is missing.
        moved_deg: The same, of its rotation.
    """

    name: str
    verdict: str
    reason: str = ""
    inliers: int = 0
    rmse_px: float = 0.0
    moved_m: float | None = None
    moved_deg: float | None = None


class Histogram(msgspec.Struct, frozen=True, kw_only=True):
    """How many inliers and outliers lie between one edge and the next."""

    edges: tuple[float, ...]
    inliers: tuple[int, ...]
    outliers: tuple[int, ...]


class CommandReport(msgspec.Struct, frozen=True, kw_only=True):
    """One recorded command: what was asked, what was answered, and what is to be learnt from it.

    ``is_equal`` says whether solving it again, with nothing changed, gave the recorded bytes; ``tried`` what
    the options of the caller gave.  ``grid`` counts inliers by cell of the image, 8 across and 6 down.
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
    errors_px: Histogram | None = None
    depths_m: Histogram | None = None
    grid_inliers: tuple[int, ...] = ()
    grid_outliers: tuple[int, ...] = ()
    has_thumbnail: bool = False
    picture_png: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """The matches of a command, its options, and a pose with its evidence: recorded, or solved again."""

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
    """Return all that is known about *command*; never raises for what is in it.

    Args:
        command: Recorded.
        resolver: Solves again.
        overrides: What the caller wants to try.
        with_picture: Whether to draw the matches.

    Raises:
        BadRequest: *overrides* name an engine that there is not.
        MissingExtra: It is not installed, or Pillow is not.
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
        errors_px=_errors(problem),
        depths_m=_depths(problem),
        grid_inliers=_grid(problem, agrees=True),
        grid_outliers=_grid(problem, agrees=False),
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
    """Return the answer and the name of the service, nothing where the bytes cannot be read."""
    try:
        return command.reply, command.command.service
    except RsePfError:
        return None, ""


def _problem(command: RecordedCommand, resolver: Resolver, pose: PnpReply | None) -> _Problem | None:
    """Return the matches of a `pnp` command, None if it is another one or cannot be read."""
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
    """Return the evidence of a recorded pose or of that of an engine, None for input that has no pose."""
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
            for px in _INLIER_PX_TRIED
            if px != problem.options.inlier_px
        ),
        *(
            Overrides(engine=chosen, max_iterations=most)
            for most in _ITERATIONS_TRIED
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


def _agrees(problem: _Problem) -> npt.NDArray[np.bool_]:
    agrees = np.zeros(len(problem.pixels), dtype=np.bool_)
    agrees[problem.inliers] = True
    return agrees


def _errors(problem: _Problem) -> Histogram | None:
    """Return the reprojection errors, which are infinite behind the camera."""
    if problem.T_camera_world is None or not len(problem.pixels):
        return None
    with np.errstate(all="ignore"):
        points_camera = transform(problem.T_camera_world, problem.points)
        errors = np.hypot(*(problem.request.camera.project(points_camera) - problem.pixels).T)
    errors[~(points_camera[:, 2] > 0.0) | np.isnan(errors)] = np.inf
    return _histogram(errors, _agrees(problem), _ERROR_EDGES_PX)


def _depths(problem: _Problem) -> Histogram | None:
    """Return the depths of the points before the camera, from the nearest to the farthest twentieth."""
    if problem.T_camera_world is None:
        return None
    with np.errstate(all="ignore"):
        depths = transform(problem.T_camera_world, problem.points)[:, 2]
    good = depths[np.isfinite(depths)]
    if not len(good):
        return None
    low, high = (float(percentile) for percentile in np.percentile(good, (5, 95)))
    if not high - low > 1e-9:
        low, high = low - 0.5, high + 0.5
    edges = (-math.inf, *np.linspace(low, high, _DEPTH_BINS - 1).tolist(), math.inf)
    return _histogram(np.nan_to_num(depths, nan=np.inf), _agrees(problem), edges)


def _histogram(values: Array, agrees: npt.NDArray[np.bool_], edges: tuple[float, ...]) -> Histogram:
    inner = np.array(edges[1:-1])
    places = np.searchsorted(inner, values, side="right")
    counts = [np.bincount(places[which], minlength=len(edges) - 1).tolist() for which in (agrees, ~agrees)]
    return Histogram(
        edges=tuple(_plain(edge) for edge in edges), inliers=tuple(counts[0]), outliers=tuple(counts[1])
    )


def _grid(problem: _Problem, *, agrees: bool) -> tuple[int, ...]:
    """Return how many matches lie in each cell of the image, row after row."""
    camera, (columns, rows) = problem.request.camera, _GRID
    pixels = problem.pixels[_agrees(problem) == agrees]
    pixels = pixels[np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e9).all(axis=1)]
    column = np.clip((pixels[:, 0] * columns / camera.width).astype(np.int64), 0, columns - 1)
    row = np.clip((pixels[:, 1] * rows / camera.height).astype(np.int64), 0, rows - 1)
    counts: list[int] = np.bincount(row * columns + column, minlength=rows * columns).tolist()
    return tuple(counts)


def _plain(value: float) -> float:
    """Return *value* as a number that JSON can hold."""
    number = float(value)
    if math.isnan(number):
        return 0.0
    return max(-_MAX_NUMBER, min(_MAX_NUMBER, number))
