"""The OpenAPI document says what the service does."""

from __future__ import annotations

import pytest

from rse_pf.data_server.handlers import Handlers
from rse_pf.data_server.routes import ROUTES, Route, openapi
from tests.kit.fake_data_service import Service


def test_the_service_returns_the_same_document_without_a_token(service: Service) -> None:
    answer = service.ask("GET", "/data/openapi.json", token="")

    assert (answer.status, answer.json) == (200, openapi())


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: route.operation)
def test_each_route_has_a_handler_and_requires_a_token_as_documented(service: Service, route: Route) -> None:
    path = route.path.format(digest="0" * 64, name="a", version="head")

    answer = service.ask(route.method, path, token="")

    assert hasattr(Handlers, route.operation)
    assert (answer.status == 401) == (route.scope is not None)
    described = openapi()["paths"][route.path][route.method.lower()]
    assert ("security" in described) == (route.scope is not None)
    assert str(answer.status) in described["responses"]
