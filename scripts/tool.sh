#!/bin/sh
# Install one package of locks/tools.txt into a folder of its own, once: sh scripts/tool.sh ziglang build/ziglang
set -eu
cd "$(dirname "$0")/.."
package=$1 folder=$2

wanted=$(sed -n "/^$package==/,/[^\\\\]\$/p" locks/tools.txt)
[ "$(cat "$folder/locked.txt" 2> /dev/null || true)" = "$wanted" ] && exit 0
echo "setup: installing $package of locks/tools.txt into $folder (once)" >&2
rm -rf "$folder"
mkdir -p "$folder"
echo "$wanted" > "$folder/wanted.txt"
.venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes --no-deps \
  --only-binary=:all: --target "$folder" --requirement "$folder/wanted.txt"
mv "$folder/wanted.txt" "$folder/locked.txt"
