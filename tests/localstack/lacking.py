"""Which tests of AWS cannot pass on LocalStack 4.9, and the service that its community edition lacks.

The list is exact: a test here that passes fails the run, as one that fails and is not here does.
"""

from __future__ import annotations

__all__ = ["LACKING"]

LACKING = {
    (
        "tests/aws/lifecycle/test_idle.py",
        "test_a_mail_that_cannot_be_sent_changes_nothing_and_the_next_hour_parks",
    ): "autoscaling",
    ("tests/aws/fleet/test_group.py", "test_a_number_older_than_three_periods_is_unknown"): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_each_server_has_the_robots_that_its_agent_published_last",
    ): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_numbers_of_the_group_and_of_servers_are_read_in_one_request",
    ): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_servers_and_alarms_are_shown_and_unknown_robots_are_not_zero",
    ): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_the_current_period_is_left_out_so_that_no_server_is_missing_from_the_sum",
    ): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_the_overview_adds_balancer_ages_and_activities_and_asks_no_metric",
    ): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_the_page_of_the_cloud_needs_the_permissions_that_its_documentation_lists",
    ): "elbv2",
    ("tests/aws/fleet/test_group.py", "test_the_status_shows_what_a_running_agent_publishes"): "elbv2",
    (
        "tests/aws/fleet/test_group.py",
        "test_what_is_refused_beside_the_group_is_a_problem_and_not_an_error",
    ): "elbv2",
    ("tests/aws/fleet/test_group.py", "test_without_a_platform_the_hint_says_to_deploy"): "autoscaling",
    (
        "tests/aws/lifecycle/test_idle.py",
        "test_a_deployment_whose_agents_are_silent_is_not_parked",
    ): "autoscaling",
    (
        "tests/aws/lifecycle/test_idle.py",
        "test_after_the_last_idle_hour_the_servers_end_and_resume_brings_them_back",
    ): "autoscaling",
    (
        "tests/aws/lifecycle/test_killed.py",
        "test_parking_that_is_ended_between_note_and_group_is_finished_by_the_same_command",
    ): "autoscaling",
}
