"""Each stumble of the second newcomers has a test that the code of commit 2e640ff fails.

``since`` names what 2e640ff does not have, so that the test cannot pass there.  ``run``: the test was run on
the files of 2e640ff and failed.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

STUMBLES = {
    "wrong calibration is accepted in silence": "tests/client_sdk/check/test_calibration.py"
    "::test_a_planted_fault_is_the_first_finding_with_its_value",  # since rse-pf check
    "replay says nothing went wrong, and its JSON blames the depth scale": "tests/cli/test_replay.py"
    "::test_of_good_poses_text_and_json_blame_no_calibration_and_name_who_judges_it",  # run
    "two robots of live_map_recording share a spool": "tests/client_sdk/live/test_live_mapper.py"
    "::test_a_spool_in_use_is_refused_in_one_line_and_free_again_when_its_program_ends",
    "live maps have no cloud": "tests/backend/live_map/owner/test_keyframe_objects.py"
    "::test_points_lie_where_their_keyframe_is_now",  # since points of keyframes
    "a shipped result does not hold any more": "tests/experiments/paper/test_shipped_results.py"
    "::test_a_report_reaches_the_figures_of_its_own_short_form",  # since verify --rerun
    "blurred frames are told as something else": "tests/client_sdk/check/test_images.py"
    "::test_every_second_frame_is_blurred",  # since rse-pf check
    "map from-camera leaves nothing to localise in": "tests/cli/maps/test_map_store.py"
    "::test_the_map_of_a_video_in_metres_can_be_localised_in",  # since --keep
    "own features cannot be given by an option": "tests/client_sdk/test_slots.py"
    "::test_a_mapper_tracks_with_the_features_of_its_user",  # since --features
    "no stereo": "tests/cli/maps/test_bags.py::test_a_bag_of_a_stereo_pair_becomes_a_map_in_metres",
    "no IMU": "tests/ros_bridge/test_rig_topics.py"
    "::test_a_file_of_a_rig_rectifies_the_pair_and_places_the_imu",  # since rig.json
    "colours only never start a second map after a cut": "tests/client_sdk/tracking/test_monocular_tracker.py"
    "::test_a_second_place_gets_a_segment_of_its_own_and_is_never_joined",  # since MonocularTracker
    "the map view that is opened late shows one dot": "tests/backend/live_map/owner/test_keyframe_objects.py"
    "::test_live_show_has_whole_paths_in_the_map_where_they_are_asked_for",
    "bags.md says that make demo installs rosbags": "tests/docs/test_true_sentences.py"
    "::test_pages_say_truly_what_make_installs",  # run
    "map from-camera ignores groundtruth.txt": "tests/cli/maps/test_from_camera.py"
    "::test_a_recording_with_true_poses_tells_the_error_of_the_path",
    "the FAQ says there is no ROS node": "tests/docs/test_true_sentences.py"
    "::test_no_page_denies_what_is_there",  # run
    "alternatives.md knows one client": "tests/docs/test_true_sentences.py"
    "::test_alternatives_name_each_client_that_there_is",  # run
    "the reference lists no fields": "tests/docs/test_true_sentences.py"
    "::test_the_reference_lists_the_fields_of_dataclasses",
    "data.md has other names than the objects": "tests/docs/test_true_sentences.py"
    "::test_the_format_of_maps_names_its_objects",  # run
    "localise has no covariance": "tests/data_server/test_localise.py"
    "::test_a_photo_is_found_with_its_covariance",
    "--store must be typed": "tests/cli/maps/test_map_store.py"
    "::test_the_store_of_the_one_platform_that_runs_is_found",
    "--rate 30 plays 220 of 330 frames": "tests/client_sdk/datasets/test_thinning.py"
    "::test_the_own_rate_and_higher_ones_play_every_frame",
    "an unknown option of local is told as an action": "tests/cli/test_main.py"
    "::test_a_wrong_call_is_two_lines_and_exit_code_2",  # run
    "ROS 2 is on the README's list of what it cannot do": "tests/docs/test_true_sentences.py"
    "::test_no_page_denies_what_is_there",
}


@pytest.mark.parametrize("stumble", STUMBLES)
def test_a_stumble_has_its_test(repository: Path, stumble: str) -> None:
    file, _, name = STUMBLES[stumble].partition("::")
    tree = ast.parse((repository / file).read_text(encoding="utf-8"))

    assert name in {each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)}
