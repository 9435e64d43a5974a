#!/bin/sh
# Write locks/*.txt: every package with its hashes, for Python 3.10 and newer on Linux x86-64.
set -eu
cd "$(dirname "$0")/.."

lock() { # lock FILE EXTRA...
  file=$1
  shift
  extras=$(for extra in "$@"; do printf -- '--extra %s ' "$extra"; done)
  # shellcheck disable=SC2086
  .venv/bin/uv pip compile pyproject.toml --quiet --universal --python-version 3.10 --generate-hashes \
    --no-emit-index-url --no-emit-find-links --no-annotate --no-emit-package rse-pf \
    --constraint locks/constraints.txt --custom-compile-command 'make lock' \
    $extras --output-file "locks/$file.txt"
}

lock demo demo build
lock dev dev
lock infra infra dev
