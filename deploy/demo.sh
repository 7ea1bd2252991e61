#!/usr/bin/env bash
# The whole path on one recording: half of its frames become a map, the other half is localized in it.
#
#   deploy/demo.sh [--check] RECORDING      (run by `make demo`; --check looks at RECORDING and does nothing else)
#
# BIN: folder with mapserver and locclient (default .venv/bin). OUT: where everything is left (default out/demo).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

BIN=${BIN:-.venv/bin}
OUT=${OUT:-out/demo}
READY_WITHIN_S=60
server_pid=

say() { printf '\n== %s (%d s)\n' "$*" "$SECONDS"; }

fail() {
  printf 'demo: %s\n' "$*" >&2
  exit 1
}

check_recording() {
  if [[ -z ${1:-} ]]; then
    printf '%s\n' >&2 \
      "demo: which recording? make demo RECORDING=PATH" \
      "  PATH is a folder (EuRoC: the parent of mav0; TUM-VI, KITTI, 7-Scenes) or an .mcap file." \
      "  None at hand? Two commands simulate a warehouse and record a drive through it:" \
      "    make .venv/.installed-run" \
      "    .venv/bin/fleetsim record small-loop --out warehouse.mcap"
    exit 2
  fi
  if [[ ! -e $1 ]]; then
    printf 'demo: RECORDING=%s does not exist; pass a folder or an .mcap file\n' "$1" >&2
    exit 2
  fi
}

stop_server() {
  [[ -n $server_pid ]] || return 0
  local pid=$server_pid
  server_pid=
  kill -TERM "$pid" 2>/dev/null || true
  wait "$pid"
}

start_server() {
  "$BIN/mapserver" serve --store "$OUT/store" --http 127.0.0.1:0 --zenoh tcp/127.0.0.1:0 >"$OUT/server.log" 2>&1 &
  server_pid=$!
  local deadline=$((SECONDS + READY_WITHIN_S))
  until grep -qx ready "$OUT/server.log"; do
    kill -0 "$server_pid" 2>/dev/null || { cat "$OUT/server.log" >&2; fail "the server ended before it was ready"; }
    ((SECONDS < deadline)) || { cat "$OUT/server.log" >&2; fail "the server was not ready within $READY_WITHIN_S s"; }
    sleep 0.1
  done
  http=$(sed -n 's/^http: //p' "$OUT/server.log")
  zenoh=$(sed -n 's/^zenoh: //p' "$OUT/server.log")
}

if [[ ${1:-} == --check ]]; then
  check_recording "${2:-}"
  exit 0
fi
recording=${1:-}
check_recording "$recording"
trap 'stop_server || true' EXIT
trap 'exit 130' INT
trap 'exit 143' TERM
rm -rf "$OUT"
mkdir -p "$OUT"

say "building a map of every second frame of $recording"
truth=()
has_truth=$("$BIN/python" deploy/demo_report.py has-truth "$recording")
[[ $has_truth == no ]] || truth=(--frame-from-ground-truth)
"$BIN/mapserver" build "$recording" --site demo --store "$OUT/store" --frames 0::2 ${truth[@]+"${truth[@]}"} \
  --report "$OUT/build.json" --trajectory "$OUT/build.tum" --picture "$OUT/build.png"

say "publishing it"
"$BIN/mapserver" publish --site demo --store "$OUT/store"

say "serving it"
start_server
printf 'http %s, zenoh %s\n' "$http" "$zenoh"

say "a robot localizes the other frames in it"
"$BIN/locclient" replay "$recording" --server "$zenoh" --site demo --robot demo-robot --frames 1::2 --cache "$OUT/cache" \
  --report "$OUT/replay.json" --trajectory "$OUT/replay.tum" --picture "$OUT/replay.png"

say "what the server knows of the robot"
"$BIN/python" deploy/demo_report.py robots "$http/v1/robots"

say "the result"
"$BIN/python" deploy/demo_report.py table "$OUT/build.json" "$OUT/replay.json"

stop_server || fail "the server did not end cleanly; see $OUT/server.log"
printf '\nPictures, reports and trajectories are in %s; all of it took %d s.\n' "$OUT" "$SECONDS"
