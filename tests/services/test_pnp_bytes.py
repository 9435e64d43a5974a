"""A `pnp` command from bytes to bytes: the native core answers what Python answers, byte for byte."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import msgspec
import numpy as np
import pytest

from fuzz.damage import run_damaged
from fuzz.meter import Meter
from fuzz.native_targets import answer
from rse_pf.config import PnpSettings
from rse_pf.native import find_library
from rse_pf.pnp import PnpOptions
from rse_pf.pnp.engines import native_options
from rse_pf.pnp.native_reply import open_reply_solver
from rse_pf.pnp.options import WeakLimits
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem
from rse_pf.service import Registry, dispatch
from rse_pf.services import pnp
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request, wire_types
from rse_pf.wire import CODECS, Command, Result, as_type, make_codec
from rse_pf.wire.plain_pnp import EncodedReply, PlainPnp

LIBRARY = find_library()
pytestmark = pytest.mark.skipif(LIBRARY is None, reason="the native core is not built: make -C native")


def registered(engine: str = "native") -> Registry:
    registry = Registry()
    pnp.register(registry, PnpSettings(engine=engine))
    return registry


REGISTRY = registered()


def answer_of(payload: Any, codec: str, *, plain: bool, registry: Registry = REGISTRY) -> tuple[bytes, Any]:
    """Return the bytes of the answer to *payload*, all times 0, and the reply or the failure."""
    types = wire_types(registry, stays_plain=plain)
    chosen = make_codec(codec, pnp=types)
    sent = make_codec(codec).encode(Command(id=5, service="pnp", payload=payload, trace="t"))
    command = chosen.decode_from_robot(sent)
    assert isinstance(command, Command)
    assert isinstance(command.payload, PlainPnp) == plain
    message = dispatch(registry, command, lambda: 0.0, server="s-1")
    return chosen.encode(message), message.reply if isinstance(message, Result) else message


def problems() -> list[Any]:
    draw = random.Random(4)
    made: list[Any] = [
        make_degenerate(kind, seed=seed, n=n) for kind in DEGENERATE for seed, n in ((1, 60), (2, 9))
    ]
    for seed in range(60):
        share = draw.choice((0.0, 0.3, 0.5, 0.8, 0.95))
        made.append(make_problem(seed=seed, n=draw.choice((4, 5, 8, 63, 64, 65, 200)), outlier_ratio=share))
    return made


@pytest.mark.parametrize("codec", CODECS)
def test_every_kind_of_answer_has_the_bytes_of_python(codec: str) -> None:
    seen: Counter[str] = Counter()
    for problem in problems():
        numbers = np.concatenate([problem.points_world.ravel(), problem.pixels.ravel()])
        if not np.abs(numbers).max() < 1e30:
            continue  # is not plain
        request = make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")
        expected, reply = answer_of(request, codec, plain=False)
        got, fast = answer_of(request, codec, plain=True)

        assert got == expected
        if isinstance(reply, PnpReply):
            assert isinstance(fast, EncodedReply)
            assert (fast.verdict, fast.reason) == (reply.verdict, reply.reason)
            assert fast.T_camera_world.tobytes() == reply.T_camera_world.tobytes()
        seen[reply.reason or "ok" if isinstance(reply, PnpReply) else reply.code] += 1
    assert seen["ok"] > 10
    assert {"few-inliers", "low-inlier-ratio", "no-consensus", "degenerate"} <= seen.keys()


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "change",
    [
        {"options": PnpOptions()},
        {"options": PnpOptions(engine="opencv")},
        {"options": PnpOptions(max_iterations=100_000)},
        {"depths_m": np.linspace(0.5, 3.0, 40)},
        {"pixels": np.arange(79.0)},
        {"points_world": np.arange(117.0)},
        {"points_world": np.arange(9.0), "pixels": np.arange(6.0)},
        {"points_world": np.full(120, 2e6)},
    ],
)
def test_what_the_native_core_does_not_plainly_know_is_answered_by_python(
    codec: str, change: dict[str, Any]
) -> None:
    problem = make_problem(seed=1, n=40)
    request = msgspec.structs.replace(
        make_request(problem.points_world, problem.pixels, problem.camera), **change
    )

    expected, _ = answer_of(request, codec, plain=False)
    got, reply = answer_of(request, codec, plain=True)

    assert got == expected
    assert not isinstance(reply, EncodedReply)


def test_a_server_with_limits_or_another_engine_answers_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.services.pnp.MAX_CORRESPONDENCES", 39)
    problem = make_problem(seed=1, n=40)
    request = make_request(problem.points_world, problem.pixels, problem.camera)
    for registry in (registered(), registered("opencv")):
        expected, _ = answer_of(request, "json", plain=False, registry=registry)
        got, reply = answer_of(request, "json", plain=True, registry=registry)

        assert got == expected
        assert not isinstance(reply, EncodedReply)


def test_a_payload_that_was_left_plain_is_a_request_for_whoever_asks() -> None:
    problem = make_problem(seed=1, n=40)
    request = make_request(
        problem.points_world, problem.pixels, problem.camera, depths_m=np.linspace(1, 2, 40)
    )
    codec = make_codec("json", pnp=wire_types(REGISTRY, stays_plain=True))
    command = codec.decode_from_robot(
        make_codec("json").encode(Command(id=1, service="pnp", payload=request))
    )
    assert isinstance(command, Command)

    read = as_type(command.payload, PnpRequest)

    assert read.camera == request.camera
    assert read.points_world.tobytes() == request.points_world.tobytes()
    assert read.pixels.tobytes() == request.pixels.tobytes()
    assert isinstance(read.depths_m, np.ndarray)
    assert read.depths_m.tobytes() == np.asarray(request.depths_m).tobytes()


def test_a_reply_that_does_not_fit_is_left_to_python() -> None:
    assert LIBRARY is not None
    solver = open_reply_solver(LIBRARY)
    problem = make_problem(seed=1, n=9000)
    numbers = np.concatenate([problem.points_world.ravel(), problem.pixels.ravel()])

    read = PlainPnp(numbers.tobytes(), 27000, 18000, 0, KINECT, None, True, PnpRequest)

    assert solver.answer(read, native_options(PnpOptions(), WeakLimits())) is None


def test_numbers_are_written_as_msgspec_writes_them() -> None:
    """The covariance of a reply holds numbers of all sizes, if the camera and the world are of all sizes."""
    assert LIBRARY is not None
    draw = np.random.default_rng(3)
    for seed in range(300):
        problem = make_problem(seed=seed, n=30)
        scale = 10.0 ** draw.uniform(-4, 4)
        request = PnpRequest(
            camera=problem.camera,
            points_world=problem.points_world.ravel() * scale,
            pixels=problem.pixels.ravel(),
        )
        expected, _ = answer_of(request, "json", plain=False)
        assert answer_of(request, "json", plain=True)[0] == expected


def test_inputs_of_the_fuzz_target_get_the_same_answer() -> None:
    meter = Meter()

    run_damaged("answer", lambda data: answer(data, meter), first=3, inputs=1500)

    assert meter.calls > 1500
