"""Show the audit log of a platform, or verify that it was not changed.

Servers, the control plane, the data service and operators' commands write one chain each: robots accepted,
refused and revoked, servers started and stopped, maps changed.  verify prints a line for each chain, and
exits with 1 if an entry was changed, moved, added or lost, if the end of a chain is missing, or if a chain
was removed or copied.  Someone who may write the whole folder can forge all of it: store a chain's head
elsewhere, and pass it with --head.  --cloud reads what the servers of the deployment on AWS have sent to its
bucket; --out keeps the files, so that they can be shown again without AWS.

examples:
  rse-pf audit verify
  rse-pf audit show --last 20
  rse-pf audit show --only revoke --json
  rse-pf audit verify --head control-plane=17:e3b0c442...
  rse-pf audit verify --cloud
  rse-pf audit show --cloud --only revoke --out logs
"""

from __future__ import annotations

import argparse
import json
import os
import re
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path

from rse_pf.audit.chain import Entry, Head, parse_head
from rse_pf.audit.log import audit_folder, chain_names, files_of
from rse_pf.audit.verify import Verdict, check_chain, check_folder, entries_of
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_NAME = "default"
_MAX_ATTEMPTS, _RETRY_PAUSE_S = 5, 0.2
_PLAIN = re.compile(r"[!-~]+")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=("show", "verify"), help="what to do")
    parser.add_argument(
        "files", nargs="*", type=Path, metavar="FILE", help="files of one chain, oldest first; or a folder"
    )
    parser.add_argument("--name", default=_NAME, help=f"which local platform (default: {_NAME})")
    parser.add_argument("--cloud", action="store_true", help="the deployment on AWS in cloud.region")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="with --cloud: keep the files here")
    parser.add_argument("--last", type=int, metavar="N", help="show: only the newest N entries")
    parser.add_argument("--only", metavar="WORD", help="show: only actions with this word in them")
    parser.add_argument("--json", action="store_true", help="show: one JSON object for each entry")
    parser.add_argument(
        "--head",
        action="append",
        default=[],
        metavar="WHO=SEQ:HASH",
        help="verify: this head, stored elsewhere, must be in the chain of WHO",
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Show or verify; the exit code is 1 if a chain is broken."""
    if args.cloud:
        return _run_in_cloud(args, settings)
    if args.out is not None:
        raise UsageError("--out is for --cloud", hint="the files of a local platform are in its folder")
    return _run_on(args, [])


def _run_in_cloud(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Fetch the logs in the bucket, and show or verify them as in any folder."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.audit_archive import fetch_audit, open_audit_archive

    if args.files:
        raise UsageError("--cloud and files exclude each other", hint="leave one of them out")
    if args.out is not None and args.out.exists() and any(args.out.iterdir()):
        raise UsageError(f"{args.out} is not empty", hint="name a new folder")
    archive = open_audit_archive(open_account(settings.cloud.region), ResourceNames(settings.cloud.name))
    with tempfile.TemporaryDirectory() as temporary:
        args.files = [args.out or Path(temporary)]
        problems = fetch_audit(archive, args.files[0])
        if not chain_names(args.files[0]) and not problems:
            raise UsageError(
                "the bucket holds no audit log yet", hint="servers send the first within a minute"
            )
        return _run_on(args, problems)


def _run_on(args: argparse.Namespace, problems: Sequence[str]) -> int:
    """Show or verify files on this machine; *problems* were found while fetching them."""
    for problem in problems:
        show(f"BROKEN: {problem}", error=args.action == "show")
    is_folder = not args.files or (len(args.files) == 1 and args.files[0].is_dir())
    folder = _folder(args) if is_folder else None
    for path in args.files:
        if not path.exists():
            raise UsageError(f"there is no {path}", hint="name the files of one chain, or a folder")
    if args.action == "show":
        return _show(args, folder) or int(bool(problems))
    if args.last is not None or args.only is not None or args.json:
        raise UsageError("--last, --only and --json are for show", hint="see rse-pf audit --help")
    return _verify(args, folder) or int(bool(problems))


def _show(args: argparse.Namespace, folder: Path | None) -> int:
    if args.head:
        raise UsageError("--head is for verify", hint="see rse-pf audit --help")
    if args.last is not None and args.last < 1:
        raise UsageError(f"--last {args.last} shows no entry", hint="give 1 or more")
    chains = [args.files] if folder is None else [files_of(folder, chain) for chain in chain_names(folder)]
    entries = ((path[-1].name.partition(".")[0], entry) for path in chains for entry in entries_of(path))
    selected = ((chain, entry) for chain, entry in entries if args.only is None or args.only in entry.action)
    ordered = sorted(selected, key=lambda row: (row[1].time, row[0], row[1].seq))
    for who, entry in deque(ordered, args.last):
        show(_json_line(who, entry) if args.json else _line(who, entry))
    return 0


def _verify(args: argparse.Namespace, folder: Path | None) -> int:
    heads = _heads(args.head)
    if folder is None:
        if heads:
            raise UsageError("--head needs all chains of a folder", hint="name the folder, not files")
        first = args.files[0]
        verdicts = [check_chain(first.name.partition(".")[0], args.files, from_genesis=False)]
    else:
        verdicts = _check_live(folder, heads)
    for verdict in verdicts:
        _print_verdict(verdict)
    return int(any(verdict.problem for verdict in verdicts))


def _check_live(folder: Path, heads: dict[str, Head]) -> list[Verdict]:
    """Check logs that may still be written; a line or a rename in progress is checked again."""
    for attempt in range(_MAX_ATTEMPTS):
        try:
            verdicts = check_folder(folder, known=heads)
        except FileNotFoundError:
            if attempt + 1 == _MAX_ATTEMPTS:
                raise
        else:
            if not any(verdict.problem for verdict in verdicts) or attempt + 1 == _MAX_ATTEMPTS:
                break
        time.sleep(_RETRY_PAUSE_S)  # a writer is in the middle of a line; there is no event to wait for
    return verdicts


def _print_verdict(verdict: Verdict) -> None:
    if verdict.problem:
        show(f"{verdict.who}: BROKEN in {verdict.file}: {verdict.problem}")
        return
    notes = "".join(f"; {note}" for note in verdict.notes)
    show(f"{verdict.who}: {counted(verdict.entries, 'entry', 'entries')} good, head {verdict.head}{notes}")


def _heads(words: Sequence[str]) -> dict[str, Head]:
    heads = {}
    for word in words:
        chain, _, rest = word.partition("=")
        head = parse_head(rest)
        if head is None or not chain:
            raise UsageError(
                f"{word[:80]!r} is not a head", hint="copy it from a line of rse-pf audit verify"
            )
        heads[chain] = head
    return heads


def _folder(args: argparse.Namespace) -> Path:
    from rse_pf.local.state import state_folder

    folder: Path = args.files[0] if args.files else audit_folder(state_folder(args.name, os.environ))
    if not folder.is_dir() or not chain_names(folder):
        raise UsageError(
            f"there is no audit log in {folder}", hint="start rse-pf local, or name a folder or files"
        )
    return folder


def _json_line(chain: str, entry: Entry) -> str:
    fields: dict[str, object] = {name: getattr(entry, name) for name in entry.__struct_fields__}
    return json.dumps({"log": chain, **fields})


def _line(chain: str, entry: Entry) -> str:
    when = datetime.fromtimestamp(entry.time, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")
    actor = [] if entry.actor == chain else [f"by {_word(entry.actor)}"]
    words: Iterable[str] = (f"{_word(key)}={_word(value)}" for key, value in entry.detail.items())
    subject = [_word(entry.subject)] if entry.subject else []
    return " ".join([when, f"{chain}#{entry.seq}", _word(entry.action), *subject, *actor, *words])


def _word(value: object) -> str:
    text = str(value)
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)
