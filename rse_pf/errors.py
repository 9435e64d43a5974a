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

    ``code`` is stable and travels on the wire; ``hint`` says what to do next.
    """

    code: ClassVar[str] = "error"

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


# --- mistakes of the operator or the developer -------------------------------------------


class ConfigurationError(RsePfError):
    """The configuration or the call is invalid; nothing was started."""

    code = "configuration"


class SettingsError(ConfigurationError):
    """A setting is unknown, out of range or contradicts another one."""

    code = "settings"


class UsageError(ConfigurationError):
    """A command line, path or argument cannot be used."""

    code = "usage"


class MissingExtra(ConfigurationError):
    """An optional dependency is not installed."""

    code = "missing-extra"

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed", hint=f"pip install 'rse-pf[{extra}]'")


# --- authentication --------------------------------------------------------------------------------


class AuthError(RsePfError):
    """A robot cannot be authenticated or is not authorized."""

    code = "auth"


class Unauthorized(AuthError):
    """The token is missing, wrong or expired; the cause is only in the server's log."""

    code = "unauthorized"


class Forbidden(AuthError):
    """The robot is known, but its token does not allow this."""

    code = "forbidden"


# --- the wire --------------------------------------------------------------------------------


class ProtocolError(RsePfError):
    """Bytes or messages break the protocol of ``docs/protocol.md``."""

    code = "protocol"


class BadMessage(ProtocolError):
    """A message cannot be decoded."""

    code = "bad-message"


class LimitExceeded(ProtocolError):
    """A message is larger, deeper or longer than a limit allows."""

    code = "too-large"


class UnsupportedProtocol(ProtocolError):
    """The two sides share no sub-protocol or version."""

    code = "unsupported"


class ConnectError(ProtocolError):
    """The robot could not open or keep a connection."""

    code = "connect"


class Disconnected(ProtocolError):
    """The connection ended before the answer came."""

    code = "disconnected"


# --- a command that was not answered with a result ---------------------------------------------


class CommandFailed(RsePfError):
    """A command ended without a result."""

    code = "failed"


class BadRequest(CommandFailed):
    """The payload does not fit the service's request type."""

    code = "bad-request"


class UnknownService(CommandFailed):
    """The server offers no service of that name."""

    code = "unknown-service"


class Busy(CommandFailed):
    """The server sheds load; retry after ``retry_after_ms``."""

    code = "busy"


class QuotaExceeded(CommandFailed):
    """This robot or tenant exceeds its quota."""

    code = "quota"


class Stale(CommandFailed):
    """A newer frame of the same stream replaced this one."""

    code = "stale"


class Expired(CommandFailed):
    """The deadline passed before the work began or the answer came."""

    code = "expired"


class Cancelled(CommandFailed):
    """The robot or the operator cancelled the command."""

    code = "cancelled"


class WorkerLost(CommandFailed):
    """The process that worked on the command died."""

    code = "worker-lost"


class Crashed(CommandFailed):
    """The process of a long command crashed, or exceeded its memory limit."""

    code = "crashed"


class Poison(CommandFailed):
    """This request crashed two sandboxes and is not tried again."""

    code = "poison"


class InternalError(CommandFailed):
    """A defect of the service or the server; the log has the details under the trace id."""

    code = "internal"


# --- perspective-n-point -----------------------------------------------------------------------


class PnpError(RsePfError):
    """The correspondences give no reliable pose."""

    code = "pnp"


class TooFewCorrespondences(PnpError):
    """Fewer correspondences than a pose needs."""

    code = "too-few"


class DegenerateGeometry(PnpError):
    """The points do not fix a pose: collinear, coincident or ambiguous."""

    code = "degenerate"


class NoConsensus(PnpError):
    """No pose agrees with more correspondences than chance would give."""

    code = "no-consensus"


class InvalidCamera(PnpError):
    """The camera's intrinsics describe no camera."""

    code = "invalid-camera"


# --- objects -----------------------------------------------------------------------------------


class StoreError(RsePfError):
    """An object cannot be read or written."""

    code = "store"


class NotFound(StoreError):
    """No object of that name is visible to this robot."""

    code = "not-found"


class Conflict(StoreError):
    """A compare-and-swap found a version other than the expected one."""

    code = "conflict"


class StoreFull(StoreError):
    """The disk or the quota is full; nothing was stored."""

    code = "store-full"


def _leaves(of: type[RsePfError]) -> dict[str, type[RsePfError]]:
    found = {of.code: of}
    for child in of.__subclasses__():
        for code, kind in _leaves(child).items():
            found.setdefault(code, kind)  # a package's own subclass has no code of its own
    return found


def error_from_code(
    code: str, message: str, *, hint: str = "", retry_after_ms: float | None = None
) -> RsePfError:
    """Return the error that *code* stands for; an unknown code gives ``CommandFailed``."""
    error = _bare(_leaves(RsePfError).get(code, CommandFailed), message)
    error.hint, error.retry_after_ms = hint, retry_after_ms
    return error


def _bare(kind: type[RsePfError], message: str) -> RsePfError:
    """Return an error of *kind* without calling its constructor, whose arguments are not sent."""
    error = kind.__new__(kind)
    RsePfError.__init__(error, message)
    return error
