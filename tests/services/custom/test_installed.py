"""Service folders: valid and invalid folders, and refusal of files that were changed after installation."""

from __future__ import annotations

import json
import os
import socket

import pytest

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.services.custom.installed import (
    install,
    installed_services,
    packaged_services,
    read_service,
)

GOOD = {"name": "adder", "language": "python", "entry": "service.py"}


@pytest.fixture
def folder(tmp_path):
    """A folder with a service in it."""
    made = tmp_path / "adder"
    (made / "requests").mkdir(parents=True)
    (made / "service.json").write_text(json.dumps(GOOD))
    (made / "service.py").write_text("x = 1\n")
    (made / "requests" / "a.json").write_text("{}")
    (made / "helper").mkdir()
    (made / "helper" / "more.py").write_text("y = 2\n")
    return made


@pytest.mark.parametrize(
    "change",
    [
        {"name": "Adder"}, {"name": "../adder"}, {"name": ""}, {"name": "a" * 41}, {"name": 5},
        {"language": "perl"}, {"kind": "long"}, {"kind": "eternal"}, {"entry": "/etc/passwd"},
        {"entry": "../service.py"}, {"entry": ""}, {"entry": 1}, {"unknown": 1},
    ],
)  # fmt: skip
def test_an_invalid_manifest_is_one_line(folder, change):
    (folder / "service.json").write_text(json.dumps({**GOOD, **change}))

    with pytest.raises(UsageError) as caught:
        read_service(folder)
    assert caught.value.hint
    assert "\n" not in caught.value.message


@pytest.mark.parametrize("text", ["", "[]", "{", '{"name": "adder"}', "\x00"])
def test_a_manifest_that_is_not_json_is_one_line(folder, text):
    (folder / "service.json").write_text(text)

    with pytest.raises(UsageError, match=r"service\.json"):
        read_service(folder)


def test_an_installed_service_runs_from_its_own_copy(folder, tmp_path):
    installed = install(folder, tmp_path / "services")
    (folder / "service.py").write_text("changed\n")

    assert installed.entry_path.read_text() == "x = 1\n"
    assert [service.name for service in installed_services(tmp_path / "services")] == ["adder"]
    assert (installed.folder / "helper" / "more.py").exists()
    assert not (installed.folder / "requests").exists()


@pytest.mark.parametrize("harm", ["change", "add", "remove", "pins", "manifest"])
def test_a_service_that_was_changed_after_its_installation_is_refused(folder, tmp_path, harm):
    place = install(folder, tmp_path / "services").folder
    if harm == "change":
        (place / "helper" / "more.py").write_text("y = 3\n")
    elif harm == "add":
        (place / "new.py").write_text("")
    elif harm == "remove":
        (place / "helper" / "more.py").unlink()
    elif harm == "pins":
        (place / "pins.json").unlink()
    else:
        (place / "service.json").write_text(json.dumps({**GOOD, "entry": "helper/more.py"}))

    with pytest.raises(ConfigurationError, match="install"):
        installed_services(tmp_path / "services")


PUBLISHED = """
import msgspec
class Request(msgspec.Struct):
    x: int
class Reply(msgspec.Struct):
    y: int
def serve(request: Request) -> Reply:
    return Reply(y=2 * request.x)
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A function that pretends to install a package with entry points."""

    def installed(entry_points):
        (tmp_path / "doubling_for_tests.py").write_text(PUBLISHED)
        info = tmp_path / "doubling_for_tests-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: doubling-for-tests\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[rse_pf.services]\n{entry_points}\n")
        monkeypatch.syspath_prepend(tmp_path)

    return installed


def test_a_published_service_with_a_bad_name_is_one_line(package):
    package("Doubling! = doubling_for_tests")

    with pytest.raises(ConfigurationError, match="Doubling!"):
        packaged_services()


def _link(path, target):
    path.symlink_to(target)


def _pipe(path, _):
    os.mkfifo(path)


def _socket(path, _):
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(os.path.relpath(path))


@pytest.mark.parametrize("make", [_link, _pipe, _socket])
@pytest.mark.parametrize("name", ["more.py", "helper/deep/more.py", "service.py", "service.json"])
def test_a_service_with_a_link_or_a_special_file_is_not_installed(folder, tmp_path, monkeypatch, make, name):
    secret = tmp_path / "secret"
    secret.write_text("of the operator")
    monkeypatch.chdir(tmp_path)
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    make(path, secret)

    with pytest.raises(UsageError, match=r"consists of regular files only|is missing") as caught:
        install(folder, tmp_path / "services")
    assert str(path) in caught.value.message
    assert list((tmp_path / "services").rglob("*")) == [] or not (tmp_path / "services").exists()


def test_a_link_to_a_folder_is_not_followed(folder, tmp_path):
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / "key.json").write_text("of the operator")
    (folder / "data").symlink_to(tmp_path / "private")

    with pytest.raises(UsageError, match="data is a link"):
        install(folder, tmp_path / "services")
    assert not list(tmp_path.rglob("services/**/key.json"))


def test_a_link_to_a_folder_that_was_added_after_the_installation_is_noticed(folder, tmp_path):
    installed = install(folder, tmp_path / "services")
    (installed.folder / "numpy").symlink_to("/usr")

    with pytest.raises(ConfigurationError, match=r"numpy \(added\)"):
        installed_services(tmp_path / "services")
