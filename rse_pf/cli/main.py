"""Run one verb of the command line: find it, read the settings, print an error as two lines.

A verb is a module, see `verb_module`: its docstring is its help page, and its ``ACTION`` holds its request or
its actions, see `rse_pf.command_line.options`.  Only the module of the verb is imported.  A distribution of
somebody else adds a verb by an entry point of the group ``rse_pf.verbs``; its defects break no other verb.
Exit codes: 0 done, 1 failed, 2 wrong call or settings, 130 interrupted.  Named errors print no traceback.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.command_line.extras import error_of_module, is_installed
from rse_pf.command_line.options import Parser, add_action, add_settings, perform
from rse_pf.config import load_settings
from rse_pf.config.validation import did_you_mean
from rse_pf.errors import ConfigurationError, RsePfError, SettingsError, UsageError, error_of_system
from rse_pf.processes.one_thread import ONE_THREAD
from rse_pf.terminal import show, show_error, show_page

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = ["VERBS", "main", "parser_of", "verb_module"]

_HELP = {
    "demo": "run robots that build point-cloud maps through a platform on this machine",
    "check": "find what is wrong with a drive: calibration, depth, times, images, axes",
    "compare": "compare configurations of the tracker on recordings: errors, bytes, CPU time",
    "experiment": "repeat the experiments of Section 6 of the paper, or verify a run from its records",
    "local": "run the platform on this machine: load balancer and backend servers",
    "fleet": "print a new address of the fleet page, which shows a running platform in a browser",
    "swarm": "load a platform with many robots, and measure what they see",
    "token": "issue a robot's token, or show what one contains",
    "tenant": "list tenants with what they store, and change the quota of one",
    "robot": "enrol robots with keys of their own, disable them, revoke tokens",
    "service": "write, test, run and install a service of your own: Python, C/C++ or Lua",
    "serve": "run one backend server, as EC2 runs it",
    "data": "run the data service: images, keyframes, clouds and maps by HTTP",
    "rosbridge": "let programs that speak rosbridge v2 use a platform",
    "camera": "calibrate a camera, print a board for it, check what it gives",
    "map": "show, merge, localise in, roll back and export the maps that robots share",
    "batch": "merge maps that outgrow one process, in parts that survive a crash",
    "replay": "show why a pose was bad from a recording, and solve recorded commands again",
    "audit": "show the audit log: robots that connected or were refused, and changes by operators",
    "cloud": "run the platform on AWS: up, park, resume, down, status, cost, doctor",
    "settings": "show every setting: value, default, unit, source",
    "doctor": "check what this machine needs, and say how to fix it",
    "errors": "explain an error by its code: cause, check, fix",
}
"""One line of help for each verb of this distribution, in the order of the front page."""

_MODULES = {
    "demo": "rse_pf.extensions.experiments.demo.command",
    "check": "rse_pf.extensions.check.command",
    "compare": "rse_pf.extensions.experiments.compare.command",
    "experiment": "rse_pf.extensions.experiments.paper.command",
    "local": "rse_pf.cli.local_platform.local",
    "fleet": "rse_pf.extensions.fleet_page.command",
    "swarm": "rse_pf.extensions.experiments.load.command",
    "token": "rse_pf.cli.access.token",
    "tenant": "rse_pf.cli.access.tenant",
    "robot": "rse_pf.cli.access.robot",
    "service": "rse_pf.cli.services.service",
    "serve": "rse_pf.cli.servers.serve",
    "data": "rse_pf.cli.servers.data",
    "rosbridge": "rse_pf.extensions.rosbridge.command",
    "camera": "rse_pf.cli.maps.camera",
    "map": "rse_pf.cli.maps.map",
    "batch": "rse_pf.extensions.batch.command",
    "replay": "rse_pf.extensions.recording.replay.command",
    "audit": "rse_pf.cli.access.audit",
    "cloud": "rse_pf.cli.cloud.cloud",
    "settings": "rse_pf.cli.settings",
    "doctor": "rse_pf.cli.doctor",
    "errors": "rse_pf.cli.errors",
}
"""Module of each verb, by name, so that only the module of the verb that runs is imported."""

VERBS = {name: text for name, text in _HELP.items() if is_installed(_MODULES[name].rpartition(".")[0])}
"""One line of help for each verb; the verbs of extensions that were removed are left out."""

_EXIT_OK = 0
_EXIT_FAILED = 1
# Exit code of a wrong call or wrong settings.
_EXIT_USAGE = 2
# Exit code after Ctrl-C: 128 and the number of SIGINT, as shells have it.
_EXIT_INTERRUPTED = 130
# Exit code if the program that reads standard output has exited: 128 and the number of SIGPIPE.
_EXIT_PIPE = 141
# Message of a SettingsError about a value out of bounds, with the name of the setting.
_REFUSED = re.compile(r"[a-z]+\.(?P<name>[a-z_]+) = .* is (below|above|not one of) ")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the verb in *argv* (None: the words of this process), and return the exit code.

    An error of the platform, of the system or of a missing package is printed as two lines.
    """
    # Restrict BLAS to one thread, before a verb imports numpy.  With more threads the last bits of a map
    # would differ, so that the replay of a log would differ from the map server; and the matrices are so
    # small that further threads would only wait, and take CPU time.
    os.environ.update(ONE_THREAD)
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _run(words)
        sys.stdout.flush()
    except RsePfError as error:
        return _report(error)
    except KeyboardInterrupt:
        return _EXIT_INTERRUPTED
    except BrokenPipeError:
        # The program that reads standard output has exited: send what is left to /dev/null, or Python would
        # fail when it writes it at the exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _EXIT_PIPE
    except ModuleNotFoundError as error:
        missing = error_of_module(error.name or "")
        if missing is None:  # rse-pf has a defect
            raise
        return _report(missing)
    except ImportError as error:
        cause = (str(error).splitlines() or [""])[0]
        return _report(
            ConfigurationError(
                f"an installed package does not work: {cause}", hint="install it again with pip"
            )
        )
    except OSError as error:
        return _report(error_of_system(error))
    return code


def verb_module(name: str) -> Any:
    """Import and return the module of the verb *name*."""
    return importlib.import_module(_MODULES[name]) if name in _MODULES else _installed_verbs()[name].load()


def parser_of(name: str) -> Parser:
    """Return the parser of the verb *name*, with its help page and all of its options."""
    verb = verb_module(name)
    parser = Parser(
        prog=f"rse-pf {name}",
        description=(verb.__doc__ or "").strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add_settings(parser)
    add_action(parser, verb.ACTION)
    return parser


def _run(words: list[str]) -> int:
    """Run the verb in *words*, or print the front page, a help page or the version; return the exit code."""
    if not words or words[0] in ("-h", "--help", "help"):
        show_page(_front_page())
        return _EXIT_OK
    if words[0] == "--version":
        from rse_pf.version import installed_version

        show(f"rse-pf {installed_version()}")
        return _EXIT_OK
    name, *rest = words
    if name.startswith("-"):
        raise UsageError(f"{name} comes before the verb", hint="write rse-pf VERB OPTIONS; see rse-pf --help")
    if name in VERBS:
        return _run_verb(name, rest)
    installed = _installed_verbs()
    if name not in installed:
        raise UsageError(f"there is no verb {name!r}", hint=did_you_mean(name, [*VERBS, *installed]))
    try:
        return _run_verb(name, rest)
    except (RsePfError, OSError):
        raise
    except Exception as error:
        raise _error_of_installed_verb(installed[name], error) from error


def _run_verb(name: str, rest: list[str]) -> int:
    """Run the verb *name* with the words *rest*, or print its help page; return the exit code."""
    try:
        parsed = parser_of(name).parse_args(rest)
    except SystemExit as over:  # --help has printed its page
        return int(over.code or _EXIT_OK)
    try:
        code = perform(parsed, load_settings(parsed.settings))
    except SettingsError as error:
        error.hint = _hint_for_option(error, rest)
        raise
    return code


def _hint_for_option(error: SettingsError, words: list[str]) -> str:
    """Return the hint of *error*; it names the option if the refused value came from an option in *words*."""
    refused = _REFUSED.match(error.message)
    option = "" if refused is None else f"--{refused['name'].replace('_', '-')}"
    if refused is not None and any(word == option or word.startswith(f"{option}=") for word in words):
        verb = "choose another value for" if refused[2] == "not one of" else error.hint.split()[0]
        return f"{verb} {option}"
    return error.hint


def _installed_verbs() -> dict[str, EntryPoint]:
    """Return the verbs that other distributions add, by name; a verb of the table cannot be replaced."""
    # Only for words outside of the table: this import and the search take half as long as a short verb.
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group="rse_pf.verbs") if entry.name not in VERBS}


def _error_of_installed_verb(entry: EntryPoint, error: BaseException) -> RsePfError:
    """Return the error that names the distribution of *entry*, and the line that raised *error*."""
    from traceback import extract_tb

    owner = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
    line = extract_tb(error.__traceback__)[-1]
    # These two name module or line themselves, and are raised in Python's own files.
    names_itself = isinstance(error, ImportError | SyntaxError)
    where = "" if names_itself else f" ({Path(line.filename).name}, line {line.lineno})"
    return RsePfError(
        f"the verb {entry.name} of {owner} raised {type(error).__name__}: {error}{where}",
        hint=f"update or remove it with pip, or report this to the authors of {owner}",
    )


def _help_of_installed_verb(entry: EntryPoint) -> str:
    """Return the first line of the docstring of the verb's module, or what is wrong with the module."""
    try:
        return (entry.load().__doc__ or "").strip().partition("\n")[0]
    except (Exception, SystemExit) as error:  # noqa: BLE001  other verbs are listed whatever this one does
        return _error_of_installed_verb(entry, error).message


def _front_page() -> str:
    installed = {name: _help_of_installed_verb(entry) for name, entry in _installed_verbs().items()}
    texts = VERBS | installed
    width = max(map(len, texts))
    verbs = "\n".join(f"  {name:<{width}}  {text}" for name, text in texts.items())
    return (
        "usage: rse-pf VERB [OPTIONS]\n\n"
        "RSE-PF, a robust, secure, elastic cloud robotics platform for distributed visual SLAM.\n\n"
        f"verbs:\n{verbs}\n\n"
        "rse-pf VERB --help explains a verb; rse-pf --version names the version.\n\n"
        "example:\n  rse-pf demo --out out"
    )


def _report(error: RsePfError) -> int:
    """Print *error*, and return the exit code: 2 for a wrong call or settings, else 1."""
    show_error(error)
    return _EXIT_USAGE if isinstance(error, ConfigurationError) else _EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
