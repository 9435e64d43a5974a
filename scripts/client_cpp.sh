#!/bin/sh
# Compile the test driver of the C++ client into client_cpp/build, or print missing packages with the command that
# installs them.
# `sh scripts/client_cpp.sh all` compiles its examples, tests and benchmark, too, and runs the tests.
set -eu
cd "$(dirname "$0")/../client_cpp"
packages="g++ cmake libboost-dev nlohmann-json3-dev libssl-dev"

missing=""
for program in c++ cmake; do
  command -v "$program" > /dev/null || missing="$missing $program"
done
if [ -z "$missing" ]; then
  for header in boost/beast/websocket.hpp nlohmann/json.hpp openssl/ssl.h; do
    echo "#include <$header>" | c++ -std=c++17 -E -x c++ - > /dev/null 2>&1 || missing="$missing $header"
  done
fi
if [ -n "$missing" ]; then
  echo "C++ client: not compiled, without$missing; sudo apt-get install --no-install-recommends $packages" >&2
  exit 3
fi
# With libopencv-dev, the example that drives through a recording is compiled as well.
cmake -S . -B build > build.log 2>&1 || { cat build.log >&2; exit 1; }
rm -f build.log
if [ "${1:-}" = all ]; then
  cmake --build build
  ctest --test-dir build --output-on-failure
else
  cmake --build build --target rse_pf_driver
fi
