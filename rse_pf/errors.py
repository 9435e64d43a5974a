"""The errors of the platform: one base class, stable wire codes, and a hint that is an action.

This module imports nothing of the platform, so that every other one can use it.
"""

from __future__ import annotations

from typing import ClassVar

__all__ = [
    "AuthError",
    "BadMessage",
    "BadRequest",
    "Busy",
    "Cancelled",
    "CommandFailed",
    "ConfigurationError",
    "Conflict",
    "ConnectError",
    "Crashed",
    "DegenerateGeometry",
    "Disconnected",
    "Expired",
    "Forbidden",
    "InternalError",
    "InvalidCamera",
    "LimitExceeded",
    "MissingExtra",
    "NoConsensus",
    "NotFound",
    "PnpError",
    "Poison",
    "ProtocolError",
    "QuotaExceeded",
    "RsePfError",
    "SettingsError",
    "Stale",
    "StoreError",
    "StoreFull",
    "TooFewCorrespondences",
    "Unauthorized",
    "UnknownService",
    "UnsupportedProtocol",
    "UsageError",
    "WorkerLost",
    "error_from_code",
]


class RsePfError(Exception):
    """Base of every error that leaves this package.

    ``code`` is stable and travels on the wire; ``hint`` says what to do next.  A subclass without a code of
    its own has that of its base.
    """

    code: ClassVar[str] = "error"

    def __init_subclass__(cls, *, code: str = "") -> None:
        super().__init_subclass__()
        if code:
            cls.code = code
        _KIND_OF_CODE.setdefault(cls.code, cls)

    def __init__(self, message: str, *, hint: str = "", retry_after_ms: float | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.retry_after_ms = retry_after_ms

    def __str__(self) -> str:
        return self.message

    def __reduce__(self) -> tuple[object, ...]:
        return _bare, (type(self), self.message), self.__dict__

    def report(self) -> str:
        """Return the two lines shown to a user: what is wrong, and what to do."""
        first = f"{type(self).__name__}: {self.message}"
        return f"{first}\n  hint: {self.hint}" if self.hint else first


_KIND_OF_CODE = {RsePfError.code: RsePfError}


# --- mistakes of the operator or the developer -------------------------------------------


class ConfigurationError(RsePfError, code="configuration"):
    """The configuration or the call is invalid; nothing was started."""


class SettingsError(ConfigurationError, code="settings"):
    """A setting is unknown, out of range or contradicts another one."""


class UsageError(ConfigurationError, code="usage"):
    """A command line, path or argument cannot be used."""


class MissingExtra(ConfigurationError, code="missing-extra"):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed", hint=f"pip install 'rse-pf[{extra}]'")


# --- authentication --------------------------------------------------------------------------------


class AuthError(RsePfError, code="auth"):
    """A robot cannot be authenticated or is not authorized."""


class Unauthorized(AuthError, code="unauthorized"):
    """The token is missing, wrong or expired; the cause is only in the server's log."""


class Forbidden(AuthError, code="forbidden"):
    """The robot is known, but its token does not allow this."""


# --- the wire --------------------------------------------------------------------------------


class ProtocolError(RsePfError, code="protocol"):
    """Bytes or messages break the protocol of ``docs/protocol.md``."""


class BadMessage(ProtocolError, code="bad-message"):
    """A message cannot be decoded."""


class LimitExceeded(ProtocolError, code="too-large"):
    """A message is larger, deeper or longer than a limit allows."""


class UnsupportedProtocol(ProtocolError, code="unsupported"):
    """The two sides share no sub-protocol or version."""


class ConnectError(ProtocolError, code="connect"):
    """The robot could not open or keep a connection."""


class Disconnected(ProtocolError, code="disconnected"):
    """The connection ended before the answer came."""


# --- a command that was not answered with a result ---------------------------------------------


class CommandFailed(RsePfError, code="failed"):
    """A command ended without a result."""


class BadRequest(CommandFailed, code="bad-request"):
    """The payload does not fit the service's request type."""


class UnknownService(CommandFailed, code="unknown-service"):
    """The server offers no service of that name."""


class Busy(CommandFailed, code="busy"):
    """The server sheds load; retry after ``retry_after_ms``."""


class QuotaExceeded(CommandFailed, code="quota"):
    """This robot or tenant exceeds its quota."""


class Stale(CommandFailed, code="stale"):
    """A newer frame of the same stream replaced this one."""


class Expired(CommandFailed, code="expired"):
    """The deadline passed before the work began or the answer came."""


class Cancelled(CommandFailed, code="cancelled"):
    """The robot or the operator cancelled the command."""


class WorkerLost(CommandFailed, code="worker-lost"):
    """The process that worked on the command died."""


class Crashed(CommandFailed, code="crashed"):
    """The process of the command crashed, or exceeded its limit of memory or time."""


class Poison(CommandFailed, code="poison"):
    """This request crashed two sandboxes and is not tried again within ten minutes."""


class InternalError(CommandFailed, code="internal"):
    """A defect of the service or the server; the log has the details under the trace id."""


# --- perspective-n-point -----------------------------------------------------------------------


class PnpError(RsePfError, code="pnp"):
    """The correspondences give no reliable pose."""


class TooFewCorrespondences(PnpError, code="too-few"):
    """Fewer correspondences than a pose needs."""


class DegenerateGeometry(PnpError, code="degenerate"):
    """The points do not fix a pose: collinear, coincident or ambiguous."""


class NoConsensus(PnpError, code="no-consensus"):
    """No pose agrees with more correspondences than chance would give."""


class InvalidCamera(PnpError, code="invalid-camera"):
    """The camera's intrinsics describe no camera."""


# --- objects -----------------------------------------------------------------------------------


class StoreError(RsePfError, code="store"):
    """An object cannot be read or written."""


class NotFound(StoreError, code="not-found"):
    """No object of that name is visible to this robot."""


class Conflict(StoreError, code="conflict"):
    """A compare-and-swap found a version other than the expected one."""


class StoreFull(StoreError, code="store-full"):
    """The disk or the quota is full; nothing was stored."""


def error_from_code(
    code: str, message: str, *, hint: str = "", retry_after_ms: float | None = None
) -> RsePfError:
    """Return the error that *code* stands for; an unknown code gives ``CommandFailed``."""
    error = _bare(_KIND_OF_CODE.get(code, CommandFailed), message)
    error.hint, error.retry_after_ms = hint, retry_after_ms
    return error


def _bare(kind: type[RsePfError], message: str) -> RsePfError:
    """Return an error of *kind* without calling its constructor, whose arguments are not sent."""
    error = kind.__new__(kind)
    RsePfError.__init__(error, message)
    return error
