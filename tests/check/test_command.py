"""The verb check: findings with fixes, corrections, reports, and what results of a map say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from client_sdk.check.corrections import corrected
from client_sdk.check.drive_check import DriveCheck
from client_sdk.check.findings import FaultKind, Finding
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.cli.main import main
from rse_pf.geometry import Camera

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)


def finding(kind: FaultKind, value: float, deviation: float = 0.001, **correction: float) -> Finding:
    return Finding(
        kind=kind, value=value, deviation=deviation, unit="relative", cost_m=0.2, sentence="it is off",
        fix="set it", correction=correction,
    )  # fmt: skip


def test_what_is_certain_corrects_the_intrinsics_and_nothing_else_does() -> None:
    own = Intrinsics(camera=CAMERA, depth_scale=5000.0, rms_px=0.3, views=20)

    made, changes = corrected(
        own,
        [
            finding(FaultKind.DEPTH_SCALE, 4.0),
            finding(FaultKind.FOCAL_LENGTH, 0.1, fx=454.5),
            finding(FaultKind.PRINCIPAL_POINT, 0.1, deviation=0.1, cx=999.0),
        ],
    )

    assert (made.depth_scale, made.camera.fx, made.camera.cx) == (1000.0, 454.5, 320.0)
    assert made.rms_px is None
    assert len(changes) == 2


def test_distortion_is_not_added_to_that_of_a_lens() -> None:
    bent = Intrinsics(camera=CAMERA, distortion=(0.1, 0.0, 0.0, 0.0))
    found = [finding(FaultKind.DISTORTION, -0.1, k1=-0.1)]

    assert corrected(bent, found) == (bent, ())
    assert corrected(Intrinsics(camera=CAMERA), found)[0].distortion == (-0.1, 0.0, 0.0, 0.0)


def test_no_lens_model_but_radial_tangential_takes_the_distortion_of_a_pinhole() -> None:
    fisheye = Intrinsics(camera=CAMERA, model="fisheye")

    assert corrected(fisheye, [finding(FaultKind.DISTORTION, -0.1, k1=-0.1)]) == (fisheye, ())


def test_an_error_of_the_check_is_one_line_and_costs_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    check = DriveCheck()
    check.add(None, None)  # type: ignore[arg-type]  # a frame that it cannot read
    told = check.finish()

    (line,) = check.lines(told)
    assert line.startswith("check: it failed (AttributeError")
    assert "--no-check" in line


def test_results_of_a_map_say_what_was_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "trajectory.txt").write_text("# none\n")
    report = {"findings": [finding(FaultKind.BLUR, 0.5).to_dict()], "cannot_tell": [], "frames": 9}
    (tmp_path / "report.json").write_text(json.dumps({"frames": 9, "check": report}))

    assert main(["check", str(tmp_path)]) == 1
    assert "it is off" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        '{"check": {"findings": "x"}}', '{"check": {"findings": [1, null, {}]}}',
        '{"check": {"findings": [{"cost": "x"}]}}', '{"check": {"findings": [[[]]]}}',
        '{"check": {"findings": 5}}', '{"check": {"findings": [], "notes": 5}}',
        '{"check": {"findings": [], "source": ["x"]}}', "[]", '{"check": 5}', '{"check": {"frames": 9',
        '{"check":' + "[" * 200_000 + "]" * 200_000 + "}", '{"check": {"frames": ' + "9" * 5000 + "}}",
    ],
)  # fmt: skip
def test_results_that_no_map_has_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    (tmp_path / "report.json").write_text(text)

    assert main(["check", str(tmp_path)]) == 2
    said, hint = capsys.readouterr().err.splitlines()
    assert "report.json" in said or "was not checked" in said
    assert hint == "  hint: check the recording itself" or "are checked" in hint


@pytest.mark.parametrize("option", ["--odometry", "--intrinsics", "--write", "--out"])
def test_results_of_a_map_take_no_other_option(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.json").write_text(json.dumps({"check": {"findings": [], "frames": 9}}))

    assert main(["check", str(tmp_path), option, str(tmp_path / "x")]) == 2
    assert f"no {option}" in capsys.readouterr().err


def test_a_rendered_recording_with_a_wrong_depth_scale_is_corrected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    from client_sdk.simulator import render_frames, true_trajectory
    from tests.kit.tum_recording import write_tum

    write_tum(tmp_path, render_frames(0, 1, 40, 3), true_trajectory(0, 1, 40, 3), depth_scale=1100)

    code = main(
        ["check", str(tmp_path), "--out", str(tmp_path / "out"), "--write", str(tmp_path / "better.json")]
    )

    report = json.loads((tmp_path / "out/report.json").read_text())
    assert code == 1
    assert report["findings"][0]["kind"] == "depth_scale"
    assert report["findings"][0]["value"] == pytest.approx(0.1, abs=0.02)
    assert json.loads((tmp_path / "better.json").read_text())["depth_scale"] == pytest.approx(1000, rel=0.02)
    assert "depth scale is set" in capsys.readouterr().out


def test_without_depth_nothing_is_said_about_the_depth_of_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    from client_sdk.simulator import render_frames, true_trajectory
    from tests.kit.tum_recording import write_tum

    write_tum(tmp_path, render_frames(0, 1, 12, 3), true_trajectory(0, 1, 12, 3), depth_scale=1100)

    main(["check", str(tmp_path), "--no-depth", "--json"])
    report = json.loads(capsys.readouterr().out)
    said = {each["kind"] for each in (*report["findings"], *report["cannot_tell"])}
    assert said
    assert not any(kind.startswith("depth") for kind in said)


def test_nothing_is_advised_while_the_source_has_a_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    from client_sdk.simulator import render_frames, true_trajectory
    from tests.kit.tum_recording import write_tum

    write_tum(tmp_path, render_frames(0, 1, 40, 3), true_trajectory(0, 1, 40, 3), depth_scale=1100)
    (tmp_path / "rgb/020.png").write_bytes(b"")

    assert main(["check", str(tmp_path)]) == 1
    told = capsys.readouterr().out
    assert "finding left-out: 1 image left out, damaged or empty: 020.png" in told
    assert "check: no advice" in told
    assert "depth scale" not in told
    assert main(["check", str(tmp_path), "--accept", "left-out"]) == 1
    assert "depth scale is set" in capsys.readouterr().out
    assert main(["check", str(tmp_path), "--accept", "leftout"]) == 2
    assert "did you mean left-out?" in capsys.readouterr().err
