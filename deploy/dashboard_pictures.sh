#!/usr/bin/env bash
# Screenshots of pages of a running console: OUT/dashboard-PAGE.png.
#
#   deploy/dashboard_pictures.sh HTTP OUT SITE PAGE...
#
# HTTP: address of the server. PAGE: overview, map, failures, failures/1, ... Without Chromium or Chrome it prints a note and exits with status 0.
set -euo pipefail
http=$1 out=$2 site=$3
shift 3
WITHIN_S=30

browser=
for name in chromium chromium-browser google-chrome; do
  if browser=$(command -v "$name"); then break; fi
done
if [[ -z $browser ]]; then
  printf 'No picture of the dashboard was taken: chromium is not installed. See it with: mapserver serve --store %s/store\n' "$out"
  exit 0
fi

profile=$(mktemp -d)
trap 'rm -rf "$profile"' EXIT
options=(--headless=new --hide-scrollbars --window-size=1440,900 --user-data-dir="$profile" --timeout=4000)
# The browser's sandbox is not available to root; it opens only the server of this demo.
((EUID != 0)) || options+=(--no-sandbox)
for page in "$@"; do
  path=$page
  [[ $page != overview ]] || path=
  picture=$out/dashboard-${page//\//-}.png
  if timeout "$WITHIN_S" "$browser" "${options[@]}" --screenshot="$picture" "$http/dashboard/$path?site=$site" >"$profile/log" 2>&1 \
    && [[ -s $picture ]]; then
    printf 'picture of the dashboard: %s\n' "$picture"
  else
    printf 'No picture of the page %s was taken: %s\n' "$page" "$(tail -n 1 "$profile/log")"
  fi
done
