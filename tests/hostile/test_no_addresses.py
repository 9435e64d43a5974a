"""No message of a robot carries an address: servers fetch nothing on a stranger's word (T14)."""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.services.builtin import builtin_services
from rse_pf.wire.messages import FromRobot

_ADDRESS = re.compile(r"url|uri|host|port$|bucket|endpoint|address|path$|file", re.IGNORECASE)


def fields(kind: object, seen: set[object]) -> Iterator[str]:
    """Yield the names of all fields of *kind* and of what they hold."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        if kind not in seen:
            seen.add(kind)
            for name, held in typing.get_type_hints(kind, include_extras=False).items():
                yield f"{kind.__name__}.{name}"
                yield from fields(held, seen)
        return
    for part in typing.get_args(kind):
        yield from fields(part, seen)


def addresses(*kinds: object) -> list[str]:
    """Return the fields of *kinds* whose names are those of addresses."""
    return [name for kind in kinds for name in fields(kind, set()) if _ADDRESS.search(name.partition(".")[2])]


def test_no_message_and_no_request_has_a_field_for_an_address() -> None:
    requests = [service.request_type for service in builtin_services(PlatformSettings())]

    assert addresses(FromRobot, *requests) == []
    assert sum(1 for kind in requests for _ in fields(kind, set())) > 30
