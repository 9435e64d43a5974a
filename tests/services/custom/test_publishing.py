"""Publishing of services: checks before the upload, and checks of the servers."""

from __future__ import annotations

import gzip
import io
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rse_pf.errors import ConfigurationError, StoreError, UsageError
from rse_pf.services.custom.dependencies import Dependencies, tree_digest
from rse_pf.services.custom.installed import InstalledService, install, installed_services
from rse_pf.services.custom.publishing import (
    LIST_NAME,
    MAX_ARCHIVE_BYTES,
    SERVER_PLATFORM,
    PublishedFolder,
    PublishedList,
    PublishedService,
    archive_name,
    decode_list,
    pack_archive,
    publish,
    read_list,
    unpack_archive,
    unpublish,
)
from rse_pf.storage.object_store import MemoryStore, digest_of


class Author:
    """Writes services, and publishes them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store = folder, MemoryStore()
        self._made = 0

    def install(
        self,
        name: str = "adder",
        text: str = "x = 1\n",
        packages: dict[str, str] | None = None,
        **files: bytes,
    ) -> tuple[InstalledService, Path]:
        self._made += 1
        source = self.folder / f"source-{self._made}" / name
        source.mkdir(parents=True)
        (source / "service.json").write_text(
            json.dumps({"name": name, "language": "python", "entry": "service.py"})
        )
        (source / "service.py").write_text(text)
        for file, data in files.items():
            (source / file.replace("_so", ".so")).write_bytes(data)
        root = self.folder / f"root-{self._made}"
        return install(source, root, self._dependencies(packages)), root

    def publish(self, *args: Any, **more: Any) -> PublishedService:
        service, root = self.install(*args, **more)
        return publish(service, root, self.store, now_s=1e9)

    def _dependencies(self, packages: dict[str, str] | None) -> Dependencies | None:
        if packages is None:
            return None
        made = self.folder / f"packages-{self._made}"
        made.mkdir()
        for name in packages:
            (made / f"{name}.py").write_text("y = 2\n")
        platform = packages.pop("platform", SERVER_PLATFORM)
        return Dependencies(folder=made, digest=tree_digest(made), packages=packages, platform=platform)

    def data(self) -> bytes:
        return self.store.get(LIST_NAME)

    def fetch(self, entry: PublishedService) -> bytes:
        return self.store.get(archive_name(entry.archive))


@pytest.fixture
def author(tmp_path: Path) -> Author:
    return Author(tmp_path)


@pytest.fixture
def server(tmp_path: Path) -> PublishedFolder:
    return PublishedFolder(tmp_path / "server")


def library(symbols: bytes = b"GLIBC_2.17\0", *, machine: int = 62) -> bytes:
    return b"\x7fELF\x02\x01" + bytes(12) + machine.to_bytes(2, "little") + symbols


def test_a_new_list_replaces_the_former_at_once_and_fetches_only_what_is_new(
    author: Author, server: PublishedFolder
) -> None:
    author.publish("a")
    author.publish("b")
    server.install(author.data(), author.fetch)
    former = server.link.resolve()
    author.publish("b", text="x = 3\n")
    asked = []

    server.install(author.data(), lambda entry: asked.append(entry.name) or author.fetch(entry))

    assert asked == ["b"]
    assert (server.link / "b" / "service.py").read_text() == "x = 3\n"
    assert (former / "b" / "service.py").read_text() == "x = 1\n", "a server may still read it"
    unpublish("a", author.store)
    server.install(author.data(), author.fetch)
    assert [each.name for each in installed_services(server.link)] == ["b"]
    assert not former.exists()
    assert len(list((server.link.parent / "archives").iterdir())) == 1


def test_a_list_whose_archives_cannot_be_fetched_changes_nothing(
    author: Author, server: PublishedFolder
) -> None:
    author.publish()
    server.install(author.data(), author.fetch)
    before = author.data()
    author.publish("other")

    def fail(entry: PublishedService) -> bytes:
        raise StoreError("S3 does not answer")

    with pytest.raises(StoreError):
        server.install(author.data(), fail)
    assert server.holds(before)


def test_an_archive_above_the_limit_is_not_even_fetched(author: Author, server: PublishedFolder) -> None:
    author.publish()
    document = json.loads(author.data())
    document["services"][0]["size"] = MAX_ARCHIVE_BYTES + 1

    def fetch(entry: PublishedService) -> bytes:
        raise AssertionError("it was fetched")

    with pytest.raises(ConfigurationError, match="bytes"):
        server.install(json.dumps(document).encode(), fetch)


def packed(*members: tuple[str, bytes, bytes]) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as archive:
        for name, kind, content in members:
            about = tarfile.TarInfo(name)
            about.type, about.size, about.linkname = kind, len(content), "/etc/passwd"
            archive.addfile(about, io.BytesIO(content))
    return gzip.compress(made.getvalue())


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ([("adder/../../x", tarfile.REGTYPE, b"1")], "leaves its folder"),
        ([("/tmp/x", tarfile.REGTYPE, b"1")], "holds '/tmp/x'"),
        ([("other/x", tarfile.REGTYPE, b"1")], "holds 'other/x'"),
        ([("adder/x", tarfile.SYMTYPE, b"")], "holds 'adder/x'"),
        ([("adder/x", tarfile.LNKTYPE, b"")], "holds 'adder/x'"),
        ([("adder/x", tarfile.CHRTYPE, b"")], "holds 'adder/x'"),
        ([("adder/x", tarfile.REGTYPE, b"1")] * 2, "cannot be read"),
        ([("adder/x", tarfile.REGTYPE, b"1"), ("adder/x/y/z", tarfile.REGTYPE, b"1")], "cannot be read"),
        ([("adder/\u00e9\0y", tarfile.REGTYPE, b"1")], "cannot be read"),
        ([("adder/" + "y" * 300, tarfile.REGTYPE, b"1")], "too long"),
        ([("adder/" + "y/" * 3000 + "y", tarfile.REGTYPE, b"1")], "too long"),
    ],
)
def test_an_archive_that_no_publisher_makes_is_refused(
    tmp_path: Path, members: list[tuple[str, bytes, bytes]], why: str
) -> None:
    archive = packed(*members)
    entry = PublishedService(
        name="adder",
        language="lua",
        archive=digest_of(archive),
        size=len(archive),
        identity="",
        published_s=0.0,
    )

    with pytest.raises(ConfigurationError, match=why):
        unpack_archive(entry, archive, tmp_path / "into")
    assert not [path for path in tmp_path.rglob("x") if path.parent.name != "adder"]


def test_an_archive_with_another_digest_is_not_even_opened(author: Author, tmp_path: Path) -> None:
    entry = author.publish()
    changed = bytearray(author.fetch(entry))
    changed[-1] ^= 1

    with pytest.raises(ConfigurationError, match="is not the one in the list"):
        unpack_archive(entry, bytes(changed), tmp_path / "into")
    assert not (tmp_path / "into").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"name": "../x"}, {"name": "A"}, {"archive": "../../keys.json"}, {"archive": "ab"}, {"size": "big"},
        {"more": 1},
    ],
)  # fmt: skip
def test_a_list_that_no_publisher_writes_is_refused(author: Author, change: dict[str, Any]) -> None:
    author.publish()
    document = json.loads(author.data())
    document["services"][0].update(change)

    with pytest.raises(ConfigurationError):
        decode_list(json.dumps(document).encode())


def test_a_list_whose_identity_is_not_that_of_its_archive_is_refused(
    author: Author, server: PublishedFolder
) -> None:
    entry = author.publish()
    lying = msgspec.structs.replace(entry, identity="0" * 64)

    with pytest.raises(ConfigurationError, match="do not hold the services of the list"):
        server.install(msgspec.json.encode(PublishedList(services=(lying,))), author.fetch)
    assert not server.link.exists()


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (library(machine=183), "not a library for x86-64"),
        (b"text", "not a library for x86-64"),
        (library(b"GLIBC_2.17\0GLIBC_2.38\0"), "needs GLIBC_2.38"),
        (library(b"GLIBCXX_3.4.32\0"), "needs GLIBCXX_3.4.32"),
    ],
)
def test_a_library_that_servers_cannot_load_is_refused_with_a_hint(
    author: Author, data: bytes, why: str
) -> None:
    with pytest.raises(ConfigurationError, match=why) as told:
        author.publish(libx_so=data)
    assert "Debian 12" in told.value.hint
    assert read_list(author.store).services == ()


def test_packages_for_another_interpreter_or_of_two_versions_are_refused(author: Author) -> None:
    with pytest.raises(ConfigurationError, match="servers are cp311-linux-x86_64"):
        author.publish(packages={"numbers": "1.0", "platform": "cp312-linux-x86_64"})
    author.publish("a", packages={"numbers": "1.0"})
    with pytest.raises(ConfigurationError, match=r"a needs numbers 1\.0 and b needs numbers 2\.0"):
        author.publish("b", packages={"numbers": "2.0"})
    author.publish("a", packages={"numbers": "2.0"})
    author.publish("b", packages={"numbers": "2.0"})


def test_a_link_is_refused_as_it_would_lead_elsewhere_on_a_server(author: Author) -> None:
    service, root = author.install()
    (root / "adder" / "secret").symlink_to("/etc/passwd")

    with pytest.raises(UsageError, match="secret is a link"):
        pack_archive(root)
    assert service.name == "adder"


def test_two_operators_who_publish_at_the_same_time_lose_nothing(author: Author) -> None:
    other = Author(author.folder / "other")
    other.store = author.store
    swap, swapped = author.store.compare_and_swap, []

    def overtaken(name: str, expected: bytes | None, data: bytes) -> None:
        if not swapped:
            swapped.append(name)
            other.publish("theirs")
        swap(name, expected, data)

    author.store.compare_and_swap = overtaken  # type: ignore[method-assign]
    author.publish("mine")

    assert [each.name for each in read_list(author.store).services] == ["mine", "theirs"]


def test_a_server_that_dies_while_it_installs_begins_again(author: Author, server: PublishedFolder) -> None:
    author.publish()
    server.install(author.data(), author.fetch)
    shutil.copytree(server.link.resolve(), server.link.parent / "lists" / ".new-half")
    author.publish("other")

    assert [each.name for each in server.install(author.data(), author.fetch)] == ["adder", "other"]
    assert not (server.link.parent / "lists" / ".new-half").exists()
