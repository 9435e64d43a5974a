"""The web ACL in the template: what it counts, what it answers, and that it is the rule that tests play."""

from __future__ import annotations

from typing import Any

import pytest

from client_sdk.network.dial_errors import http_status_error
from rse_pf.config.front_door import DIAL_BURST, DIALS_PER_MINUTE
from rse_pf.config.resource_names import ROSBRIDGE_PATH
from tests.kit.fake_firewall import PlayedFirewall, rules_of_settings, rules_of_template

SITE = "203.0.113.7"
PATHS = ["/ws", ROSBRIDGE_PATH, "/", "/healthz", "/%64ata/v1", "//data/v1/maps", "/data/v1/maps", "/burst"]


@pytest.fixture
def template(assembly: Any) -> Any:
    return assembly.templates["RsePf-Backend"]


def test_the_template_has_the_rules_that_follow_from_the_settings(assembly: Any, template: Any) -> None:
    written, expected = rules_of_template(template), rules_of_settings(assembly.settings)

    assert [(each.name, each.limit, each.window_s, each.of_all) for each in written] == [
        (each.name, each.limit, each.window_s, each.of_all) for each in expected
    ]
    for one, other in zip(written, expected, strict=True):
        one.limit = other.limit = 0
        assert [one.blocks(SITE, path, 0.0) for path in PATHS] == [
            other.blocks(SITE, path, 0.0) for path in PATHS
        ]


def test_dials_data_and_burst_are_counted_apart(template: Any) -> None:
    counted = {
        path: [rule.name for rule in rules_of_template(template) if rule.limit and _counts(rule, path)]
        for path in PATHS
    }

    assert counted == {
        **{path: ["dials"] for path in PATHS[:6]},
        "/data/v1/maps": ["data"],
        "/burst": ["burst", "burst-of-all"],
    }


def _counts(rule: Any, path: str) -> bool:
    rule.limit = 0
    return bool(rule.blocks(SITE, path, 0.0))


def test_the_limit_of_dials_is_that_of_the_robots_of_a_site(assembly: Any, template: Any) -> None:
    settings = assembly.settings
    dials = next(rule for rule in rules_of_template(template) if rule.name == "dials")
    of_a_robot = DIAL_BURST + DIALS_PER_MINUTE

    assert dials.window_s == 60
    assert dials.limit == settings.cloud.robots_per_site * of_a_robot


def test_what_is_blocked_gets_the_time_to_come_back_and_never_ends_a_robot(template: Any) -> None:
    for rule in rules_of_template(template):
        rule.limit = 0
        reply = PlayedFirewall([rule]).judge(SITE, "/data/x" if rule.name == "data" else "/burst", 0.0)
        reply = reply or PlayedFirewall([rule]).judge(SITE, "/ws", 0.0)
        assert reply is not None
        failed = http_status_error("ws://host/ws", reply.status, reply.headers, reply.body)

        assert reply.status == 429
        assert not failed.is_refusal
        assert failed.retry_after_s == 60.0
