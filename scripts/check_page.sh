#!/bin/sh
# Test the fleet page in Debian's Chromium without the long tests; `make browser` runs all tests of the page.
set -eu
cd "$(dirname "$0")/.."
if ! command -v chromium-headless-shell > /dev/null && ! command -v chromium > /dev/null; then
  echo "skipped: no Chromium (sudo apt-get install chromium-headless-shell)"
  exit 0
fi
sh scripts/setup.sh dev ci
exec .venv/bin/python -m pytest -q -rs -s -n 0 -m slow tests/fleet_page/test_in_chromium.py \
  -k "not million_points and not pause_move_drain"
