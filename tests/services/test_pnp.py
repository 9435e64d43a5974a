"""`pnp` requests with and without depths, in all encodings."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.geometry import Array, exp_se3, transform
from rse_pf.pnp import DepthNoise, PnpOptions, refine_with_depth, solve_pnp
from rse_pf.pnp.problems import KINECT
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Command, Failure, Result, as_type, make_codec
from rse_pf.wire.server_codec import make_server_codec

_T = exp_se3([0.1, -0.05, 0.02, 0.03, -0.02, 0.05])
_REGISTRY = builtin_services(PlatformSettings())


def _views(n: int = 60) -> tuple[Array, Array, Array]:
    """Return points, pixels and depths of two images taken about 0.1 m apart."""
    rng = np.random.default_rng(1)
    points = KINECT.back_project(rng.uniform(60.0, [580.0, 420.0], (n, 2)), rng.uniform(1.0, 4.0, n))
    seen = transform(_T, points)
    return (
        points * (1.0 + 0.005 * rng.normal(size=(n, 1))),
        KINECT.project(seen) + rng.normal(size=(n, 2)),
        seen[:, 2] * (1.0 + 0.005 * rng.normal(size=n)),
    )


def _answer(payload: Any, codec_name: str = "json") -> PnpReply | Failure:
    codec = make_server_codec(codec_name, read_first=pnp_reader(_REGISTRY, codec_name))
    arrived = codec.decode_from_robot(codec.encode(Command(id=1, service="pnp", payload=payload)))
    assert isinstance(arrived, Command)
    answer = dispatch(_REGISTRY, arrived, lambda: 0.0)
    if isinstance(answer, Failure):
        return answer
    sent = codec.decode_from_server(codec.encode(answer))
    assert isinstance(sent, Result)
    return as_type(sent.reply, PnpReply)


def _request(codec: str = "json", **changes: Any) -> PnpRequest:
    points, pixels, depths_m = _views()
    given = {"depths_m": depths_m, "binary": codec == "bin"} | changes
    return make_request(points, pixels, KINECT, **given)


def _pose(reply: PnpReply | Failure) -> Array:
    assert isinstance(reply, PnpReply), reply
    return reply.solution().T_camera_world


@pytest.mark.parametrize("codec", CODECS)
def test_depths_refine_the_pose_in_every_encoding(codec: str) -> None:
    request = _request(codec)
    points, pixels = request.points_world.astype(np.float64), request.pixels.astype(np.float64)
    assert isinstance(request.depths_m, np.ndarray)
    expected = refine_with_depth(
        solve_pnp(points, pixels, KINECT), points, pixels, request.depths_m.astype(np.float64), KINECT
    )

    found = _answer(request, codec)

    assert _pose(found).tobytes() == expected.T_camera_world.tobytes()
    assert _pose(found).tobytes() != _pose(_answer(_request(codec, depths_m=None), codec)).tobytes()


@pytest.mark.parametrize("codec", CODECS)
def test_a_request_without_depths_is_the_same_bytes_as_before(codec: str) -> None:
    points, pixels, _ = _views()
    request = make_request(points, pixels, KINECT, binary=codec == "bin")
    before = {
        "camera": KINECT, "points_world": request.points_world, "pixels": request.pixels, "options": None,
    }  # fmt: skip

    encode = make_codec(codec).encode

    assert encode(Command(id=1, service="pnp", payload=request)) == encode(
        Command(id=1, service="pnp", payload=before)
    )


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "depths_m", [np.ones(59), np.ones(0), np.full(60, -1.0), np.full(60, 1e9)],
    ids=["too-few", "none", "negative", "absurd"],
)  # fmt: skip
def test_depths_that_do_not_fit_are_a_bad_request(codec: str, depths_m: Array) -> None:
    found = _answer(_request(codec, depths_m=depths_m), codec)

    assert isinstance(found, Failure)
    assert found.code == "bad-request"
    assert "depths_m" in found.message
    assert found.hint


def test_no_finite_numbers_make_the_service_fail() -> None:
    rng = np.random.default_rng(2)
    points, pixels, depths_m = _views()
    for _ in range(60):
        scale = 10.0 ** rng.uniform(-12, 8, 3)
        request = make_request(points, pixels, KINECT, depths_m=depths_m)
        request = msgspec.structs.replace(
            request,
            points_world=request.points_world * np.where(rng.random(points.shape) < 0.1, scale[0], 1.0),
            depths_m=np.abs(depths_m * scale[1]),
            depth_noise=DepthNoise(base_m=float(np.clip(scale[2], 1e-5, 1.0)), growth_per_m=0.0),
        )
        found = _answer(request)
        assert isinstance(found, PnpReply) or found.code in {
            "bad-request", "no-consensus", "degenerate", "ambiguous",
        }, found  # fmt: skip


def test_more_iterations_than_a_server_allows_are_refused() -> None:
    registry = builtin_services(PlatformSettings())
    points, pixels, _ = _views()

    def answer(options: PnpOptions) -> Result | Failure:
        request = make_request(points, pixels, KINECT, options)
        return dispatch(registry, Command(id=1, service="pnp", payload=request), lambda: 0.0)

    assert isinstance(answer(PnpOptions(inlier_px=4.0)), Result)
    refused = answer(PnpOptions(max_iterations=1001))
    assert isinstance(refused, Failure)
    assert "1001 iterations are above 1000" in refused.message
