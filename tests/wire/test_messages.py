"""The message types, the page of the protocol and the AsyncAPI file say the same."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from rse_pf.wire import (
    FromRobot,
    FromServer,
    Message,
    make_codec,
)
from rse_pf.wire.codec import Codec

KINDS = get_args(Message)


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    """The page of the protocol."""
    return (repository / "docs" / "protocol.md").read_text(encoding="utf-8")


def tag(kind: type[Any]) -> str:
    schema = msgspec.json.schema(kind)["$defs"][kind.__name__]
    name: str = schema["properties"]["type"]["enum"][0]
    return name


def exchange(page: str) -> list[tuple[str, bytes]]:
    block = page[page.index("## 7.") :].split("```text\n")[1].split("```")[0]
    return [(line[0], line[2:].encode()) for line in block.splitlines()]


def test_the_whole_exchange_of_the_page_is_made_of_good_messages(page: str) -> None:
    codec: Codec = make_codec("json")

    said = [
        (codec.decode_from_robot if who == ">" else codec.decode_from_server)(data)
        for who, data in exchange(page)
    ]

    assert {type(message) for message in said} == set(KINDS)


def script(repository: Path) -> Any:
    spec = importlib.util.spec_from_file_location("asyncapi_script", repository / "scripts" / "asyncapi.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_asyncapi_file_is_up_to_date(repository: Path) -> None:
    written = json.loads((repository / "docs" / "asyncapi.json").read_text(encoding="utf-8"))

    assert written == script(repository).asyncapi_document(), "run make docs"


def test_every_reference_of_the_asyncapi_file_leads_somewhere(repository: Path) -> None:
    document = json.loads((repository / "docs" / "asyncapi.json").read_text(encoding="utf-8"))
    references = re.findall(r'"\$ref": "#/([^"]+)"', json.dumps(document))

    assert len(references) > 20
    for reference in references:
        place = document
        for step in reference.split("/"):
            place = place[step]


def test_both_sides_messages_are_all_there_is() -> None:
    assert {*get_args(FromRobot), *get_args(FromServer)} == set(KINDS)
    assert len({tag(kind) for kind in KINDS}) == len(KINDS)
