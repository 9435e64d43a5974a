"""The errors of the platform: one base class, stable wire codes, and a hint that is an action.

The docstring of each error says its cause, what to check and how to fix it; ``docs/errors.md`` and
``rse-pf errors CODE`` show these texts.  This module imports nothing of the platform, so that every other
one can use it.
"""

from __future__ import annotations

import errno
from pathlib import Path
from typing import ClassVar

__all__ = [
    "ERRORS_PAGE",
    "Archived",
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
    "DeploymentFailed",
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
    "StoreRefused",
    "TooFewCorrespondences",
    "Unauthorized",
    "UnknownService",
    "UnsupportedProtocol",
    "UsageError",
    "WorkerLost",
    "error_from_code",
    "error_of_system",
    "message_of",
]

ERRORS_PAGE = "docs/errors.md"
"""Path of the documentation page about all errors; each error code is an anchor on this page."""


class RsePfError(Exception):
    """Base of every error that leaves this package.

    ``code`` is stable and travels on the wire; ``hint`` says what to do next.  A subclass without a code of
    its own has that of its base.

    Cause: An error without a more exact code; its message says what happened.
    Check: Read the message and the hint.
    Fix: Do what the hint says; if there is none, report the message with the version of rse-pf.
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
        """Return the message, the hint (if there is one) and `address`, one line each, for tracebacks."""
        lines = [self.message, f"  hint: {self.hint}"] if self.hint else [self.message]
        return "\n".join([*lines, f"  see: {self.address()}"])

    def __reduce__(self) -> tuple[object, ...]:
        return _bare, (type(self), self.message), self.__dict__

    @classmethod
    def address(cls) -> str:
        """Return where a user finds the explanation of the code.

        Example: ``docs/errors.md#busy, or run: rse-pf errors busy``.
        """
        return f"{ERRORS_PAGE}#{cls.code}, or run: rse-pf errors {cls.code}"

    def report(self) -> str:
        """Return what a user sees: the class and the message, then a line with the hint if there is one."""
        first = f"{type(self).__name__}: {self.message}"
        return f"{first}\n  hint: {self.hint}" if self.hint else first


# The class of the error with each code; a subclass without a code of its own is not entered.
_KIND_OF_CODE = {RsePfError.code: RsePfError}


# --- errors of configuration and usage, which the operator or developer corrects ----------


class ConfigurationError(RsePfError, code="configuration"):
    """The configuration or the call is invalid; nothing was started.

    Cause: Two options contradict each other, or a file or key that the call needs is missing or damaged.
    Check: Read which option, file or key the message names.
    Fix: Correct it, then start the command again; nothing has to be undone.
    """


class SettingsError(ConfigurationError, code="settings"):
    """A setting is unknown, out of range or contradicts another one.

    Cause: The settings file, or an option that is a setting, has an unknown name or a refused value.
    Check: Run rse-pf settings GROUP: it shows each setting with its value, default and unit.
    Fix: Correct the named setting in cdk.json, context."rse-pf", in the file of --settings, or in the
        option.
    """


class UsageError(ConfigurationError, code="usage"):
    """A command line, path or argument cannot be used.

    Cause: An option or argument has a wrong form, or names a file, folder or platform that does not exist.
    Check: Compare the call with rse-pf VERB --help, and the path with what ls shows.
    Fix: Correct the option, argument or path that the message names.
    """


class MissingExtra(ConfigurationError, code="missing-extra"):
    """An optional dependency is not installed.

    Cause: A package that only some users need is not installed in this Python environment.
    Check: Run rse-pf doctor: it lists every extra, what it enables, and what is missing.
    Fix: Install the extra with the pip command of the hint, in the environment that runs rse-pf.
    """

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(
            f"{package} is not installed: it is in the extra {extra!r}",
            hint=self.command(extra),
        )

    @staticmethod
    def command(*extras: str) -> str:
        """Return the command that installs *extras* here; rse-pf itself is on no package index.

        pip takes the extras of an rse-pf that is installed, from a wheel or a checkout, from its metadata.
        A checkout that is only on the path has none, so the command names it.
        """
        from importlib import metadata

        chosen = f"[{','.join(extras)}]" if extras else ""
        try:
            metadata.distribution("rse-pf")
        except metadata.PackageNotFoundError:
            return f"pip install -e '{Path(__file__).parents[1]}{chosen}'"
        return f"pip install 'rse-pf{chosen}'" if chosen else "pip install rse-pf"


# --- errors of authentication and authorization ----------------------------------------------------


class AuthError(RsePfError, code="auth"):
    """A robot cannot be authenticated or is not authorized.

    Cause: A token, a key or the roster of enrolled robots does not let this robot in.
    Check: Run rse-pf audit show --only refused, which names the reason, and rse-pf robot list.
    Fix: Issue a new token, or enrol or enable the robot.
    """


class Unauthorized(AuthError, code="unauthorized"):
    """The token is missing, wrong or expired; only a robot with an enrolled key learns the cause.

    Cause: There is no token, or it is expired, revoked, damaged or signed with a key that the platform
        does not know; or the robot is disabled, or its clock is wrong.
    Check: Run rse-pf audit show --only refused: it names the reason. For a token, rse-pf token inspect TOKEN
        shows the seconds that are left. A robot that signs with the key that is enrolled now gets the cause.
    Fix: Issue a new token with rse-pf token issue ROBOT, or enrol the robot and use the new file; for runs of
        over 15 minutes without enrolment pass an async function that returns a fresh token. A robot that was
        connected tries again by itself.
    """


class Forbidden(AuthError, code="forbidden"):
    """The robot is known, but its token does not allow this.

    Cause: The robot is disabled, or the scopes of its token or of its entry in the roster do not allow the
        service.
    Check: Run rse-pf robot list, and rse-pf token inspect TOKEN: both show the scopes.
    Fix: Enable the robot, or enrol it or issue its token with the scope that it needs, such as services:pnp.
    """


# --- errors of messages and connections of the robot protocol ----------------------------------


class ProtocolError(RsePfError, code="protocol"):
    """Bytes or messages break the protocol of ``docs/protocol.md``.

    Cause: One side sent what the protocol does not allow at this point.
    Check: Compare the messages of your client with docs/protocol.md and its golden messages.
    Fix: Correct the client; with the Python SDK, install the version of the platform on the robot.
    """


class BadMessage(ProtocolError, code="bad-message"):
    """A message cannot be decoded.

    Cause: A message is not valid MessagePack or JSON, is not compressed as agreed, or lacks a field.
    Check: Compare the message with the golden messages in tests/wire/golden, and the sub-protocol with the
        codec.
    Fix: Correct the encoder of the client, or request the sub-protocol that it speaks.
    """


class LimitExceeded(ProtocolError, code="too-large"):
    """A message is larger, deeper or longer than a limit allows.

    Cause: A message has more bytes, levels or values than the server accepts, before or after decompression.
    Check: Compare both numbers of the message with rse-pf settings session.
    Fix: Send fewer matches, or store large data through the data service and send its reference.
    """


class UnsupportedProtocol(ProtocolError, code="unsupported"):
    """Robot and server have no sub-protocol or version of the protocol in common.

    Cause: The server does not offer the requested sub-protocol, or the address is not one of RSE-PF.
    Check: Check the address and its path /ws, and that robot and server have the same major version.
    Fix: Correct the address, choose another codec, or upgrade the older side.
    """


class ConnectError(ProtocolError, code="connect"):
    """The robot could not open or keep a connection.

    Cause: No platform answers at the address, it is full, or a firewall, proxy or login page is in between.
    Check: Run rse-pf local status on the platform, and compare its address with that of the robot.
    Fix: Start the platform with rse-pf local, correct the address, or try later if it is full.
    """


class Disconnected(ProtocolError, code="disconnected"):
    """The connection ended before the answer came.

    Cause: The connection was lost or closed, and the command did not survive the reconnection.
    Check: Look at robot.stats: reconnects and last_error name the reason.
    Fix: Send the command again on the next connection; keep the robot open while calls run.
    """


# --- errors that are the answer to a command in place of a result -------------------------------


class CommandFailed(RsePfError, code="failed"):
    """A command ended without a result.

    Cause: The service or the platform ended the command, with the reason in the message.
    Check: Read the message; the server's log has the details under the trace id of the command.
    Fix: Correct the request, or report the trace id to the operator of the service.
    """


class BadRequest(CommandFailed, code="bad-request"):
    """The payload does not fit the service's request type.

    Cause: A field of the request is missing, has a wrong type, or has a value that the service refuses.
    Check: Compare the request with the request type of the service: docs/protocol.md, section 3, or its
        source.
    Fix: Send the field that the message names in the form that it asks for.
    """


class UnknownService(CommandFailed, code="unknown-service"):
    """The server offers no service of that name.

    Cause: The name is misspelt, or the service is not installed on the servers of this platform.
    Check: Compare the name with the services that the message lists.
    Fix: Correct the name, or install the service: rse-pf service install FOLDER, then rse-pf local
        --services.
    """


class Busy(CommandFailed, code="busy"):
    """The server sheds load; retry after ``retry_after_ms``.

    Cause: More commands arrive than the servers can answer within their deadlines.
    Check: Run rse-pf local status for CPU time and queues; held_back in robot.stats says what waited.
    Fix: Wait retry_after_ms before the next command, lower the frame rate, or add servers.
    """


class QuotaExceeded(CommandFailed, code="quota"):
    """This robot or tenant exceeds its quota.

    Cause: The message names the limit: commands (the robot sends faster than its rate limit, or it or its
        tenant has too many commands waiting), or stored bytes (the robot or its tenant would store more than
        its quota; each object counts as 4096 bytes at least).
    Check: For commands compare the rate of the robot with rse-pf settings session and rse-pf settings
        serving; for bytes see rse-pf tenant list and, for quotas of robots, rse-pf robot list --json.
    Fix: For commands wait retry_after_ms and send less often. For bytes delete objects or remove old versions
        of maps (rse-pf map prune), or raise the quota: rse-pf tenant quota, rse-pf robot quota, or the
        setting that the message names.
    """


class Stale(CommandFailed, code="stale"):
    """A newer frame of the same stream replaced this one.

    Cause: The command belongs to a stream, and a newer frame arrived before this one was begun.
    Check: Look at queue_ms in robot.stats: frames arrive faster than they are answered.
    Fix: Nothing for live tracking, which wants the newest frame; pass keep=True for frames that must be
        answered.
    """


class Expired(CommandFailed, code="expired"):
    """The deadline passed before the work began or the answer came.

    Cause: The network, the queue or the service took longer than the deadline of the command.
    Check: Compare round_trip_ms, queue_ms and compute_ms in robot.stats with deadline_s.
    Fix: Raise deadline_s, send less often, add servers, or let the robot answer itself:
        offload=CloudFirst().
    """


class Cancelled(CommandFailed, code="cancelled"):
    """The robot or the operator cancelled the command.

    Cause: The call was cancelled on the robot, or an operator ended the job.
    Check: Look for a cancelled task or a timeout in the robot's program.
    Fix: Send the command again if its result is still needed.
    """


class WorkerLost(CommandFailed, code="worker-lost"):
    """The process that worked on the command was killed or exited before it answered.

    Cause: A worker process or its server was killed, or ran out of memory.
    Check: Look at the server's log, and at the kernel's log for out of memory: dmesg.
    Fix: Send the command again; another worker has taken over.
    """


class Crashed(CommandFailed, code="crashed"):
    """The process of the command crashed, or exceeded its limit of memory or time.

    Cause: The service's process ended by a signal, or exceeded its memory or twice its deadline.
    Check: Repeat the request on your machine with rse-pf service test FOLDER: it shows what the process
        wrote.
    Fix: Correct the service, or raise the limit that the message names: rse-pf settings services.
    """


class Poison(CommandFailed, code="poison"):
    """This request ended the processes that computed it, and is refused for a while.

    Cause: Two sandboxes crashed on it (refused for ten minutes), or three servers failed while they ran its
        job (refused for a week).
    Check: Run rse-pf service status: it shows what sandboxes refuse, to whom and for how long.
    Fix: Correct the service, install it again and run rse-pf service unblock SERVICE; for a job, send less,
        or delete the object that the hint names.
    """


class InternalError(CommandFailed, code="internal"):
    """A defect of the service or the server; the log has the details under the trace id.

    Cause: The service or the server raised an error that it did not expect.
    Check: Look in the server's log for the trace id of the command: the traceback is there.
    Fix: Correct the service; if the traceback is in rse_pf, report it with the request.
    """


# --- errors of perspective-n-point (PnP): a frame gets no pose ------------------------------------


class PnpError(RsePfError, code="pnp"):
    """The correspondences give no reliable pose.

    Cause: The matches of the frame do not determine the camera's pose.
    Check: Compare matches and inliers with earlier frames, and the intrinsics with the image.
    Fix: Skip the frame, or change the front end as the hint says.
    """


class TooFewCorrespondences(PnpError, code="too-few"):
    """Fewer correspondences than a pose needs.

    Cause: The image shows little texture, is blurred, or overlaps little with the map.
    Check: Count the features and the matches of the frame.
    Fix: Skip the frame, move more slowly, raise the frame rate, or use the wide-baseline front end.
    """


class DegenerateGeometry(PnpError, code="degenerate"):
    """The points do not fix a pose: collinear, coincident or ambiguous.

    Cause: The matched points lie on a line or at one place, so that several poses fit.
    Check: Plot the matched pixels: they lie in one corner or on one edge.
    Fix: Skip the frame, or spread the features over the image.
    """


class NoConsensus(PnpError, code="no-consensus"):
    """No pose agrees with more correspondences than chance would give.

    Cause: Most matches are wrong, or the intrinsics do not belong to the image.
    Check: Check fx, fy, cx, cy and the image size, and the unit of the points: metres.
    Fix: Correct the intrinsics, or use a stricter matcher; for frames far apart, the wide-baseline front
        end.
    """


class InvalidCamera(PnpError, code="invalid-camera"):
    """The camera's intrinsics describe no camera.

    Cause: A focal length or size is not positive, or the principal point is far outside of the image.
    Check: Print the camera: fx, fy, cx, cy, width and height are in pixels.
    Fix: Calibrate the camera again, or correct intrinsics.json.
    """


# --- errors of deployments on AWS, and of the object store -----------------------------------------


class DeploymentFailed(RsePfError, code="deployment"):
    """A step of rse-pf cloud up, park, resume, down or upgrade failed; what was done before it stays.

    Cause: CloudFormation or the CDK refused a stack, or servers did not become healthy or end in time.
    Check: Read the lines above the message, then rse-pf cloud status.
    Fix: Remove the cause that the message names, then repeat the same command: it continues.
    """


class StoreError(RsePfError, code="store"):
    """An object cannot be read or written.

    Cause: The disk or the bucket failed, or permissions forbid the access.
    Check: Check the folder or bucket of data.store: permissions, free space, mount.
    Fix: Correct the store, then try once more.
    """


class NotFound(StoreError, code="not-found"):
    """No object of that name is visible to this robot.

    Cause: The name is misspelt, the object belongs to another robot or tenant, or it was deleted.
    Check: List what there is, for maps with rse-pf map list.
    Fix: Correct the name, the tenant or the store.
    """


class Conflict(StoreError, code="conflict"):
    """A compare-and-swap found a version other than the expected one.

    Cause: Another writer changed the same object or map first, or a second connection took this robot's
        name.
    Check: Read the newest version, and check that no other process has the same token.
    Fix: Repeat the change on the newest version; give every robot a token of its own.
    """


class StoreFull(StoreError, code="store-full"):
    """The disk is full, or nearly full and the tenant uses more than its part of it; nothing was stored.

    Cause: The disk is full, or less than 10 % of it is free and the tenant stores more than an equal part.
    Check: Run df on the folder of data.store.
    Fix: Delete objects or maps of this tenant, or use a larger disk.
    """


class StoreRefused(StoreError, code="store-refused"):
    """The bucket refuses this server; no repetition helps until an operator has corrected it.

    Cause: The bucket does not exist, the server's credentials have expired or do not suffice, or its clock is
        wrong.
    Check: The message has the code of S3; compare data.store and the role's policy with the deployment.
    Fix: Follow the hint of the message, then try again.
    """


class Archived(StoreError, code="archived"):
    """The object is in an archive of S3, from which it cannot be read at once.

    Cause: A lifecycle rule, or an operator, moved it to the class GLACIER or DEEP_ARCHIVE.
    Check: Ask S3 for its class and the state of its restoration: aws s3api head-object.
    Fix: Restore it with aws s3api restore-object, wait for some hours, then copy it onto itself.
    """


def error_from_code(
    code: str, message: str, *, hint: str = "", retry_after_ms: float | None = None
) -> RsePfError:
    """Return an error of the class with this *code*, `CommandFailed` for an unknown code."""
    error = _bare(_KIND_OF_CODE.get(code, CommandFailed), message)
    error.hint, error.retry_after_ms = hint, retry_after_ms
    return error


def error_of_system(error: OSError) -> RsePfError:
    """Return the `RsePfError` for the OSError *error* of a system call.

    Its message holds the text of the errno and, if *error* has one, the file name.  Its class and hint are
    those of the errno in `_OF_SYSTEM`, else `RsePfError` and a general hint.
    """
    cause = error.strerror or str(error) or type(error).__name__
    named = "" if error.filename is None else f": {str(error.filename)!r}"
    kind, hint = _OF_SYSTEM.get(
        error.errno or 0, (RsePfError, "see what the system says about this file or address")
    )
    return kind(f"{cause}{named}", hint=hint)


# By errno of a failed system call: the class and the hint of the error that a user sees.
_OF_SYSTEM: dict[int, tuple[type[RsePfError], str]] = {
    errno.ENOSPC: (StoreFull, "free some space (df -h), or name a folder on another disk"),
    errno.EDQUOT: (StoreFull, "free some of your quota, or name a folder on another disk"),
    errno.EROFS: (RsePfError, "name a folder that can be written"),
    errno.EACCES: (RsePfError, "name a file that this user may use, or change its permissions"),
    errno.EPERM: (RsePfError, "this user may not do that: change its permissions, or name another file"),
    errno.EADDRINUSE: (RsePfError, "end the program that has this port, or choose another port"),
    errno.EADDRNOTAVAIL: (RsePfError, "name an address of this machine, such as 127.0.0.1"),
    errno.ECONNREFUSED: (ConnectError, "start the platform with rse-pf local, or correct the address"),
    errno.EMFILE: (RsePfError, "raise the limit of open files: ulimit -n 20000"),
    errno.ENOTDIR: (RsePfError, "a part of this path is a file: name a folder"),
    errno.EISDIR: (RsePfError, "this is a folder: name a file"),
    errno.ENAMETOOLONG: (RsePfError, "use a shorter name"),
}


def message_of(error: BaseException) -> str:
    """Return the message of *error*; of an `RsePfError` without its hint and its `address`."""
    return error.message if isinstance(error, RsePfError) else str(error)


def _bare(kind: type[RsePfError], message: str) -> RsePfError:
    """Return an error of the class *kind* with *message*, without a call of the constructor of *kind*.

    An error that was pickled or received has only its message, not the other arguments of the constructor.
    """
    error = kind.__new__(kind)
    RsePfError.__init__(error, message)
    return error
