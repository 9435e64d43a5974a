"""What a worker records of handshakes, in batches, and how the supervisor writes it."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from rse_pf.audit.entry import RefusalLimiter
from rse_pf.auth.tokens import Claims
from rse_pf.identity import RobotId
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.handshake import Accepted, Rejected
from rse_pf.server.worker_context import Clocks
from tests.kit.fakes import FakeLoop

ROBOT = RobotId("default", "robot-1")
CLAIMS = Claims(robot=ROBOT, token_id="t-1", issued_s=1.0, expires_s=900.0, key_id="k-1")
REJECTED = Rejected(status=401, body=b"", result="unauthorized", reason="bad-signature-or-claims")
CLAIMED = "Bearer eyJhbGciOiJFZERTQSJ9.eyJzdWIiOiJyb2JvdC05IiwianRpIjoidC05In0.c2ln"
"""A token that says it is t-9 of robot-9."""


class Recording:
    """A recorder on a loop whose time the test moves."""

    def __init__(self, *, is_on: bool = True, refusals: RefusalLimiter | None = None) -> None:
        self.told: list[dict[str, Any]] = []
        self.loop = FakeLoop(0.0)
        clocks = Clocks(monotonic=self.loop.time, wall=lambda: 1e9 + self.loop.now, cpu=lambda: 0.0)
        self.recorder = AuditRecorder(clocks, refusals=refusals, loop=self.loop, send=self._tell, is_on=is_on)

    @property
    def notes(self) -> list[dict[str, Any]]:
        return [note for message in self.told for note in message["notes"]]

    def _tell(self, **message: Any) -> None:
        assert message["event"] == "audit"
        self.told.append(message)


def test_a_robot_of_another_tenant_is_named_with_it():
    recording = Recording()
    claims = Claims(robot=RobotId("acme", "r"), token_id="t", issued_s=1.0, expires_s=9.0, key_id="k")

    recording.recorder.record_verdict(
        Accepted(robot=claims.robot, codec="bin", subprotocol="x", claims=claims), "", ""
    )
    recording.loop.advance(1.0)

    assert recording.notes[0]["subject"] == "acme/r"


def test_a_refused_token_is_recorded_with_its_reason_and_its_claims():
    recording = Recording()

    recording.recorder.record_verdict(REJECTED, "10.0.0.7", CLAIMED)
    recording.loop.advance(0.1)

    (note,) = recording.notes
    assert (note["action"], note["subject"]) == ("auth.refused", "")
    assert note["detail"] == {
        "reason": "bad-signature-or-claims", "source": "10.0.0.7", "claimed_robot": "robot-9",
        "claimed_token": "t-9",
    }  # fmt: skip


@given(header=st.text(max_size=300) | st.binary(max_size=90).map(lambda b: f"Bearer a.{b.hex()}.c"))
def test_a_refusal_is_recorded_whatever_the_header_holds(header: str):
    recording = Recording()

    recording.recorder.record_verdict(REJECTED, "", header)
    recording.loop.advance(0.1)

    assert len(recording.notes) == 1


def test_a_flood_of_refusals_is_counted():
    recording = Recording(refusals=RefusalLimiter(per_s=0.01, burst=10.0))

    for _ in range(3000):
        recording.recorder.record_verdict(REJECTED, "10.0.0.7", CLAIMED)
    recording.loop.advance(11.0)

    assert [note["action"] for note in recording.notes] == ["auth.refused"] * 10 + ["auth.refused-many"]
    assert recording.notes[-1]["detail"] == {"bad-signature-or-claims": 2990}
    recording.loop.advance(60.0)
    assert len(recording.notes) == 11, "nothing is counted twice"


def test_a_renewal_with_the_same_token_is_not_recorded():
    recording = Recording()
    fresh = Claims(robot=ROBOT, token_id="t-2", issued_s=1.0, expires_s=900.0, key_id="k-1")

    recording.recorder.record_renewal(CLAIMS, CLAIMS)
    recording.recorder.record_renewal(CLAIMS, fresh)
    recording.recorder.record_refused_renewal(CLAIMS, "expired")
    recording.recorder.record_cut_off(fresh, "disabled")
    recording.loop.advance(0.1)

    assert [(note["action"], note["detail"].get("token")) for note in recording.notes] == [
        ("auth.renewed", "t-2"), ("auth.renewal-refused", None), ("auth.cut-off", "t-2"),
    ]  # fmt: skip
