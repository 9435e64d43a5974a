"""What the page says that the scale modifier waits for is what the policy then does."""

from __future__ import annotations

import random

import pytest

from rse_pf.config import ScalingSettings
from rse_pf.extensions.fleet_page.feeds.events import event_sentence
from rse_pf.extensions.fleet_page.feeds.sentences import waiting_for
from rse_pf.scaling.policy import FleetState, Sample, decide

SETTINGS = ScalingSettings()
PERIOD_S = SETTINGS.period_s


def policy(*samples: tuple[float, float], **more: object) -> dict[str, object]:
    told = [
        {"start_s": number * PERIOD_S, "cpu_percent": cpu, "requests": requests}
        for number, (cpu, requests) in enumerate(samples)
    ]
    return {"elastic": True, "samples": told, "min_servers": 1, "max_servers": 8, **more}


@pytest.mark.parametrize(
    ("cpus", "servers", "sentence"),
    [
        ((75.0,), 2, "1 of 2 samples above 70 %: one more server starts after one further such sample"),
        ((10.0, 75.0, 80.0), 2, "2 of 2 samples above 70 %: one more server starts"),
        ((75.0, 80.0), 8, "2 of 2 samples above 70 %, but 8 servers are the most that are allowed"),
        ((75.0, 30.0), 2, "the servers are neither busy nor idle"),
    ],
)
def test_busy_servers_are_counted_in_words(cpus: tuple[float, ...], servers: int, sentence: str) -> None:
    (said,) = waiting_for(policy(*((cpu, 9.0) for cpu in cpus)), SETTINGS, servers=servers)

    assert said.startswith(sentence)


def test_idle_servers_are_counted_in_words() -> None:
    idle = [(1.0, 0.0)] * 3

    assert waiting_for(policy(*idle), SETTINGS, servers=2) == [
        "3 of 5 samples idle: one server leaves after two further idle samples"
    ]
    assert waiting_for(policy(*idle), SETTINGS, servers=1) == [
        "3 of 5 samples idle: nothing happens, one server is the fewest that are allowed"
    ]


def test_the_sentence_announces_what_the_policy_decides() -> None:
    chance = random.Random(5)
    grown = shrunk = 0
    for _ in range(500):
        rows = [
            (chance.choice((1.0, 50.0, 75.0, 90.0)), chance.choice((0.0, 0.0, 5.0)))
            for _ in range(chance.randint(1, 7))
        ]
        if chance.random() < 0.4:
            rows += [chance.choice(((80.0, 5.0), (1.0, 0.0)))] * 5
        servers = chance.randint(1, 8)
        samples = [
            Sample(start_s=at * PERIOD_S, cpu_percent=cpu, requests=requests)
            for at, (cpu, requests) in enumerate(rows)
        ]
        settings = ScalingSettings(min_servers=1, max_servers=8)
        (action,) = decide(samples, FleetState(servers=servers), settings, now_s=len(rows) * PERIOD_S)
        (said,) = waiting_for(policy(*rows), settings, servers=servers)

        grown += action.kind == "grow"
        shrunk += action.kind == "shrink"
        assert (action.kind == "grow") == ("more server" in said and "after" not in said), (rows, said)
        assert (action.kind == "shrink") == ("leaves now" in said), (rows, said)
    assert min(grown, shrunk) > 20


def test_a_modifier_that_is_off_and_a_first_period_are_told() -> None:
    assert "off" in waiting_for({"elastic": False}, SETTINGS, servers=2)[0]
    assert "no whole period" in waiting_for(policy(), SETTINGS, servers=2)[0]
    assert "too soon" in waiting_for(policy((1.0, 1.0), crash_loop=True), SETTINGS, servers=2)[0]


def test_events_are_sentences_also_without_details_and_with_unknown_kinds() -> None:
    assert event_sentence({"event": "server-killed", "server": "server-1"}) == (
        "server-1 was killed by the operator"
    )
    assert event_sentence({"event": "replace", "server": "{by.__class__}"}).startswith("{by.__class__} is")
    assert event_sentence({"event": "new-kind", "server": "a"}) == "new kind: server a"
