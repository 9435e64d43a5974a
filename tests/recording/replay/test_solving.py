"""Commands that are solved again give the recorded bytes; what cannot be solved again says why."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import msgspec
import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest
from rse_pf.extensions.recording.reader import RecordedCommand, open_recording
from rse_pf.extensions.recording.replay import run
from rse_pf.extensions.recording.replay.solving import Overrides, Resolver, pnp_reply
from rse_pf.geometry import exp_se3, transform
from rse_pf.pnp.problems import DEGENERATE, PnpProblem, make_degenerate, make_problem
from rse_pf.wire import Failure, Result, make_codec
from tests.kit.recorded_sessions import START_NS, Made

SETTINGS = PlatformSettings()


@pytest.mark.parametrize(
    ("codec", "engine"), [("zlib", "native"), ("json", "native"), ("bin", "native"), ("bin", "opencv")]
)
def test_every_answer_is_equal_to_the_byte_with_the_engine_that_gave_it(
    tmp_path: Path, codec: str, engine: str
) -> None:
    made = Made(tmp_path / "a", settings=SETTINGS.replace(pnp={"engine": engine}))
    for seed in range(4):
        made.send(make_problem(seed=seed, n=80, outlier_ratio=0.3 * (seed % 3)), codec=codec)
    for kind in DEGENERATE[:6]:
        made.send(make_degenerate(kind, seed=1), codec=codec)

    seen = run.overview(made.close(), SETTINGS, solve=True)

    assert (seen.commands, seen.equal, seen.different) == (10, 10, 0)


def changed(command: RecordedCommand, **fields: object) -> RecordedCommand:
    """Return *command* with fields of its reply changed."""
    reply = command.reply
    assert isinstance(reply, Result)
    other = msgspec.structs.replace(reply, reply={**reply.reply, **fields})
    return dataclasses.replace(command, reply_bytes=make_codec(command.codec).encode(other))


def test_the_smallest_change_of_an_answer_is_noticed(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    made.send(1)
    (command,) = open_recording(made.close()).commands()
    assert command.reply is not None
    assert isinstance(command.reply, Result)
    pose = np.array(command.reply.reply["T_camera_world"])
    pose[3] = np.nextafter(pose[3], np.inf)
    resolver = Resolver()

    assert resolver.again(command).is_equal
    assert not resolver.again(changed(command, T_camera_world=pose)).is_equal
    assert "weak" in resolver.again(changed(command, verdict="weak", reason="few-inliers")).difference


def test_other_options_are_tried_and_said(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    made.send(make_problem(seed=5, n=80, noise_px=2.0))
    (command,) = open_recording(made.close()).commands()
    resolver = Resolver()

    loose, tight = (
        pnp_reply(resolver.again(command, Overrides(inlier_px=px, max_iterations=5000)).answer)
        for px in (16.0, 1.0)
    )

    assert loose is not None
    assert tight is not None
    assert loose.inliers.size > tight.inliers.size
    with pytest.raises(BadRequest, match="no engine named"):
        resolver.again(command, Overrides(engine="magic"))


def test_what_went_wrong_is_listed_worst_first(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    problem = make_problem(seed=3, n=60, outlier_ratio=0.0)
    made.send(problem)
    late = made.send(problem, took_ns=900_000_000)
    lost = made.send(problem, is_answered=False)
    stale = made.send(problem, answer=Failure(id=3, code="stale", message="a newer one came"))
    weak = made.send(make_problem(seed=9, n=60, outlier_ratio=0.8))
    failed = made.send(make_degenerate("collinear", seed=1))
    made.send(problem, robot=1, T_odom_camera=np.eye(4))
    jump = made.send(seen_from_aside(problem), robot=1, T_odom_camera=np.eye(4))

    seen = run.overview(made.close(), SETTINGS, solve=False)

    assert [(each.kind, each.id) for each in seen.troubles] == [
        ("failed", failed), ("jump", jump), ("unanswered", lost), ("expired", stale), ("weak", weak),
        ("late", late),
    ]  # fmt: skip
    assert not seen.was_solved


def test_a_command_of_a_log_is_found_by_trace_id_and_time(tmp_path: Path) -> None:
    made = Made(tmp_path / "a")
    first = made.send(1, trace="t")
    answered_s = made.now_ns / 1e9 + 0.003
    made._ids = itertools.count()
    made.now_ns += 60_000_000_000
    second = made.send(2, trace="t", robot=1)
    folder = made.close()

    assert first.endswith(":0")
    assert second.endswith(":0")
    assert run.find(folder, SETTINGS, trace="t", number=0) == second
    assert run.find(folder, SETTINGS, trace="t", number=0, near_s=answered_s) == first
    assert run.find(folder, SETTINGS, trace="t", number=0, near_s=answered_s + 20.0) == ""
    assert run.find(folder, SETTINGS, trace="other", number=0) == ""
    assert run.find(folder, SETTINGS, trace="t", number=0, command_bytes=7) == ""


def seen_from_aside(problem: PnpProblem) -> PnpProblem:
    """Return the same points as a camera sees them that is 0.9 m further to the side."""
    T_moved = exp_se3([0.9, 0.0, 0.0, 0.0, 0.0, 0.0]) @ problem.T_camera_world
    pixels = problem.camera.project(transform(T_moved, problem.points_world))
    return dataclasses.replace(problem, pixels=pixels, T_camera_world=T_moved)


@pytest.mark.slow
def test_ten_thousand_commands_of_two_servers_are_equal_to_the_byte(tmp_path: Path) -> None:
    for number, start_ns in enumerate((START_NS, START_NS + 3_600_000_000_000)):
        made = Made(tmp_path / "a", server=f"server-{number}", start_ns=start_ns, max_file_bytes=8 << 20)
        for seed in range(5000):
            codec = ("bin", "zlib", "json")[seed % 3]
            ratio = (0.2, 0.5, 0.7)[seed // 3 % 3]
            made.send(make_problem(seed=seed, outlier_ratio=ratio), codec=codec, robot=seed % 3)
        made.close()

    seen = run.overview(tmp_path / "a", SETTINGS, solve=True)

    assert (seen.commands, seen.equal, seen.different) == (10_000, 10_000, 0)
    assert seen.files > 2
