"""What the page says that the scale modifier waits for is what the policy then does."""

from __future__ import annotations

import random

from rse_pf.config import ScalingSettings
from rse_pf.extensions.fleet_page.feeds.sentences import waiting_for
from rse_pf.local.events import event_sentence
from rse_pf.scaling.policy import FleetState, decide
from rse_pf.scaling.rules import Sample

SETTINGS = ScalingSettings()
PERIOD_S = SETTINGS.period_s


def policy(*samples: tuple[float, float], **more: object) -> dict[str, object]:
    reported = [
        {"start_s": number * PERIOD_S, "cpu_percent": cpu, "requests": requests}
        for number, (cpu, requests) in enumerate(samples)
    ]
    return {"elastic": True, "samples": reported, "min_servers": 1, "max_servers": 8, **more}


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


def test_events_are_sentences_also_without_details_and_with_unknown_kinds() -> None:
    assert event_sentence({"event": "server-killed", "server": "server-1"}) == (
        "server-1 was killed by the operator"
    )
    assert event_sentence({"event": "replace", "server": "{by.__class__}"}).startswith("{by.__class__} is")
    assert event_sentence({"event": "new-kind", "server": "a"}) == "new kind: server a"
