"""Commands that real servers answered, before and after a restart, are equal to the byte."""

from __future__ import annotations

import asyncio
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from client_sdk import connect
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.reader import open_recording
from rse_pf.extensions.recording.replay import run
from rse_pf.extensions.recording.replay.limited import LimitedReplay
from rse_pf.pnp.problems import DEGENERATE, make_degenerate, make_problem
from rse_pf.wire import CODECS
from tests.kit.guarded_server import GuardedServer

pytestmark = [pytest.mark.slow, pytest.mark.system]

SETTINGS = PlatformSettings()
NAMES = ("käthe-the-robot", "r2d2-of-warehouse", "seventh")
_EACH = 40


async def drive(server: GuardedServer, name: str, codec: str, folder: Path, tokens: list[str]) -> None:
    """Ask for poses of good, hard and impossible problems."""
    tokens.append(server.token(name))
    async with connect(server.url, token=tokens[-1], codec=codec, record=folder) as robot:
        for seed in range(_EACH):
            problem = (
                make_degenerate(DEGENERATE[seed % 11], seed=seed)
                if seed % 4 == 3
                else make_problem(seed=seed, outlier_ratio=(0.2, 0.5, 0.75)[seed % 3])
            )
            with suppress(RsePfError):
                await robot.solve_pnp(problem.points_world, problem.pixels, problem.camera, stream=name)


def texts(recording: Path) -> Iterator[bytes]:
    """Yield the messages of a recording, inflated."""
    for command in open_recording(recording).commands():
        for data in (command.command_bytes, command.reply_bytes or b""):
            yield zlib.decompress(data) if data and command.codec == "zlib" else data


@pytest.mark.timeout(300)
def test_commands_of_two_runs_of_a_server_are_equal_to_the_byte_and_hold_no_token(tmp_path: Path) -> None:
    recordings, on_robots = tmp_path / "recordings", tmp_path / "robots"
    tokens: list[str] = []

    async def all_robots(server: GuardedServer) -> None:
        await asyncio.gather(*(
            drive(server, name, codec, on_robots, tokens) for name, codec in zip(NAMES, CODECS, strict=True)
        ))  # fmt: skip

    on_robots.mkdir()
    for number in range(2):
        home = tmp_path / str(number)
        home.mkdir()
        with GuardedServer(home, recording={"folder": str(recordings)}) as server:
            asyncio.run(all_robots(server))
            server.drain()

    with LimitedReplay() as replay:
        for folder in (recordings, on_robots):
            seen = replay.overview(folder, solve=True, worst=40)

            assert seen.commands == 2 * len(NAMES) * _EACH
            assert (seen.different, seen.changed) == (0, ())
            assert seen.equal >= seen.commands - 6, seen.not_solved
            assert seen.by_kind.get("failed", 0) >= 30
            for trouble in seen.troubles[:10]:
                assert replay.command(folder, trouble.id).is_equal
            data = b"".join([*(file.read_bytes() for file in folder.iterdir()), *texts(folder)])
            for secret in tokens:
                assert secret.encode() not in data
        assert run.overview(recordings, SETTINGS, solve=False).robots == 2 * len(NAMES)
