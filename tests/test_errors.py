"""The exception tree: stable codes, and reports that say what to do."""

from __future__ import annotations

import errno
import pickle
from importlib import metadata
from pathlib import Path

import pytest

from rse_pf import errors
from rse_pf.errors import (
    MissingExtra,
    RsePfError,
    error_from_code,
    error_of_system,
)

CODES = {
    "Archived": "archived",
    "AuthError": "auth",
    "BadMessage": "bad-message",
    "BadRequest": "bad-request",
    "Busy": "busy",
    "Cancelled": "cancelled",
    "CommandFailed": "failed",
    "ConfigurationError": "configuration",
    "Conflict": "conflict",
    "ConnectError": "connect",
    "Crashed": "crashed",
    "DegenerateGeometry": "degenerate",
    "DeploymentFailed": "deployment",
    "Disconnected": "disconnected",
    "Expired": "expired",
    "Forbidden": "forbidden",
    "InternalError": "internal",
    "InvalidCamera": "invalid-camera",
    "LimitExceeded": "too-large",
    "MissingExtra": "missing-extra",
    "NoConsensus": "no-consensus",
    "NotFound": "not-found",
    "PnpError": "pnp",
    "Poison": "poison",
    "ProtocolError": "protocol",
    "QuotaExceeded": "quota",
    "RsePfError": "error",
    "SettingsError": "settings",
    "Stale": "stale",
    "StoreError": "store",
    "StoreFull": "store-full",
    "StoreRefused": "store-refused",
    "TooFewCorrespondences": "too-few",
    "Unauthorized": "unauthorized",
    "UnknownService": "unknown-service",
    "UnsupportedProtocol": "unsupported",
    "UsageError": "usage",
    "WorkerLost": "worker-lost",
}
"""Codes are on the wire: an entry may be added, never changed."""

KINDS = [getattr(errors, name) for name in errors.__all__ if name[0].isupper() and name != "ERRORS_PAGE"]


def test_every_error_keeps_its_code() -> None:
    assert {kind.__name__: kind.code for kind in KINDS} == CODES


def test_no_two_errors_share_a_code() -> None:
    assert len({kind.code for kind in KINDS}) == len(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_code_gives_its_error_back_with_all_it_carried(kind: type[RsePfError]) -> None:
    error = error_from_code(kind.code, "what went wrong", hint="do this", retry_after_ms=20.0)

    assert type(error) is kind
    assert (error.message, error.hint, error.retry_after_ms) == ("what went wrong", "do this", 20.0)


def test_an_exception_shows_message_hint_and_the_address_of_its_code() -> None:
    assert str(errors.Busy("too much", hint="send less")) == (
        "too much\n  hint: send less\n  see: docs/errors.md#busy, or run: rse-pf errors busy"
    )
    assert str(errors.Stale("a newer frame came")).splitlines() == [
        "a newer frame came",
        "  see: docs/errors.md#stale, or run: rse-pf errors stale",
    ]


def test_a_report_is_what_is_wrong_and_then_what_to_do() -> None:
    error = errors.TooFewCorrespondences(
        "got 3 correspondences, a pose needs at least 4", hint="loosen the matcher, or skip this frame"
    )

    assert error.report() == (
        "TooFewCorrespondences: got 3 correspondences, a pose needs at least 4\n"
        "  hint: loosen the matcher, or skip this frame"
    )


def test_a_missing_extra_names_the_extra_and_the_pip_command() -> None:
    assert MissingExtra("picows", "backend").report() == (
        "MissingExtra: picows is not installed: it is in the extra 'backend'\n"
        "  hint: pip install 'rse-pf[backend]'"
    )


def test_a_checkout_that_is_not_installed_is_named_in_the_pip_command(
    monkeypatch: pytest.MonkeyPatch, repository: Path
) -> None:
    def nothing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", nothing)

    assert MissingExtra("picows", "backend").hint == f"pip install -e '{repository}[backend]'"
    assert MissingExtra.command() == f"pip install -e '{repository}'"


@pytest.mark.parametrize("error", [errors.Busy("m", hint="h", retry_after_ms=1.0), MissingExtra("a", "b")])
def test_an_error_survives_the_way_between_processes(error: RsePfError) -> None:
    copy = pickle.loads(pickle.dumps(error))

    assert type(copy) is type(error)
    assert (copy.message, copy.hint, copy.retry_after_ms) == (
        error.message,
        error.hint,
        error.retry_after_ms,
    )


@pytest.mark.parametrize(
    ("number", "kind", "hint"),
    [
        (errno.ENOSPC, errors.StoreFull, "free some space"),
        (errno.EACCES, RsePfError, "permissions"),
        (errno.EADDRINUSE, RsePfError, "another port"),
        (errno.ECONNREFUSED, errors.ConnectError, "rse-pf local"),
        (errno.EIO, RsePfError, "see what the system says"),
    ],
)
def test_what_the_system_refuses_has_a_hint_that_fits(number: int, kind: type[RsePfError], hint: str) -> None:
    error = error_of_system(OSError(number, "Refused", "out/map.ply"))

    assert type(error) is kind
    assert error.message == "Refused: 'out/map.ply'"
    assert hint in error.hint
