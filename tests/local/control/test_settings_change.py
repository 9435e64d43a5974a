"""Which settings a roll may change, and what it says of the others."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.local.control.settings_change import settings_change

RUNNING = PlatformSettings().replace(local={"servers": 3}, services={"folder": "/installed"})


def test_options_of_the_start_stay_unless_the_file_sets_another_value() -> None:
    change = settings_change(RUNNING, PlatformSettings().replace(session={"max_in_flight": 4}))

    assert change.settings == RUNNING.replace(session={"max_in_flight": 4})
    assert change.words == (
        "session.max_in_flight = 4 (was 8)",
        "services.folder stays '/installed', which the file does not set",
        "local.servers stays 3, which the file does not set",
    )
    other = settings_change(RUNNING, PlatformSettings().replace(services={"folder": "/others"}))
    assert other.settings.services.folder == "/others"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "changes no setting"),
        ({"serving": {"port": 9000}, "data": {"port": 9001}}, "changes no setting"),
        ({"cloud": {"region": "eu-central-1"}, "batch": {"pairs_per_part": 30}}, "changes no setting"),
        ({"local": {"port": 9000}}, "local.port needs a restart"),
        (
            {"health": {"unhealthy_checks": 3}, "session": {"max_in_flight": 4}},
            "health.unhealthy_checks needs",
        ),
        (
            {"scaling": {"max_servers": 4}, "data": {"store": "dir:x"}},
            "scaling.max_servers, data.store need a restart",
        ),
    ],
)
def test_what_a_roll_cannot_change_is_refused_by_name(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said) as caught:
        settings_change(RUNNING, PlatformSettings().replace(**changes))
    assert caught.value.hint
