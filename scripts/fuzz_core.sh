#!/bin/sh
# Fuzz a target of the native core, guided by the coverage of the core itself, with sanitizers:
# sh scripts/fuzz_core.sh [TARGET] [SECONDS].  Needs clang++ and atheris, which contains libFuzzer; without them the
# script exits with 0.
set -eu
cd "$(dirname "$0")/.."
target=${1:-match}
seconds=${2:-60}
python=.venv/bin/python

skip() {
  echo "fuzz_core: skipped: $1"
  exit 0
}

command -v clang++ > /dev/null 2>&1 || skip "no clang++"
fuzzer=$("$python" -c 'import atheris; print(atheris.path())' 2> /dev/null) || skip "no atheris"
fuzzer=$fuzzer/asan_with_fuzzer.so
[ -e "$fuzzer" ] || skip "no $fuzzer"

folder=$PWD/build/fuzzed
# Two checks are off, since they need a runtime library that atheris does not contain.
flags="-O1 -g -fsanitize=address,undefined,fuzzer-no-link -fno-sanitize=function,vptr -fno-sanitize-recover=all \
  -ftrivial-auto-var-init=pattern"
mkdir -p "$folder"
make --no-print-directory -C native OUT="$folder/rse_pf_native" CXX=clang++ EXTRA="$flags" all > "$folder.log" 2>&1 \
  || { cat "$folder.log" >&2; exit 1; }
: > "$folder/rse_pf_native/__init__.py"

# As in sanitize.sh: leaks of Python are not reported, and Python's allocator is off, since it would hide writes
# beyond a buffer.
export ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONMALLOC=malloc PYTHONPATH="$folder"
export LD_PRELOAD="$fuzzer"
exec "$python" -m fuzz "$target" --engine atheris --seconds "$seconds"
