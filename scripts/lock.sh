#!/bin/sh
# Write locks/*.txt: every package with its hashes, for Python 3.10 and newer on Linux x86-64.
set -eu
cd "$(dirname "$0")/.."

ours="--no-emit-package rse-pf --no-emit-package rse-pf-native"
constraints="--constraint locks/constraints.txt"

lock() { # lock FILE EXTRA...
  file=$1
  shift
  extras=$(for extra in "$@"; do printf -- '--extra %s ' "$extra"; done)
  # shellcheck disable=SC2086
  .venv/bin/uv pip compile pyproject.toml --quiet --universal --python-version 3.10 --generate-hashes \
    --no-emit-index-url --no-emit-find-links --no-annotate $ours \
    $constraints --custom-compile-command 'make lock' \
    $extras --output-file "locks/$file.txt"
}

lock demo demo build
lock dev dev
lock infra infra dev
# What one .venv holds beside the packages of developers has the same versions as they.
constraints="$constraints --constraint locks/infra.txt"
lock docs docs build
lock release release build
lock browser browser
lock xfeat xfeat
lock ros ros
lock batch batch build
# A client of the conformance table, which the platform itself does not need.
# shellcheck disable=SC2086
.venv/bin/uv pip compile tests/clients/rosbridge.in --quiet --universal --python-version 3.10 \
  --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate $constraints \
  --custom-compile-command 'make lock' --output-file locks/rosbridge.txt
# The oldest Node that the documentation names, beside the one of the extra infra.
.venv/bin/uv pip compile tests/clients/oldest_node.in --quiet --universal --python-version 3.10 \
  --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
  --custom-compile-command 'make lock' --output-file locks/oldest-node.txt
# What boots has one platform, so its locks have no conditions.
for_platform() { # for_platform FILE PYTHON INPUT...
  file=$1 python=$2
  shift 2
  # shellcheck disable=SC2086
  .venv/bin/uv pip compile "$@" --quiet --python-version "$python" --python-platform x86_64-manylinux_2_28 \
    --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate $ours \
    --constraint locks/constraints.txt --custom-compile-command 'make lock' --output-file "locks/$file.txt"
}

for_platform boot 3.11 pyproject.toml --extra boot       # Debian 12
for_platform lambda 3.13 lambda_pnp/requirements.txt     # the runtime of stacks/serverless_stack.py
# shellcheck disable=SC2086
.venv/bin/uv pip compile pyproject.toml --extra ros2 tests/ros_bridge/tf2_msgs/generators.in --quiet \
  --python-version 3.11 --python-platform x86_64-manylinux_2_28 --generate-hashes --no-emit-index-url \
  --no-emit-find-links --no-annotate $ours --constraint locks/constraints.txt \
  --custom-compile-command 'make lock' --output-file locks/ros2.txt

# LocalStack in an environment of its own: later releases of what it needs break it.
.venv/bin/uv pip compile locks/localstack.in --quiet --universal --python-version 3.11 \
  --exclude-newer 2025-10-25 --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
  --custom-compile-command 'make lock' --output-file locks/localstack.txt

# The compiler of the native core for aarch64: scripts/assets.py --arm.
.venv/bin/uv pip compile --group native/pyproject.toml:cross --quiet --universal --python-version 3.10 \
  --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate \
  --custom-compile-command 'make lock' --output-file locks/native.txt
