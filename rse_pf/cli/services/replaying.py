"""Replay the recorded requests of a service in a sandbox, and compare the answers: rse-pf service test."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.output import format_output_line
from rse_pf.storage.files import read_document
from rse_pf.terminal import counted, show

__all__ = ["Recorded", "plain", "recorded_requests", "replay"]

Recorded = Sequence[tuple[str, Mapping[str, Any]]]
"""File name and content of each recorded request.

The content is a JSON object with ``request``, and the expected ``reply``, which may differ by ``tolerance``,
or the code of the expected ``failure``.
"""

# Tolerance of numbers in a reply, relative and absolute, if a recorded request states none.
_DEFAULT_TOLERANCE = 1e-9
# Name that stands for the robot before lines that the service prints in a test.
_DRY_RUN = "dry-run"
_HINT = 'write {"request": {...}, "reply": {...}}'
# Longest part of an unexpected reply that is printed, in characters.
_MOST_LETTERS = 300


def recorded_requests(source: Path) -> Recorded:
    """Return the recorded requests ``requests/*.json`` of the service in the folder *source*, sorted by name.

    Raises:
        UsageError: There are none, or a file holds no request.
    """
    requests: list[tuple[str, Mapping[str, Any]]] = []
    for path in sorted((source / "requests").glob("*.json")):
        requests.append((path.name, _read_request(path)))
    if not requests:
        raise UsageError(
            f"{source} has no recorded requests", hint=f"write one to {source / 'requests'}/NAME.json"
        )
    return requests


def replay(service: InstalledService, recorded: Recorded, settings: PlatformSettings) -> int:
    """Send *recorded* to *service* in one sandbox, and print for each whether the answer is as expected.

    Returns 1 if an answer is wrong, else 0.

    Args:
        service: The service, after its build.
        recorded: Requests, which are sent one after the other, as from one robot.
        settings: Settings with the limits of the sandbox.
    """
    from rse_pf.server.sandbox.dry_run import dry_run

    requests = [call["request"] for _, call in recorded]
    missing, runs = dry_run(
        service, requests, settings, lambda line: show(format_output_line(time.time(), _DRY_RUN, line))
    )
    if missing:
        show(f"note: this machine lacks isolation that a server has: {', '.join(missing)}")
    wrong = 0
    for (name, each), each_run in zip(recorded, runs, strict=True):
        problem, detail = _find_problem(each, each_run.answer)
        wrong += problem
        show(f"{name:<28} {'WRONG' if problem else 'ok':<6} {each_run.took_ms:8.1f} ms  {detail}".rstrip())
    show(f"{len(runs) - wrong} of {counted(len(runs), 'recorded request')} as expected")
    return 1 if wrong else 0


def plain(value: Any) -> Any:
    """Return *value* as it is after JSON: arrays become lists, and other objects their text."""
    return json.loads(json.dumps(value, default=lambda each: getattr(each, "tolist", each.__repr__)()))


def _read_request(path: Path) -> dict[str, Any]:
    """Return the content of a recorded request; raises UsageError if the file holds none."""
    found = read_document(path, "JSON", hint=_HINT)
    if not isinstance(found, dict) or "request" not in found:
        raise UsageError(f"{path} holds no request", hint=_HINT)
    return found


def _find_problem(expected: Mapping[str, Any], answer: Any) -> tuple[bool, str]:
    """Return whether *answer* differs from the *expected* reply or failure, and words about it for the line.

    A reply is right if the recorded request has neither ``reply`` nor ``failure``.
    """
    from rse_pf.wire import Failure

    if isinstance(answer, Failure):
        hint = f" ({answer.hint})" if answer.hint else ""
        return expected.get("failure") != answer.code, f"{answer.code}: {answer.message}{hint}"
    if "failure" in expected:
        return True, f"it was answered, expected {expected['failure']}"
    if "reply" not in expected:
        return False, f"no reply is expected; it is {_shorten(json.dumps(plain(answer.reply)))}"
    tolerance = expected.get("tolerance", _DEFAULT_TOLERANCE)
    difference = _difference(plain(answer.reply), plain(expected["reply"]), tolerance)
    return bool(difference), difference


def _shorten(text: str) -> str:
    return text if len(text) <= _MOST_LETTERS else f"{text[:_MOST_LETTERS]}..."


def _difference(got: Any, expected: Any, tolerance: float, path: str = "reply") -> str:
    """Return the first difference of *got* from *expected* in words, "" if there is none.

    Numbers may differ by *tolerance*, relative or absolute; *path* names the compared part in the words.
    """
    if isinstance(expected, dict) and isinstance(got, dict):
        if set(got) != set(expected):
            return f"{path} has {', '.join(sorted(got))}, expected {', '.join(sorted(expected))}"
        differences = (_difference(got[key], expected[key], tolerance, f"{path}.{key}") for key in expected)
        return next(filter(None, differences), "")
    if isinstance(expected, list) and isinstance(got, list):
        if len(got) != len(expected):
            return f"{path} has {len(got)} values, expected {len(expected)}"
        pairs = enumerate(zip(got, expected, strict=True))
        return next(filter(None, (_difference(g, e, tolerance, f"{path}[{i}]") for i, (g, e) in pairs)), "")
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (got, expected))
    equal = math.isclose(got, expected, rel_tol=tolerance, abs_tol=tolerance) if numbers else got == expected
    return "" if equal else f"{path} is {got!r}, expected {expected!r}"
