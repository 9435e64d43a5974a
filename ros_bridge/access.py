"""The connection of a bridge to the platform: by address and a file with a token, or by an enrolment."""

from __future__ import annotations

from pathlib import Path

from client_sdk.robot import Robot, connect
from client_sdk.transfer.data_client import DataClient
from ros_bridge.options import BridgeOptions
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["connect_robot", "data_client"]


def data_client(options: BridgeOptions) -> DataClient:
    """Return a client of the data service; raises UsageError if the file of the enrolment cannot be read."""
    if options.enrolment:
        return DataClient.enrolled(options.enrolment)
    return DataClient(options.url, lambda: _read_token(Path(options.token_file)))


def connect_robot(options: BridgeOptions) -> Robot:
    """Return the robot with the token or enrolment in *options*, not connected yet.

    Raises:
        UsageError: The options name neither address and token nor an enrolment, or the file cannot be read.
    """
    if options.enrolment:
        return connect(enrolment=options.enrolment, on_change=_log_change)
    if not (options.url and options.token_file):
        raise UsageError(
            "the bridge needs a platform: url and token_file, or enrolment",
            hint="rse-pf local prints the address; rse-pf token issue ROBOT issues a token",
        )
    file = Path(options.token_file)
    _read_token(file)  # raises the error of an unreadable file now, not after several attempts to connect

    async def token() -> str:
        return _read_token(file)

    return connect(options.url, token=token, on_change=_log_change)


def _read_token(file: Path) -> str:
    """Return the token in *file*; raises UsageError, which names file and cause, but none of the content."""
    try:
        token = file.read_text(encoding="ascii").strip()
        cause = "" if token else "it is empty"
    except OSError as error:
        token, cause = "", error.strerror or type(error).__name__
    except UnicodeDecodeError:
        token, cause = "", "it holds other characters than ASCII"
    if cause:
        raise UsageError(
            f"cannot read the token in {file.absolute()}: {cause}",
            hint="give the whole path of a file that rse-pf token issue ROBOT wrote",
        )
    return token


def _log_change(what: str, why: str) -> None:
    """Print that the connection was lost, with the reason, or restored, with the name of the server."""
    if what == "link-lost":
        show(f"connection lost: {why}")
    elif what == "link-back":
        show(f"connected again, to {why}")
