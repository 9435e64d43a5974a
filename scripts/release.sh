#!/bin/sh
# Build the sdist, the wheel and the native cores twice, compare the builds byte by byte, and write their sums:
# sh scripts/release.sh [INTO [MACHINE...]]. Nothing is uploaded.
set -eu
cd "$(dirname "$0")/.."
into=${1:-build/release}
[ $# -eq 0 ] || shift
[ $# -gt 0 ] || set -- x86_64 aarch64
mkdir -p "$into"
into=$(cd "$into" && pwd)
bin=$PWD/.venv/bin
umask 022 # wheels store the modes of files that are made here
SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export SOURCE_DATE_EPOCH
work=$(mktemp -d)
trap '[ $? = 0 ] || tail -n 50 "$work/log" >&2; rm -rf "$work"' EXIT

build() { # build FOLDER TIME_ZONE MACHINE...
  copy=$work/$1 made=$work/$1-made
  mkdir "$copy" "$made"
  git ls-files -z | tar --create --null --files-from=- | tar --extract --directory="$copy"
  TZ=$2
  export TZ
  shift 2
  (
    cd "$copy"
    "$bin/python" -m build --no-isolation --outdir "$made" .
    # Setuptools writes the time of its run and the user's name into the sdist: pack it again without them.
    sdist=$(basename "$made"/*.tar.gz .tar.gz)
    tar --extract --file="$made/$sdist.tar.gz"
    tar --create --sort=name --mtime="@$SOURCE_DATE_EPOCH" --owner=0 --group=0 --numeric-owner --mode=u=rwX,go=rX \
      "$sdist" | gzip --no-name --best > "$made/$sdist.tar.gz"
  )
  for machine in "$@"; do
    sh scripts/native_wheel.sh "$made" "$machine" "$copy/native"
  done
}

build first UTC0 "$@" > "$work/log" 2>&1
build second JST-9 "$@" > "$work/log" 2>&1
diff -r "$work/first-made" "$work/second-made"
"$bin/python" -m twine --no-color check --strict "$work"/first-made/*
rm -f "$into"/*.whl "$into"/*.tar.gz
cp "$work"/first-made/* "$into"
cd "$into"
sha256sum -- *.tar.gz *.whl | tee SHA256SUMS
cd - > /dev/null
[ -z "$(git status --porcelain)" ] || echo "release: not for publication: the checkout differs from its commit" >&2
