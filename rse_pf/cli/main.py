"""``rse-pf VERB``: finds the verb, reads the settings, and turns errors into two lines.

Promises that a user never sees a traceback, and that nothing heavy is imported before its verb.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from rse_pf.errors import ConfigurationError, RsePfError, UsageError
from rse_pf.settings import load_settings

__all__ = ["VERBS", "main"]

VERBS = {
    "demo": "robots build point-cloud maps through the PnP service, on this machine",
    "local": "the whole platform on this machine: start, stop",
    "token": "issue or inspect robot tokens",
    "serve": "one backend server, as EC2 runs it",
    "settings": "every setting: value, unit, source, help",
    "doctor": "what this machine can do, and how to mend what it cannot",
}
"""Each verb is the module ``rse_pf.cli.VERB`` with ``add_arguments(parser)`` and ``run(args, settings)``."""

_EXIT_FAILED, _EXIT_USAGE, _EXIT_INTERRUPTED = 1, 2, 130


class _Parser(argparse.ArgumentParser):
    """argparse, with our kind of errors."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(message, hint=f"see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code: 0, 1 failed, 2 wrong use, 130 interrupted."""
    try:
        return _run(list(sys.argv[1:] if argv is None else argv))
    except RsePfError as error:
        print(error.report(), file=sys.stderr)
        return _EXIT_USAGE if isinstance(error, ConfigurationError) else _EXIT_FAILED
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED
    except BrokenPipeError:
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if argv[0] == "--version":
        from importlib import metadata

        print(f"rse-pf {metadata.version('rse-pf')}")
        return 0
    verb, *rest = argv
    if verb not in VERBS:
        close = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"verbs are {', '.join(VERBS)}"
        raise UsageError(f"no verb named {verb!r}", hint=hint)
    module: Any = importlib.import_module(f"rse_pf.cli.{verb}")
    parser = _Parser(
        prog=f"rse-pf {verb}",
        description=(module.__doc__ or "").strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="read settings from FILE (default: ./cdk.json)"
    )
    module.add_arguments(parser)
    args = parser.parse_args(rest)
    code: int = module.run(args, load_settings(args.settings))
    sys.stdout.flush()
    return code


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [f"  {verb:<{width}}  {text}" for verb, text in VERBS.items()]
    return "\n".join(
        [
            "usage: rse-pf VERB [options]",
            "",
            "RSE-PF: robust, secure, elastic cloud robotics for distributed visual SLAM.",
            "",
            *lines,
            "",
            "  rse-pf VERB --help tells more; try: rse-pf demo --out out",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
