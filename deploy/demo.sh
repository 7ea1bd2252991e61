#!/usr/bin/env bash
# The whole workflow, with the console up from the beginning. Without a recording: a simulated warehouse is surveyed and mapped, and two
# robots of the next day, after stock has moved, drive in it, and a third is carried away: their daemons (`locclient run`) play the
# recordings in real time as sensors, and replays of the same recordings give the figures. With one: half of its frames become the map,
# the other half is localized in it.
#
#   deploy/demo.sh [--check] [RECORDING]      (run by `make demo`; --check only checks RECORDING)
#
# BIN: folder with the commands (default .venv/bin). OUT: output folder (default out/demo). SEED: of the warehouse.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

BIN=${BIN:-.venv/bin}
OUT=${OUT:-out/demo}
SEED=${SEED:-1}
ROBOTS=(tote-1 tote-2)
ROBOT_FRAMES=180  # 12 s of driving
READY_WITHIN_S=60
server_pid=
robots_pid=
drive_pids=()
replay_pids=()
publish_options=()

say() { printf '\n== %s (%d s)\n' "$*" "$SECONDS"; }

fail() {
  printf 'demo: %s\n' "$*" >&2
  exit 1
}

check_recording() {
  if [[ -n ${1:-} && ! -e $1 ]]; then
    printf 'demo: RECORDING=%s does not exist; pass a folder (EuRoC: the parent of mav0; TUM-VI, KITTI, 7-Scenes) or an .mcap file\n' "$1" >&2
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
  "$BIN/mapserver" serve --create --store "$OUT/store" --inbox "$OUT/inbox" --http 127.0.0.1:0 --zenoh tcp/127.0.0.1:0 >"$OUT/server.log" 2>&1 &
  server_pid=$!
  local deadline=$((SECONDS + READY_WITHIN_S))
  until grep -qx ready "$OUT/server.log"; do
    kill -0 "$server_pid" 2>/dev/null || { cat "$OUT/server.log" >&2; fail "the server ended before it was ready"; }
    ((SECONDS < deadline)) || { cat "$OUT/server.log" >&2; fail "the server was not ready within $READY_WITHIN_S s"; }
    sleep 0.1
  done
  http=$(sed -n 's/^http: //p' "$OUT/server.log")
  zenoh=$(sed -n 's/^zenoh: //p' "$OUT/server.log")
  printf '\nThe console, to watch all of it: %s/dashboard/?site=demo\n' "$http"
  if [[ -t 1 && -n ${DISPLAY:-}${WAYLAND_DISPLAY:-} ]] && command -v xdg-open >/dev/null; then
    xdg-open "$http/dashboard/?site=demo" >/dev/null 2>&1 || true
  fi
}

if [[ ${1:-} == --check ]]; then
  check_recording "${2:-}"
  exit 0
fi
recording=${1:-}
check_recording "$recording"
trap 'stop_server || true; kill $robots_pid ${drive_pids[@]+"${drive_pids[@]}"} \
  ${replay_pids[@]+"${replay_pids[@]}"} 2>/dev/null || true' EXIT
trap 'exit 130' INT
trap 'exit 143' TERM
rm -rf "$OUT"
mkdir -p "$OUT"

build() {
  "$BIN/mapserver" build "$@" --site demo --store "$OUT/store" --report "$OUT/build.json" --trajectory-out "$OUT/build.tum" \
    --picture "$OUT/build.png"
  say "publishing it"
  "$BIN/mapserver" publish --site demo --store "$OUT/store" ${publish_options[@]+"${publish_options[@]}"}
}

# A person at a terminal looks at the console; everybody else gets pictures.
is_watched() { [[ -t 0 && -t 1 ]]; }
pictures() { deploy/dashboard_pictures.sh "$http" "$OUT" demo "$@"; }

# Runs a robot's daemon on a recording instead of sensors; speed: 1 in real time, 0 as fast as possible.
drive() {
  local robot=$1 recording=$2 speed=$3
  printf '[run]\nserver = "%s"\nsite = "demo"\nrobot = "%s"\ncache = "%s"\noutbox = "%s"\nreplays = "full"\n[source]\nkind = "recording"\n' \
    "$zenoh" "$robot" "$OUT/cache-$robot" "$OUT/spool-$robot.sqlite3" >"$OUT/$robot.toml"
  printf 'recording = "%s"\nspeed = %s.0\n' "$recording" "$speed" >>"$OUT/$robot.toml"
  "$BIN/locclient" run --config "$OUT/$robot.toml" --verbose >"$OUT/$robot-run.log" 2>&1 &
  drive_pids+=("$!")
}

# Checks that all daemons have ended with success, and that no thread of theirs or of the server failed.
drives_ended() {
  local number log
  for number in "${!drive_pids[@]}"; do
    wait "${drive_pids[$number]}" || { cat "$OUT"/*-run.log >&2; fail "a robot's daemon ended with status $?"; }
  done
  for log in "$OUT"/*-run.log "$OUT/server.log"; do
    ! grep -q Traceback "$log" || { cat "$log" >&2; fail "something failed while it ran: see $log"; }
  done
  say "robots known to the server"
  "$BIN/python" deploy/demo_report.py robots "$http/v1/robots"
}

# Figures against ground truth, from the store's folder, as only the daemon reports to the server. Status 6: never localized; see the table.
replay() {
  local robot=$1 status=0
  shift
  nice "$BIN/locclient" replay "$@" --store "$OUT/store" --site demo --robot "$robot" \
    --report "$OUT/$robot.json" --trajectory "$OUT/$robot.tum" --picture "$OUT/$robot.png" || status=$?
  ((status == 0 || status == 6))
}

record() {
  local scenario=$1 robot=$2 day=$3
  shift 3
  "$BIN/fleetsim" record "$scenario" --out "$OUT/$robot.mcap" --seed "$SEED" --day "$day" --robot "$robot" "$@"
}

half_of() {
  local truth=()
  say "building a map of every second frame of $1"
  # It may be too short or too straight to verify its own calibration, which is then used as it is; the build lists unverified parts.
  publish_options=(--trust-calibration --reason "a demo of one recording")
  [[ $("$BIN/python" deploy/demo_report.py has-truth "$1") == no ]] || truth=(--frame-from-ground-truth)
  build "$1" --frames 0::2 ${truth[@]+"${truth[@]}"}
  say "a robot localizes the other frames in it"
  drive demo-robot "$1" 0
  replay demo-robot "$1" --frames 1::2
  drives_ended
  is_watched || pictures overview map
  reports=("$OUT/demo-robot.json")
}

warehouse() {
  local robot number
  # The simulator draws the next day's recordings with what survey and build leave idle; no robot has them before the map is there.
  (
    renice -n 5 "$BASHPID"
    record clip carried 1 && for robot in "${ROBOTS[@]}"; do record small-loop "$robot" 1 --frames "$ROBOT_FRAMES"; done
  ) >"$OUT/robots.log" 2>&1 &
  robots_pid=$!
  say "a survey robot drives through a simulated warehouse"
  record small-loop survey 0
  say "building a map of the survey; meanwhile it is the next day and two robots drive, stock has moved"
  build "$OUT/survey.mcap" --frame-from-ground-truth
  say "the robots come home with their recordings"
  wait "$robots_pid" || { cat "$OUT/robots.log" >&2; fail "recording the robots failed"; }
  say "${ROBOTS[*]} drive in yesterday's map, in real time, and one is carried away; meanwhile the recordings are replayed for the figures"
  reports=()
  for robot in "${ROBOTS[@]}"; do
    drive "$robot" "$OUT/$robot.mcap" 1
  done
  drive carried "$OUT/carried.mcap" 0  # a busy computer drops frames of a drive in real time, and may miss the lift
  for robot in "${ROBOTS[@]}"; do
    replay "$robot" "$OUT/$robot.mcap" >"$OUT/$robot.log" 2>&1 &
    replay_pids+=("$!")
    reports+=("$OUT/$robot.json")
  done
  if ! is_watched; then
    "$BIN/python" deploy/demo_report.py driving "$http/v1/robots"
    pictures overview map
  fi
  drives_ended
  is_watched || pictures failures failures/1  # the daemons ended after its recording had arrived
  for number in "${!ROBOTS[@]}"; do
    robot=${ROBOTS[$number]}
    wait "${replay_pids[$number]}" || { cat "$OUT/$robot.log" >&2; fail "$robot could not be localized"; }
    cat "$OUT/$robot.log"
  done
}

start_server
if [[ -n $recording ]]; then half_of "$recording"; else warehouse; fi

say "the result"
"$BIN/python" deploy/demo_report.py table "$OUT/build.json" "${reports[@]}"

if is_watched; then
  printf '\nAll of it took %d s. The console is at %s/dashboard/?site=demo until you press Enter. ' "$SECONDS" "$http"
  read -r || true
fi
stop_server || fail "the server did not end cleanly; see $OUT/server.log"
printf '\nPictures, reports and trajectories are in %s; all of it took %d s.\n' "$OUT" "$SECONDS"
