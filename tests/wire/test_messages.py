"""The message types, the page of the protocol and the AsyncAPI file say the same."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from rse_pf import errors
from rse_pf.backend.gateway.frames import MAX_CONTROL_PER_S
from rse_pf.budget import MESSAGE_DEPTH, MESSAGE_INFLATE_RATIO
from rse_pf.config import SessionSettings
from rse_pf.wire import (
    SUBPROTOCOLS,
    FromRobot,
    FromServer,
    Message,
    make_codec,
)
from rse_pf.wire import (
    server_session as session,
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


def rows(text: str) -> list[list[str]]:
    """Return the cells of every table row of *text*."""
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"
    ]


def fields_on(page: str) -> dict[str, dict[str, str]]:
    """Return message -> field -> default, as the tables of section 2 have them."""
    found: dict[str, dict[str, str]] = {}
    message = ""
    for cells in rows(page[page.index("## 2. Messages") : page.index("### Arrays")]):
        if len(cells) == 5 and cells[0].startswith("`"):
            message = cells[0].strip("`")
            found[message] = {}
        elif len(cells) == 5 and cells[1].startswith("`"):
            found[message][cells[1].strip("`")] = cells[3].strip("`")
    return found


def test_the_page_lists_every_field_of_every_message_with_its_default(page: str) -> None:
    documented = fields_on(page)

    assert documented.keys() == {tag(kind) for kind in KINDS}
    for kind in KINDS:
        defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
        written = documented[tag(kind)]
        assert written.keys() == defaults.keys(), kind
        for name, default in defaults.items():
            shown = "" if default is msgspec.NODEFAULT else json.dumps(default)
            assert (written[name] or None) == (shown or None) or float(written[name]) == default, (kind, name)


def test_a_field_that_the_page_forgets_is_noticed(page: str) -> None:
    shorter = page.replace("| | `trace` | word |", "| | trace | word |")

    assert "trace" not in fields_on(shorter)["command"]


def test_the_page_lists_every_code_with_the_words_of_its_error(page: str) -> None:
    table = rows(page[page.index("<!-- codes -->") : page.index("<!-- end of codes -->")])[2:]
    kinds = [getattr(errors, name) for name in errors.__all__ if name[0].isupper() and name != "ERRORS_PAGE"]

    assert {cells[0].strip("`"): cells[2] for cells in table} == {
        kind.code: (kind.__doc__ or "").strip().splitlines()[0] for kind in kinds
    }


def test_the_page_lists_every_sub_protocol_and_close_code(page: str) -> None:
    assert set(re.findall(r"`(rse-pf\.v1\.[a-z+]+)`", page)) == set(SUBPROTOCOLS.values())
    closes = {value for name, value in vars(session).items() if name.startswith("CLOSE_")}
    table = " ".join(cells[0] for cells in rows(page[page.index("## 6. Close codes") :]))
    assert all(str(code) in table for code in closes)


def test_the_limits_of_the_page_are_those_of_the_settings(page: str) -> None:
    limits = SessionSettings()
    table = page[page.index("### Limits") : page.index("## 5.")].replace(",", "")

    for value in (
        limits.max_message_bytes, limits.max_inflated_bytes, MESSAGE_INFLATE_RATIO, limits.max_fragments,
        MESSAGE_DEPTH, MAX_CONTROL_PER_S, limits.hello_timeout_s,
    ):  # fmt: skip
        assert re.search(rf"\b{value:.0f}\b", table), value


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
