#!/bin/sh
# Builds fleetmap._core into shared/fleetmap, as far as its sources changed: shared/core/build.sh VENV [sanitize]. VENV has cmake, ninja
# and nanobind. With `sanitize` it builds the core of `make sanitize`, into VENV/core-sanitize. Where no C++ compiler is
# installed it takes that of `ziglang` from the package index.
set -eu
core=$(cd "$(dirname "$0")" && pwd)
venv=$(cd "$1" && pwd)
build=$venv/core${2:+-$2}
export PATH="$venv/bin:$PATH"
# Configured anew where that was never done, and in a folder that was copied.
if ! grep -qs "^CMAKE_HOME_DIRECTORY:INTERNAL=$core\$" "$build/CMakeCache.txt" || ! [ -f "$build/build.ninja" ]; then
  rm -rf "$build"
  mkdir "$build"
  set -- ${2:+-DSANITIZE=ON} -DPython_EXECUTABLE="$venv/bin/python" -DWARNINGS_ARE_ERRORS=ON
  if ! [ "${CXX:-}" ] && ! command -v c++ >/dev/null && ! command -v g++ >/dev/null && ! command -v clang++ >/dev/null; then
    echo "fleetmap: no C++ compiler is installed (g++ on Debian and Ubuntu); taking that of ziglang from the package index, which needs" \
      "some minutes for its first build"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c "$core/../../constraints.txt" ziglang
    for tool in c++ ar ranlib; do
      printf '#!/bin/sh\nexec "%s" -m ziglang %s "$@"\n' "$venv/bin/python" "$tool" >"$build/zig-$tool"
      chmod +x "$build/zig-$tool"
    done
    set -- "$@" -DCMAKE_CXX_COMPILER="$build/zig-c++" -DCMAKE_AR="$build/zig-ar" -DCMAKE_RANLIB="$build/zig-ranlib"
    export CXX="$build/zig-c++"
  fi
  cmake -S "$core" -B "$build" -G Ninja "$@" >"$build/configured.log" 2>&1 || { cat "$build/configured.log" >&2; rm "$build/CMakeCache.txt"; exit 1; }
fi
cmake --build "$build" >"$build/built.log" 2>&1 || { cat "$build/built.log" >&2; exit 1; }
