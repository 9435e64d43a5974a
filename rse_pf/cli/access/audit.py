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

import argparse
import json
import os
import re
import tempfile
from datetime import datetime, timezone
from pathlib import Path

import msgspec

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import audit_folder, log_files, log_names, read_logs
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import show

__all__ = ["add_arguments", "run"]

_NAME = "default"
_PLAIN = re.compile(r"[!-~]+")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=("show",), help="what to do")
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="files of logs, or a folder")
    parser.add_argument("--name", default=_NAME, help=f"which local platform (default: {_NAME})")
    parser.add_argument("--cloud", action="store_true", help="the deployment on AWS in cloud.region")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="with --cloud: keep the files here")
    parser.add_argument("--last", type=int, metavar="N", help="only the newest N entries")
    parser.add_argument("--only", metavar="WORD", default="", help="only actions with this word in them")
    parser.add_argument("--json", action="store_true", help="one JSON object for each entry")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Show the log; the exit code is 0."""
    if args.last is not None and args.last < 1:
        raise UsageError(f"--last {args.last} shows no entry", hint="give 1 or more")
    if args.cloud:
        _show_cloud(args, settings)
    elif args.out is not None:
        raise UsageError("--out is for --cloud", hint="the files of a local platform are in its folder")
    else:
        _show(args, _files(args))
    return 0


def _show_cloud(args: argparse.Namespace, settings: PlatformSettings) -> None:
    """Fetch the logs in the bucket, and show them as those of any folder."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.audit_archive import fetch_audit, open_audit_archive

    if args.files:
        raise UsageError("--cloud and files exclude each other", hint="leave one of them out")
    if args.out is not None and args.out.exists() and any(args.out.iterdir()):
        raise UsageError(f"{args.out} is not empty", hint="name a new folder")
    archive = open_audit_archive(open_account(settings.cloud.region), ResourceNames(settings.cloud.name))
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.out or Path(temporary)
        fetch_audit(archive, folder)
        files = _files_of_folder(folder)
        if not files:
            raise UsageError(
                "the bucket holds no audit log yet", hint="servers send the first within a minute"
            )
        _show(args, files)


def _show(args: argparse.Namespace, files: list[Path]) -> None:
    rows = [(who, entry) for who, entry in read_logs(files) if args.only in entry.action]
    for who, entry in rows if args.last is None else rows[-args.last :]:
        show(_json_line(who, entry) if args.json else _line(who, entry))


def _files(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command names, or those of the local platform."""
    from rse_pf.local.state import state_folder

    named: list[Path] = args.files
    for path in named:
        if not path.exists():
            raise UsageError(f"there is no {path}", hint="name files of logs, or a folder")
    if named and not named[0].is_dir():
        return named
    folder = named[0] if named else audit_folder(state_folder(args.name, os.environ))
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
    except (OverflowError, ValueError, OSError):  # somebody changed the file
        when = f"time={entry.time!r}"
    actor = [] if entry.actor == who else [f"by {_word(entry.actor)}"]
    subject = [_word(entry.subject)] if entry.subject else []
    details = [f"{_word(key)}={_word(value)}" for key, value in entry.detail.items()]
    return " ".join([when, who, _word(entry.action), *subject, *actor, *details])


def _word(value: object) -> str:
    text = str(value)
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)
