#!/bin/sh
# Fail if `make docs` would change a page, which then has to be committed; otherwise build the site.
set -eu
cd "$(dirname "$0")/.."
before=$(mktemp -d)
trap 'rm -rf "$before"' EXIT
cp -R docs "$before/docs"
make --no-print-directory docs
diff -r "$before/docs" docs || { echo "docs: run make docs, and commit what it writes" >&2; exit 1; }
make --no-print-directory site
