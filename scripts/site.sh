#!/bin/sh
# Build the documentation site into build/site, without the network, and check it.
set -eu
cd "$(dirname "$0")/.."
PATH="$PWD/.venv/bin:$PATH"
# What the theme prints about its own future is no warning about our pages.
NO_MKDOCS_2_WARNING=1 PYTHONPATH=. python -m mkdocs build --quiet --clean --config-file scripts/site/mkdocs.yml
python scripts/site/check.py build/site
