#!/bin/sh
# Write locks/*.txt: every package with its hashes, for Python 3.10 and newer on Linux x86-64.
set -eu
cd "$(dirname "$0")/.."

lock() { # lock FILE ARGUMENT...
  file=$1
  shift
  .venv/bin/uv pip compile "$@" --quiet --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
    --no-emit-package rse-pf --no-emit-package rse-pf-native --custom-compile-command 'make lock' \
    --output-file "locks/$file.txt"
}

every="--universal --python-version 3.10"
# shellcheck disable=SC2086
{
  lock demo pyproject.toml $every --extra demo --group build
  lock dev pyproject.toml $every --extra local --extra aws --extra batch --extra bags --extra calibrate \
    --extra experiments --group dev
  # Packages that share .venv with those of developers have the same versions as in the lock of developers.
  lock ci pyproject.toml $every --group ci --constraint locks/dev.txt
  lock tools $every --group tools
  # LocalStack has its own environment, since later releases of its dependencies break it.
  lock localstack --universal --python-version 3.11 --group localstack --exclude-newer 2025-10-25
}

# Servers and functions run on one platform, so that their locks have no conditions.
one="--python-platform x86_64-manylinux_2_28"
# shellcheck disable=SC2086
{
  lock boot pyproject.toml $one --python-version 3.11 --extra backend --extra aws --extra batch --group boot # Debian 12
  lock lambda lambda_pnp/requirements.txt $one --python-version 3.13 # the runtime of stacks/serverless_stack.py
  lock ros2 pyproject.toml $one --python-version 3.11 --extra ros2 tests/ros_bridge/tf2_msgs/generators.in
}
