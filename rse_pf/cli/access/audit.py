"""Show the audit log of a platform.

Servers, the control plane, the data service and operators' commands write one log each: robots accepted,
refused and revoked, servers started and stopped, maps changed.  --cloud reads what the servers of the
deployment on AWS have sent to its bucket, where nobody can change it; --out keeps the files, so that they can
be shown again without AWS.

examples:
  rse-pf audit show --last 20
  rse-pf audit show --only revoke --json
  rse-pf audit show --cloud --only revoke --out logs
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import msgspec

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import audit_folder, log_files, log_names, read_logs
from rse_pf.cli.access.access_control import PlatformRequest
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["ACTION"]

# A value of an entry that is printed without quotes: printable ASCII without spaces.
_PLAIN = re.compile(r"[!-~]+")


@dataclass(frozen=True, kw_only=True)
class _ShowRequest(PlatformRequest):
    files: tuple[Path, ...] = option(nargs="*", default=(), metavar="FILE", help="files of logs, or a folder")
    out: Path | None = option("--out", metavar="FOLDER", help="with --cloud: keep the files here")
    last: int | None = option("--last", metavar="N", help="show only the newest N entries")
    only: str = option(
        "--only", metavar="WORD", default="", help="show only actions whose name contains this word"
    )
    json: bool = option("--json", help="print one JSON object for each entry")


def show_log(request: _ShowRequest, settings: PlatformSettings) -> None:
    """Print the entries of the audit logs of a local platform, of files, or with --cloud of the bucket."""
    if request.last is not None and request.last < 1:
        raise UsageError(f"--last {request.last} shows no entry", hint="give 1 or more")
    if request.cloud:
        _show_cloud(request, settings)
    elif request.out is not None:
        raise UsageError("--out is for --cloud", hint="the files of a local platform are in its folder")
    else:
        _show(request, _files(request))


def _show_cloud(request: _ShowRequest, settings: PlatformSettings) -> None:
    """Copy the logs in the bucket into --out, else into a temporary folder, and print their entries."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.audit_archive import fetch_audit, open_audit_archive

    if request.files:
        raise UsageError("--cloud and files exclude each other", hint="leave one of them out")
    if request.out is not None and request.out.exists() and any(request.out.iterdir()):
        raise UsageError(f"{request.out} is not empty", hint="name a new folder")
    archive = open_audit_archive(open_account(settings.cloud.region), ResourceNames(settings.cloud.name))
    with tempfile.TemporaryDirectory() as temporary:
        folder = request.out or Path(temporary)
        fetch_audit(archive, folder)
        files = _files_of_folder(folder)
        if not files:
            raise UsageError(
                "the bucket holds no audit log yet", hint="servers send the first within a minute"
            )
        _show(request, files)


def _show(request: _ShowRequest, files: Sequence[Path]) -> None:
    rows = [(who, entry) for who, entry in read_logs(files) if request.only in entry.action]
    for who, entry in rows if request.last is None else rows[-request.last :]:
        show(_json_line(who, entry) if request.json else _line(who, entry))


def _files(request: _ShowRequest) -> Sequence[Path]:
    """Return the log files that the command names, itself or by a folder, else those of the local platform.

    Raises:
        UsageError: A file does not exist, or the folder holds no audit log.
    """
    named = request.files
    for path in named:
        if not path.exists():
            raise UsageError(f"there is no {path}", hint="name files of logs, or a folder")
    if named and not named[0].is_dir():
        return named
    folder = named[0] if named else audit_folder(request.folder)
    files = _files_of_folder(folder)
    if not files:
        raise UsageError(
            f"there is no audit log in {folder}", hint="start rse-pf local, or name a folder or files"
        )
    return files


def _files_of_folder(folder: Path) -> list[Path]:
    return [path for who in log_names(folder) for path in log_files(folder, who)]


def _json_line(who: str, entry: Entry) -> str:
    return json.dumps({"log": who, **msgspec.structs.asdict(entry)})


def _line(who: str, entry: Entry) -> str:
    try:
        when = datetime.fromtimestamp(entry.time, timezone.utc).strftime("%Y-%m-%d %H:%M:%SZ")
    except (OverflowError, ValueError, OSError):  # no time that a server writes: the file was changed
        when = f"time={entry.time!r}"
    actor = [] if entry.actor == who else [f"by {_word(entry.actor)}"]
    subject = [_word(entry.subject)] if entry.subject else []
    details = [f"{_word(key)}={_word(value)}" for key, value in entry.detail.items()]
    return " ".join([when, who, _word(entry.action), *subject, *actor, *details])


def _word(value: object) -> str:
    """Return *value* as one word of a line: in JSON quotes if it has spaces or unprintable characters."""
    text = str(value)
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)


ACTION = Action(
    actions={
        "show": Action(
            help="show the entries of the audit log",
            example="rse-pf audit show --last 20",
            request=_ShowRequest,
            run=show_log,
        )
    }
)
