"""How a bridge reaches the platform: by its address and a file with a token, or by an enrolment."""

from __future__ import annotations

from pathlib import Path

from client_sdk.robot import Robot, connect
from client_sdk.transfer.data_client import DataClient
from ros_bridge.options import BridgeOptions
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["connect_robot", "data_client"]


def data_client(options: BridgeOptions) -> DataClient:
    """Return a client of the data service; raises UsageError for a token or enrolment that cannot be read."""
    if options.enrolment:
        return DataClient.enrolled(options.enrolment)
    return DataClient(options.url, lambda: _read_token(Path(options.token_file)))


def connect_robot(options: BridgeOptions) -> Robot:
    """Return the robot that the options name, not connected yet; raises UsageError if they name none."""
    if options.enrolment:
        return connect(enrolment=options.enrolment, on_change=_log_change)
    if not (options.url and options.token_file):
        raise UsageError(
            "the bridge needs a platform: url and token_file, or enrolment",
            hint="rse-pf local prints the address; rse-pf token issue ROBOT issues a token",
        )
    file = Path(options.token_file)
    _read_token(file)  # a file that cannot be read is told at once, not after several attempts

    async def token() -> str:
        return _read_token(file)

    return connect(options.url, token=token, on_change=_log_change)


def _read_token(file: Path) -> str:
    """Return the token in a file; an error names the file and the cause, and nothing of what is in it."""
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
    """Say when the connection is lost and why, and when it is back."""
    if what == "link-lost":
        show(f"connection lost: {why}")
    elif what == "link-back":
        show(f"connected again, to {why}")
