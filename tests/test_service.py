"""Dispatch never raises, and a service is a function of one request."""

from __future__ import annotations

import itertools
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import PlatformSettings
from rse_pf.errors import Busy, ConfigurationError, DegenerateGeometry
from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.pnp.problems import KINECT, make_problem
from rse_pf.service import Registry, Service, dispatch, failure_of
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request
from rse_pf.wire import CODECS, Command, Failure, Result, as_type, make_codec


class Number(msgspec.Struct, frozen=True, kw_only=True):
    """A request and a reply of the tests."""

    value: float = 0.0


def ticking(*seconds: float) -> Any:
    return itertools.chain(seconds, itertools.repeat(seconds[-1])).__next__


def registry_of(function: Any, name: str = "service") -> Registry:
    registry = Registry()
    registry.add(Service(name=name, function=function, request_type=Number, reply_type=Number))
    return registry


def run(function: Any, payload: Any = None, **kwargs: Any) -> Result | Failure:
    command = Command(id=3, service="service", payload=payload, trace="abc")
    return dispatch(registry_of(function), command, ticking(1.0, 1.25), server="s1", **kwargs)


def test_a_reply_carries_the_id_the_server_and_the_time_it_took() -> None:
    assert run(lambda request: Number(value=request.value * 2), {"value": 4}) == Result(
        id=3, reply=Number(value=8.0), server="s1", compute_ms=250.0
    )


def test_a_command_without_payload_means_the_defaults() -> None:
    result = run(lambda request: request)

    assert isinstance(result, Result)
    assert result.reply == Number()


def raising(error: BaseException) -> Any:
    def service(request: Number) -> Number:
        raise error

    return service


def test_our_own_errors_keep_their_code_and_hint() -> None:
    error = Busy("too much", hint="later", retry_after_ms=20.0)

    assert run(raising(error)) == Failure(
        id=3, code="busy", message="too much", hint="later", retry_after_ms=20.0, server="s1", trace="abc"
    )


@pytest.mark.parametrize(
    "error", [ValueError("/secret/path"), MemoryError(), RecursionError(), SystemExit(3), KeyError("k")]
)
def test_a_defect_is_one_internal_failure_that_tells_nothing(error: BaseException) -> None:
    seen: list[tuple[Command, Exception]] = []

    failure = run(raising(error), on_defect=lambda command, cause: seen.append((command, cause)))

    assert isinstance(failure, Failure)
    assert (failure.id, failure.code, failure.trace) == (3, "internal", "abc")
    assert "secret" not in repr(failure)
    assert len(seen) == 1


def test_an_unknown_service_is_answered_with_what_there_is() -> None:
    registry = registry_of(lambda request: request, "pnp")

    failure = dispatch(registry, Command(id=1, service="pmp"), ticking(0.0))

    assert isinstance(failure, Failure)
    assert failure.code == "unknown-service"
    assert failure.message == "no service named 'pmp'; this server offers pnp"


@pytest.mark.parametrize("payload", [{"value": "4"}, {"value": None}, 4, [], "x", {"value": [1]}])
def test_a_payload_of_another_shape_is_a_bad_request(payload: Any) -> None:
    failure = run(lambda request: request, payload)

    assert isinstance(failure, Failure)
    assert failure.code == "bad-request"
    assert failure.hint


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4),
    max_leaves=12,
)
PNP = st.fixed_dictionaries(
    {},
    optional={
        "camera": JSON | st.just(msgspec.to_builtins(KINECT)),
        "points_world": JSON | st.lists(st.floats(), max_size=30),
        "pixels": JSON | st.lists(st.floats(), max_size=20),
        "options": JSON,
    },
)


@given(st.sampled_from(["pnp", "echo", "nothing"]), JSON | PNP)
def test_no_payload_makes_dispatch_raise(service: str, payload: Any) -> None:
    registry = builtin_services(PlatformSettings())

    answer = dispatch(registry, Command(id=1, service=service, payload=payload), ticking(0.0))

    assert answer.id == 1
    assert isinstance(answer, Result) or answer.code != "internal"


def test_a_service_takes_one_struct_and_gives_one() -> None:
    def two(first: Number, second: Number) -> Number:
        return first

    def one_and_a_default(first: Number, second=1) -> Number:  # type: ignore[no-untyped-def]
        return first

    def none() -> Number:
        return Number()

    def no_reply(request: Number) -> None: ...

    def plain(request: dict[str, Any]) -> Number:
        return Number()

    def unreadable(request: Missing) -> Number:  # type: ignore[name-defined]  # noqa: F821
        return Number()

    odd: list[Any] = [two, one_and_a_default, none, no_reply, plain, unreadable]
    for function in odd:
        with pytest.raises(ConfigurationError) as caught:
            Registry().service("odd")(function)
        assert "'odd'" in caught.value.message
        assert caught.value.hint


def test_two_services_cannot_have_one_name() -> None:
    registry = registry_of(lambda request: request)

    with pytest.raises(ConfigurationError, match="two services are named"):
        registry.add(registry.get("service"))


def test_a_service_is_summed_up_by_its_docstring() -> None:
    registry = builtin_services(PlatformSettings())

    assert {service.name: service.summary for service in registry} == {
        "pnp": "Estimate the camera pose of one frame.",
        "echo": "Return the value of the request.",
        "icp": "Refine the pose between two overlapping point clouds.",
        "place": "Find the keyframes of a map that show what a view shows.",
        "localise": "Find the camera's pose in a map.",
        "merge": "Make one map of several robots' maps, or close the loops of one.",
        "optimise": "Fit the poses of a pose graph to its edges.",
        "wifi": "Find the position of a robot by the Wi-Fi access points that it receives.",
    }


def test_a_failure_outside_a_command_has_no_id() -> None:
    assert failure_of(DegenerateGeometry("flat")) == Failure(code="degenerate", message="flat")


def pnp(
    request: PnpRequest, settings: PlatformSettings | None = None, codec: str = "json"
) -> Result | Failure:
    wire = make_codec(codec)
    command = wire.decode_from_robot(wire.encode(Command(id=1, service="pnp", payload=request)))
    assert isinstance(command, Command)
    return dispatch(builtin_services(settings or PlatformSettings()), command, ticking(0.0))


@pytest.mark.parametrize("codec", CODECS)
def test_a_pose_over_the_wire_is_the_pose_of_the_solver(codec: str) -> None:
    problem = make_problem(seed=5)
    request = make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")
    direct = solve_pnp(
        request.points_world.astype(np.float64), request.pixels.astype(np.float64), problem.camera
    )

    result = pnp(request, codec=codec)
    wire = make_codec(codec)
    arrived = wire.decode_from_server(wire.encode(result))

    assert isinstance(arrived, Result)
    solution = as_type(arrived.reply, PnpReply).solution()
    np.testing.assert_array_equal(solution.T_camera_world, direct.T_camera_world)
    np.testing.assert_array_equal(solution.inliers, direct.inliers)
    np.testing.assert_allclose(solution.covariance, direct.covariance, rtol=1e-6)
    assert (solution.verdict, solution.reason, solution.engine) == (
        direct.verdict,
        direct.reason,
        direct.engine,
    )


def request_of(n: int, **options: Any) -> PnpRequest:
    problem = make_problem(seed=1, n=max(n, 4), outlier_ratio=0.0)
    return make_request(
        problem.points_world[:n],
        problem.pixels[:n],
        problem.camera,
        PnpOptions(**options) if options else None,
    )


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (request_of(3), "too-few"),
        (request_of(0), "too-few"),
        (request_of(5001), "too-large"),
        (request_of(50, max_iterations=1001), "too-large"),
        (msgspec.structs.replace(request_of(50), pixels=np.zeros(99)), "bad-request"),
        (msgspec.structs.replace(request_of(50), pixels=np.zeros(98)), "bad-request"),
        (msgspec.structs.replace(request_of(50), points_world=np.full(150, np.nan)), "bad-request"),
        (msgspec.structs.replace(request_of(50), points_world=np.full(150, 1e300)), "bad-request"),
        (msgspec.structs.replace(request_of(50), points_world=np.ones(150)), "degenerate"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_gives_no_pose_is_a_typed_failure(request_: PnpRequest, code: str) -> None:
    failure = pnp(request_)

    assert isinstance(failure, Failure)
    assert failure.code == code, failure
    assert failure.hint


def test_a_camera_that_is_none_is_a_typed_failure() -> None:
    payload = {"camera": {**msgspec.to_builtins(KINECT), "fx": 0.5}, "points_world": [], "pixels": []}

    failure = dispatch(
        builtin_services(PlatformSettings()), Command(id=1, service="pnp", payload=payload), ticking(0.0)
    )

    assert isinstance(failure, Failure)
    assert failure.code == "invalid-camera"
