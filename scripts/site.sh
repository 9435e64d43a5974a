#!/bin/sh
# Build the documentation site into build/site, without the network.  mkdocs is strict: a link of a page, or of
# README, CONTRIBUTING and CHANGELOG, to a file or heading that does not exist is a warning, and fails
# the build.  mkdocs counts only the warnings that it prints, so that --quiet must not be set.
set -eu
cd "$(dirname "$0")/.."
PATH="$PWD/.venv/bin:$PATH"
# Messages of the theme about its own future versions are no warnings about our pages.
NO_MKDOCS_2_WARNING=1 PYTHONPATH=. python -m mkdocs build --clean --config-file scripts/site/mkdocs.yml
python scripts/site/check.py build/site
