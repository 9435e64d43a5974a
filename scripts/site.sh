#!/bin/sh
# Build the documentation site into build/site, without the network.  mkdocs is strict: a link of a page, or of
# README, CONTRIBUTING and CHANGELOG, to a file or heading that does not exist is a warning, and fails.  It
# counts only the warnings that it prints, so it is not --quiet.
set -eu
cd "$(dirname "$0")/.."
PATH="$PWD/.venv/bin:$PATH"
# What the theme prints about its own future is no warning about our pages.
NO_MKDOCS_2_WARNING=1 PYTHONPATH=. python -m mkdocs build --clean --config-file scripts/site/mkdocs.yml
python scripts/site/check.py build/site
