"""The table of renames leads from names that are gone to names that exist."""

from __future__ import annotations

import importlib.util
import json
import pkgutil
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import load_settings, setting_rows
from rse_pf.config.renames import RENAMED_FILE, hint_for_old_option, hint_for_old_setting
from rse_pf.errors import SettingsError

TABLE = json.loads(RENAMED_FILE.read_text(encoding="utf-8"))
SETTINGS = {f"{row.group}.{row.name}" for row in setting_rows()}


def test_no_old_setting_exists_and_every_new_one_does() -> None:
    assert SETTINGS.isdisjoint(TABLE["settings"])
    assert {new for new in TABLE["settings"].values() if new} <= SETTINGS


@pytest.mark.parametrize("new", sorted(set(TABLE["imports"].values())))
def test_every_new_module_exists(new: str) -> None:
    assert importlib.util.find_spec(new) is not None


@pytest.mark.parametrize(
    "new",
    sorted(new for kind in ("classes", "members") for new in TABLE[kind].values() if "." in new),
)
def test_every_new_class_and_member_exists(new: str) -> None:
    assert pkgutil.resolve_name(new.partition("(")[0]) is not None


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (hint_for_old_setting("serving.size"), "write serving.emulated_cores"),
        (hint_for_old_setting("serving.read_buffer_bytes"), "is a constant now: remove the line"),
        (hint_for_old_option("--size"), "write --emulated-cores"),
        (hint_for_old_option("--life"), "write --ttl"),
    ],
)
def test_a_hint_says_what_to_write(hint: str, words: str) -> None:
    assert words in hint


def test_a_name_that_never_was_one_has_no_hint() -> None:
    assert hint_for_old_setting("serving.sise") == hint_for_old_option("--sise") == ""


@pytest.mark.parametrize(
    ("overrides", "hint"),
    [
        ({"session": {"silence_s": 1.0}}, "session.silence_s was renamed: write session.stall_timeout_s"),
        ({"cloud": {"lab": False}}, "cloud.lab was renamed: write cloud.allow_insecure"),
        ({"local": {"young_s": 1.0}}, "local.young_s is a constant now: remove the line"),
        ({"prices": {"command_cpu_ms": 2.0}}, "rse-pf cloud cost --prices FILE"),
    ],
)
def test_a_setting_of_an_older_version_is_refused_with_its_new_name(
    tmp_path: Path, overrides: dict[str, Any], hint: str
) -> None:
    file = tmp_path / "cdk.json"
    file.write_text(json.dumps({"context": {"rse-pf": overrides}}), encoding="utf-8")

    with pytest.raises(SettingsError, match="unknown") as caught:
        load_settings(file)

    assert hint in caught.value.hint
