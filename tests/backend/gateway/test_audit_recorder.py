"""What a worker notes of its door, in batches, and how the supervisor writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.audit.chain import RefusalLimiter
from rse_pf.audit.log import files_of
from rse_pf.audit.verify import check_folder, entries_of
from rse_pf.auth.tokens import Claims
from rse_pf.backend.gateway.audit_recorder import AuditRecorder, open_records
from rse_pf.backend.gateway.handshake import Accepted, Rejected
from rse_pf.backend.ports import Clocks

CLAIMS = Claims(robot="robot-1", token_id="t-1", issued_s=1.0, expires_s=900.0, key_id="k-1")
LET_IN = Accepted(robot="robot-1", codec="bin", subprotocol="x", claims=CLAIMS)
REFUSED = Rejected(status=401, body=b"", result="unauthorized", reason="bad-signature-or-claims")
SHOWN = "Bearer eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyb2JvdC05IiwianRpIjoidC05In0.c2ln"
"""A token that says it is t-9 of robot-9."""


class Room:
    """A witness on a loop whose timers fire by hand."""

    def __init__(self, *, is_on: bool = True, refusals: RefusalLimiter | None = None) -> None:
        self.told: list[dict[str, Any]] = []
        self.now_s = 0.0
        self._timers: list[tuple[float, Callable[[], object]]] = []
        clocks = Clocks(monotonic=lambda: self.now_s, wall=lambda: 1e9 + self.now_s, cpu=lambda: 0.0)
        self.witness = AuditRecorder(
            clocks, refusals=refusals, loop=self, tell=self._tell if is_on else None  # type: ignore[arg-type]
        )  # fmt: skip

    def call_later(self, delay: float, callback: Callable[[], object]) -> Mock:
        self._timers.append((self.now_s + delay, callback))
        return Mock()

    def pass_s(self, seconds: float) -> None:
        end = self.now_s + seconds
        while self._timers and min(self._timers)[0] <= end:
            self._timers.sort(key=lambda timer: timer[0])
            self.now_s, callback = self._timers.pop(0)
            callback()
        self.now_s = end

    @property
    def notes(self) -> list[dict[str, Any]]:
        return [note for message in self.told for note in message["notes"]]

    def _tell(self, **message: Any) -> None:
        assert message["event"] == "audit"
        self.told.append(message)


def test_whoever_comes_in_is_noted_by_robot_token_key_and_source():
    room = Room()

    room.witness.judged(LET_IN, "10.0.0.7", SHOWN)
    assert room.told == [], "a handshake waits for nothing"
    room.pass_s(0.1)

    (note,) = room.notes
    assert (note["action"], note["subject"], note["time"]) == ("auth.accepted", "robot-1", 1e9)
    assert note["detail"] == {"token": "t-1", "key": "k-1", "source": "10.0.0.7"}


def test_a_robot_of_another_tenant_is_named_with_it():
    room = Room()
    claims = Claims(robot="r", tenant="acme", token_id="t", issued_s=1.0, expires_s=9.0, key_id="k")

    room.witness.judged(Accepted(robot="r", codec="bin", subprotocol="x", claims=claims), "", "")
    room.pass_s(1.0)

    assert room.notes[0]["subject"] == "acme/r"


def test_a_refused_token_is_noted_with_its_reason_and_what_it_claimed():
    room = Room()

    room.witness.judged(REFUSED, "10.0.0.7", SHOWN)
    room.pass_s(0.1)

    (note,) = room.notes
    assert (note["action"], note["subject"]) == ("auth.refused", "")
    assert note["detail"] == {
        "reason": "bad-signature-or-claims", "source": "10.0.0.7", "claimed_robot": "robot-9",
        "claimed_token": "t-9",
    }  # fmt: skip


def test_the_head_of_a_handshake_with_a_wrong_path_is_no_authentication():
    room = Room()

    room.witness.judged(Rejected(status=404, body=b"", result="not-found"), "10.0.0.7", SHOWN)
    room.pass_s(60.0)

    assert room.notes == []


@given(header=st.text(max_size=300) | st.binary(max_size=90).map(lambda b: f"Bearer a.{b.hex()}.c"))
def test_whatever_a_header_holds_the_refusal_is_noted(header: str):
    room = Room()

    room.witness.judged(REFUSED, "", header)
    room.pass_s(0.1)

    assert len(room.notes) == 1


def test_a_flood_of_refusals_is_summed_up():
    room = Room(refusals=RefusalLimiter(per_s=0.0, burst=10.0))

    for _ in range(3000):
        room.witness.judged(REFUSED, "10.0.0.7", SHOWN)
    room.pass_s(11.0)

    assert [note["action"] for note in room.notes] == ["auth.refused"] * 10 + ["auth.refused-many"]
    assert room.notes[-1]["detail"] == {"bad-signature-or-claims": 2990}
    room.pass_s(60.0)
    assert len(room.notes) == 11, "nothing is summed up twice"


def test_many_notes_travel_in_several_messages():
    room = Room()

    for _ in range(1200):
        room.witness.judged(LET_IN, "", "")
    room.pass_s(0.1)

    assert [len(message["notes"]) for message in room.told] == [500, 500, 200]


def test_a_renewal_with_the_same_token_is_no_news():
    room = Room()
    fresh = Claims(robot="robot-1", token_id="t-2", issued_s=1.0, expires_s=900.0, key_id="k-1")

    room.witness.renewed(CLAIMS, CLAIMS)
    room.witness.renewed(CLAIMS, fresh)
    room.witness.renewal_refused(CLAIMS, "expired")
    room.witness.cut_off(fresh, "disabled")
    room.pass_s(0.1)

    assert [(note["action"], note["detail"].get("token")) for note in room.notes] == [
        ("auth.renewed", "t-2"), ("auth.renewal-refused", None), ("auth.cut-off", "t-2"),
    ]  # fmt: skip


def test_a_server_without_an_audit_log_notes_nothing():
    room = Room(is_on=False)

    room.witness.judged(LET_IN, "", "")
    room.witness.judged(REFUSED, "", "")
    room.pass_s(60.0)
    room.witness.flush()

    assert room.told == []


def test_what_workers_say_is_written_by_the_supervisor_and_other_words_go_on(tmp_path: Path):
    room, others = Room(), []
    room.witness.judged(LET_IN, "10.0.0.7", "")
    room.witness.flush()

    with open_records(tmp_path, "server-1") as records:
        hear = records.heard(lambda worker, message: others.append(message))
        hear("worker", room.told[0])
        hear("worker", {"event": "left", "robot": "robot-1"})
        records.note("server.over", exit_code=0)

    entries = list(entries_of(files_of(tmp_path, "server-1")))
    assert [(entry.actor, entry.action) for entry in entries] == [
        ("server-1", "auth.accepted"), ("server-1", "server.over"),
    ]  # fmt: skip
    assert others == [{"event": "left", "robot": "robot-1"}]
    assert check_folder(tmp_path)[0].problem == ""


@pytest.mark.parametrize("message", [{"event": "audit", "notes": []}])
def test_without_a_folder_notes_are_dropped(message: dict[str, Any]):
    with open_records(None, "server-1") as records:
        assert not records.is_on
        records.heard(lambda worker, other: None)("worker", message)
        records.note("server.over")
