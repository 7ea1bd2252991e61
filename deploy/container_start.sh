#!/bin/sh
# Entry point of the images: the image's kernels are copied to where numba may write, once for each image; then the command runs.
set -eu
umask 0077
packed=/opt/fleetmap/kernels
image=$(cat "$packed"/prepared-*.json | sha256sum)
if [ "$(cat "$NUMBA_CACHE_DIR/image" 2>/dev/null || true)" != "$image" ]; then
  mkdir -p "$NUMBA_CACHE_DIR"
  find "$NUMBA_CACHE_DIR" -name '*.nb[ci]' -delete
  cp -R "$packed/." "$NUMBA_CACHE_DIR/"
  echo "$image" > "$NUMBA_CACHE_DIR/image"
fi
exec "$@"
