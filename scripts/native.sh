#!/bin/sh
# Compile the native core into native/build, once per change: sh scripts/native.sh
# Where no C++ compiler works, that of the ziglang wheel of locks/tools.txt is used (100 MB, once).
set -eu
cd "$(dirname "$0")/.."
log=build/native.log

fail() {
  echo "setup: $1" >&2
  echo "  hint: $2" >&2
  exit 2
}

compile() {
  echo "setup: compiling the native core with $1 (once per change)"
  make -j2 -C native CXX="$1" ARCH="$(uname -m)" > "$log" 2>&1
}

make -q -C native > /dev/null 2>&1 && exit 0
mkdir -p build
compiler=${CXX:-$(command -v c++ || command -v g++ || command -v clang++ || true)}
if [ -n "$compiler" ] && compile "$compiler"; then exit 0; fi
rm -rf native/build
[ -z "${CXX:-}" ] || fail "the native core does not compile with $CXX" "read $log; g++ 11 and clang 14 are new enough"

sh scripts/tool.sh ziglang build/ziglang \
  || fail "no C++ compiler works here, and ziglang cannot be installed" "sudo apt-get install g++, or see pip's lines above"
export ZIG_GLOBAL_CACHE_DIR="$PWD/build/zig-cache" ZIG_LOCAL_CACHE_DIR="$PWD/build/zig-cache"
compile "../build/ziglang/ziglang/zig c++ -target $(uname -m)-linux-gnu.2.28" \
  || fail "the native core does not compile with ziglang" "read $log; sudo apt-get install g++"
