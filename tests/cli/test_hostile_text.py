"""Text that robots wrote, in every verb that can show it: nothing comes out that a terminal obeys."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rse_pf.audit.entry import Entry
from rse_pf.audit.log import AuditLog, audit_folder
from rse_pf.cli.main import main
from rse_pf.errors import CommandFailed
from rse_pf.geometry import Camera
from rse_pf.local.processes import ProcessMark
from rse_pf.local.state import PlatformState, ServerState
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
from rse_pf.terminal import printable
from tests.kit.hostile_text import HOSTILE, obeyed

NAME = HOSTILE[:60]


def hostile_map(keyframes: int = 2) -> bytes:
    pose = np.eye(4)
    camera = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    frames = tuple(
        Keyframe(
            id=number, robot=NAME, timestamp_s=float(number), T_world_camera=pose, camera=camera,
            pixels=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), np.uint8),
            points_camera=np.zeros((0, 3), np.float32),
        )
        for number in range(keyframes)
    )  # fmt: skip
    points = np.eye(3, dtype=np.float32)
    colours = np.full((3, 3), 90, np.uint8)
    return encode_map(
        MapVersion(keyframes=frames, points=points, colours=colours, provenance={NAME: HOSTILE})
    )


@pytest.fixture
def place(platform: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A platform's folder with maps, an audit log, a roster and a state in which all text is hostile."""
    maps = MapRegistry(DirectoryStore(platform / "objects"))
    for name in ("a", "b"):
        first = maps.commit(name, hostile_map(), parent=None, author=NAME, created_s=1e9, note=HOSTILE[:60])
        maps.commit(name, hostile_map(3), parent=first.id, author=NAME, created_s=2e9, note=HOSTILE[:60])
    log = AuditLog(audit_folder(platform), "server-1", wall_clock=lambda: 1e9, on_problem=pytest.fail).open()
    detail = {HOSTILE: HOSTILE}
    log.add([Entry(time=1e9, actor=HOSTILE, action=HOSTILE, subject=HOSTILE, detail=detail)])
    log.close()
    (platform / "control").mkdir()
    robots = [{"robot": HOSTILE[:64], "x": "A" * 43, "scopes": [HOSTILE], "quotas": {HOSTILE: 1.0}}]
    (platform / "control" / "robots.json").write_text(json.dumps({"robots": robots}))
    gone = ProcessMark(pid=2**22 + 1, began="")
    PlatformState(
        name="default", control_plane=gone, url=f"ws://{HOSTILE}/ws", settings_digest="", settings_file="",
        key_file="", servers=(ServerState(name=HOSTILE, process=gone),),
    ).write(platform)  # fmt: skip
    stranger = token({"sub": HOSTILE, "jti": HOSTILE, "exp": 4e9})
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{stranger}\n"))
    return platform


def token(claims: dict[str, Any]) -> str:
    """Return a token with a header and claims of a stranger, and no valid signature."""
    parts = (json.dumps(each).encode() for each in ({"alg": "EdDSA", "kid": HOSTILE}, claims))
    return ".".join([base64.urlsafe_b64encode(part).decode().rstrip("=") for part in parts] + ["c2ln"])


def at(place: Path) -> tuple[str, str]:
    return "--store", f"dir:{place / 'objects'}"


CASES: list[Callable[[Path], tuple[str, ...]]] = [
    lambda place: ("map", "list", *at(place)),
    lambda place: ("map", "list", "--json", *at(place)),
    lambda place: ("map", "show", "a", *at(place)),
    lambda place: ("map", "show", "a", "--json", *at(place)),
    lambda place: ("map", "show", "a", "--all", *at(place)),
    lambda place: ("map", "show", "a", "--png", str(place / "a.png"), *at(place)),
    lambda place: ("map", "show", HOSTILE, *at(place)),
    lambda place: ("map", "view", "a", "--out", str(place / "b.png"), *at(place)),
    lambda place: ("map", "diff", "a", "head", *at(place)),
    lambda place: ("map", "rollback", "a", HOSTILE, *at(place)),
    lambda place: ("map", "export", "a", "--format", "tum", "--out", str(place / "a.tum"), *at(place)),
    lambda place: (
        "map", "export", "a", "--format", "tum", "--robot", HOSTILE, "--out", str(place / "a.tum"), *at(place)
    ),
    lambda place: ("map", "localise", "a", HOSTILE, *at(place)),
    lambda place: ("audit", "show"),
    lambda place: ("audit", "show", "--json"),
    lambda place: ("audit", "show", "--only", "\x1b"),
    lambda place: ("robot", "list"),
    lambda place: ("robot", "list", "--json"),
    lambda place: ("robot", "disable", HOSTILE),
    lambda place: ("robot", "remove", HOSTILE[:64]),
    lambda place: ("token", "inspect", "-"),
    lambda place: ("token", "revoke", "-"),
    lambda place: ("token", "issue", HOSTILE),
    lambda place: ("local", "status"),
    lambda place: ("local", "kill", f"{HOSTILE}2"),
    lambda place: ("service", "list", "--services", HOSTILE),
    lambda place: ("service", "new", HOSTILE),
    lambda place: ("experiment", "verify", str(place)),
    lambda place: ("replay", HOSTILE),
    lambda place: (HOSTILE,),
    lambda place: ("map", HOSTILE),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(map(printable, case(Path())[:3])))
def test_no_verb_writes_what_a_terminal_obeys(
    case: Callable[[Path], tuple[str, ...]], place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code = main(list(case(place)))

    told = capfd.readouterr()
    assert code in (0, 1, 2)
    assert "Traceback" not in told.err
    assert obeyed(told.out + told.err) == set()
    assert not [line for line in (told.out + told.err).splitlines() if line.startswith("ok: forged")]
    assert (told.out + told.err).strip(), "a case that shows nothing proves nothing"


def test_what_the_verbs_show_is_the_hostile_text_and_not_an_error(
    place: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shown = ("map", "list"), ("map", "show", "a"), ("audit", "show"), ("robot", "list"), ("local", "status")
    for words in shown:
        assert main([*words, *(at(place) if words[0] == "map" else ())]) == 0
        assert "r\\x1b[2J" in capfd.readouterr().out.replace("\\u001b", "\\x1b"), words


def test_the_answer_of_a_service_and_its_failure_are_escaped(
    place: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    class Robot:
        def __init__(self, *args: object, **options: object) -> None:
            pass

        async def __aenter__(self) -> Robot:
            return self

        async def __aexit__(self, *error: object) -> None:
            pass

        async def call(self, name: str, payload: Any) -> Any:
            if payload:
                raise CommandFailed(HOSTILE, hint=HOSTILE)
            return type("Answer", (), {"reply": {HOSTILE: HOSTILE}})

    monkeypatch.setattr("client_sdk.connect", Robot)

    assert main(["service", "call", "x"]) == 0
    assert main(["service", "call", "x", "--request", "[1]"]) == 1

    told = capfd.readouterr()
    assert "forged" in told.out
    assert "forged" in told.err
    assert obeyed(told.out + told.err) == set()


@pytest.mark.system
def test_what_a_service_prints_and_raises_in_a_dry_run_is_escaped(
    platform: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    main(["service", "new", "loud"])
    source = (
        f"import msgspec\n\ntext = {HOSTILE!a}\n\nclass Any(msgspec.Struct):\n    pass\n\n"
        "def serve(request: Any) -> Any:\n    print(text)\n    raise ValueError(text)\n"
    )
    Path("loud/service.py").write_text(source)

    assert main(["service", "test", "loud"]) == 1

    told = capfd.readouterr()
    assert "forged" in told.out
    assert obeyed(told.out + told.err) == set()
