"""Declare options of the command line as the fields of frozen dataclasses, called requests.

An `Action` is a verb, or one action of a verb; it names the request and the function that is called with it::

    @dataclass(frozen=True, kw_only=True)
    class PruneRequest(MapRequest):
        keep: int = option("--keep", required=True, metavar="N", help="number of newest versions to keep")

    ACTION = Action(request=PruneRequest, run=prune)
"""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any, NoReturn

from rse_pf.command_line.extras import is_installed
from rse_pf.config.validation import did_you_mean
from rse_pf.errors import UsageError

__all__ = ["Action", "NoOptions", "Parser", "add_action", "extension_actions", "option", "perform"]

_CONVERTERS: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "Path": Path}
"""Function that converts the text of an option, by the first type name in the annotation of its field.

A type that is missing here, such as ``str``, leaves the text as it is.
"""
# The words that request a help page, if they come first.
_HELP = (["-h"], ["--help"])
# Message of argparse about a value that is not among the choices.
_CHOICE = re.compile(r"invalid choice: '(?P<word>[^']*)' \(choose from (?P<known>.*)\)")


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """A verb, or one action of a verb: either a request and the function that takes it, or further actions.

    ``request`` is the dataclass whose fields are the options.  ``run`` is called with the request and the
    settings, and returns the exit code; None means 0.  ``actions`` are the further actions by name, and
    ``default`` names the one that runs if the command names none.  ``help`` is the line in the list of
    actions; ``description`` opens the help page of the action, and is ``help`` if it is empty; ``example``
    closes it.
    """

    help: str = ""
    description: str = ""
    example: str = ""
    request: Any = None
    run: Callable[[Any, Any], int | None] | None = None
    actions: Mapping[str, Action] = field(default_factory=dict)
    default: str = ""


def extension_actions(**modules: str) -> dict[str, Action]:
    """Return the ``ACTION`` of each module, by name; those of removed extensions are left out."""
    return {
        name: importlib.import_module(module).ACTION
        for name, module in modules.items()
        if is_installed(module.rpartition(".")[0])
    }


@dataclass(frozen=True)
class NoOptions:
    """The request of an action that has no options."""


def option(*flags: str, default: Any = None, section: str = "", exclusive: str = "", **keywords: Any) -> Any:
    """Return a dataclass field that declares an option, or without *flags* a positional argument.

    The annotation of the field gives the type of the value; ``bool`` is a flag that takes no value, and that
    inverts *default*.  The module of the request must have ``from __future__ import annotations``.

    Args:
        flags: Names of the option such as ``--out``; none for a positional argument, which has the name of
            the field.
        default: Value of an option that is not given.
        section: Heading under which the help page lists the option.
        exclusive: At most one of the options with the same word here may be given.
        keywords: Further arguments of `argparse.ArgumentParser.add_argument`.
    """
    return field(
        default=default,
        metadata={"flags": flags, "section": section, "exclusive": exclusive, "keywords": keywords},
    )


class Parser(argparse.ArgumentParser):
    """A parser of words that raises UsageError where `argparse.ArgumentParser` prints an error and exits."""

    typed: Sequence[str] = ()
    """The words that are parsed now, for the hints of `error`."""

    siblings: Mapping[str, Parser] = {}
    """The parsers of the actions of this verb, or of the verb that this action belongs to, by name."""

    default_action: str = ""
    """Name of the action that is put before the words if the first word is an option; "" for none."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse *args* (None: those of the process), and raise UsageError for words that are unknown.

        The parser of an action refuses them itself, so that the error names the action.
        """
        words = list(sys.argv[1:] if args is None else args)
        first = words[0] if words else ""
        skipped = 2 if first == "--settings" else int(first.startswith("--settings="))
        rest = words[skipped:]
        if self.default_action and (not rest or rest[0].startswith("-")) and rest[:1] not in _HELP:
            words = [*words[:skipped], self.default_action, *rest]
        self.typed = words
        parsed, unknown = super().parse_known_args(words, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def error(self, message: str) -> NoReturn:
        """Raise UsageError for the *message* of argparse; the hint names a similar option or word, if any."""
        choice = _CHOICE.search(message)
        first = self.typed[0].partition("=")[0] if self.typed else ""
        if choice and first in self._options_of_actions():
            raise UsageError(
                f"{self.prog}: {first} comes before the action",
                hint=f"write {self.prog} ACTION, then the options",
            )
        if choice:
            known = [word.strip(" '\"") for word in choice["known"].split(",")]
            raise UsageError(
                f"{self.prog}: {choice['word']!r} is not one of {', '.join(known)}",
                hint=did_you_mean(choice["word"], known, f"see {self.prog} --help"),
            )
        unknown = re.search(r"unrecognized arguments: ([^\s=]*)", message)
        word = unknown[1] if unknown else ""
        # A misspelt option may be the reason why a required one is missing: name the first unknown option.
        if "arguments are required" in message:
            options = {*self._option_string_actions, *self._options_of_actions()}
            typed = (each.partition("=")[0] for each in self.typed if each.startswith("--"))
            word = next((each for each in typed if each.strip("-") and each not in options), "")
        if word in self.siblings:
            verb = self.prog.rpartition(" ")[0]
            raise UsageError(
                f"{self.prog}: {word} is an action, and comes before the options",
                hint=f"{verb} {word}, then the options; see {verb} {word} --help",
            )
        if word and not word.startswith("-"):
            raise UsageError(
                f"{self.prog}: {message}",
                hint=f"leave it out, or put it before the options; see {self.prog} --help",
            )
        raise UsageError(
            f"{self.prog}: unknown option {word}" if word else f"{self.prog}: {message}",
            hint=self._hint_for(word),
        )

    def _hint_for(self, option: str) -> str:
        """Return a hint for an unknown *option*: the actions that have it, else a similar option."""
        others = [name for name, parser in self.siblings.items() if option in parser._option_string_actions]
        if option and others:
            return f"{option} is an option of {', '.join(others)}; see {self.prog} --help"
        return did_you_mean(option, self._option_string_actions, f"see {self.prog} --help")

    def _options_of_actions(self) -> set[str]:
        actions = [each for each in self._actions if isinstance(each, argparse._SubParsersAction)]
        parsers = [parser for each in actions for parser in each.choices.values()]
        return {word for parser in parsers for word in parser._option_string_actions}


def add_action(parser: Parser, action: Action) -> None:
    """Add the options of *action* to *parser*, or a parser for each of its actions, with their options."""
    if not action.actions:
        _add_options(parser, action.request)
        parser.set_defaults(chosen=action)
        return
    parser.default_action = action.default
    parser.epilog = f"{parser.prog} ACTION --help shows the options of an action"
    subparsers = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    parser.siblings = subparsers.choices
    for name, each in action.actions.items():
        made = subparsers.add_parser(
            name,
            help=each.help,
            description=each.description or f"{each.help[:1].upper()}{each.help[1:]}.",
            epilog=f"example:\n  {each.example}" if each.example else None,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        add_settings(made, default=argparse.SUPPRESS)
        add_action(made, each)
        made.siblings = subparsers.choices


def add_settings(parser: Parser, default: Any = None) -> None:
    """Add the option --settings to *parser*, with *default* as the value if it is not given."""
    parser.add_argument(
        "--settings",
        type=Path,
        default=default,
        metavar="FILE",
        help="read settings from FILE (default: ./cdk.json, if it exists)",
    )


def perform(parsed: argparse.Namespace, settings: Any) -> int:
    """Build the request of the action in *parsed*, run the action, and return its exit code."""
    action: Action = parsed.chosen
    assert action.run is not None
    given = vars(parsed)
    values = {each.name: given[each.name] for each in fields(action.request) if each.name in given}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    return action.run(action.request(**values), settings) or 0


def _add_options(parser: Parser, request: Any) -> None:
    """Add an option to *parser* for each field of the dataclass *request* that `option` made."""
    groups: dict[str, Any] = {}
    for each in fields(request):
        if "flags" not in each.metadata:
            continue
        section, exclusive = each.metadata["section"], each.metadata["exclusive"]
        if section and section not in groups:
            groups[section] = parser.add_argument_group(section)
        if exclusive and exclusive not in groups:
            groups[exclusive] = groups.get(section, parser).add_mutually_exclusive_group()
        _add_option(groups.get(exclusive or section, parser), each)


def _add_option(group: Any, declared: Field[Any]) -> None:
    """Add the option of the field *declared* to *group*, with type and action by the field's annotation."""
    flags, keywords = declared.metadata["flags"], dict(declared.metadata["keywords"])
    if not isinstance(declared.type, str):
        raise TypeError(f"the module of the field {declared.name} has no postponed annotations")
    kind = declared.type.removeprefix("tuple[").split(" |")[0].split(",")[0]
    converter = _CONVERTERS.get(kind)
    default = list(declared.default) if isinstance(declared.default, tuple) else declared.default
    if kind == "bool" and "action" not in keywords:
        default = bool(default)
        keywords["action"] = "store_false" if default else "store_true"
    elif converter is not None:
        keywords["type"] = converter
    if flags:
        keywords["dest"] = declared.name
    group.add_argument(*(flags or (declared.name,)), default=default, **keywords)
