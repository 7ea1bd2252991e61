#!/bin/sh
# Builds OpenCV's wheel without parts that fleetmap does not use (video codecs, LAPACK, IPP, OpenCL, windows), once per platform: about
# 20 minutes on one core. deploy/install.sh takes it from that folder, also on robots without a compiler. Keep the wheel: its source comes
# from the package index by version, its hash in the lock is that of your build.
#   apt-get install g++ make nasm python3-dev python3-venv
#   deploy/opencv.sh [FOLDER]      (default: dist/wheels)
set -eu
here=$(dirname "$0")
folder=${1:-$here/../dist/wheels}
for wheel in "$folder"/opencv_python_headless-*.whl; do
  [ ! -f "$wheel" ] || { echo "nothing to build: $wheel"; exit 0; }
done
for tool in g++ make nasm; do # without nasm the build succeeds, but decodes JPEG at half the speed
  command -v "$tool" > /dev/null || { echo "$tool is missing: apt-get install g++ make nasm python3-dev python3-venv" >&2; exit 2; }
done
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
"${PYTHON:-python3}" -m venv "$tools"
# Remaining parts: JPEG, PNG, TIFF and PNM images, and UVC cameras by Video4Linux.
export PIP_DISABLE_PIP_VERSION_CHECK=1 ENABLE_HEADLESS=1 CMAKE_ARGS="\
  -DBUILD_LIST=core,imgproc,imgcodecs,flann,features2d,calib3d,video,videoio,python3 \
  -DWITH_FFMPEG=OFF -DWITH_GSTREAMER=OFF -DWITH_LAPACK=OFF -DWITH_IPP=OFF -DWITH_ITT=OFF -DWITH_OPENCL=OFF -DWITH_PROTOBUF=OFF \
  -DWITH_WEBP=OFF -DWITH_OPENJPEG=OFF -DWITH_JASPER=OFF -DWITH_OPENEXR=OFF -DWITH_AVIF=OFF -DWITH_GTK=OFF -DWITH_QT=OFF \
  -DBUILD_ZLIB=ON -DBUILD_JPEG=ON -DBUILD_PNG=ON -DBUILD_TIFF=ON -DBUILD_TESTS=OFF -DBUILD_PERF_TESTS=OFF -DBUILD_opencv_apps=OFF"
"$tools/bin/python" -m pip wheel --no-cache-dir --no-deps --no-binary opencv-python-headless -c "$here/../constraints.txt" \
  --wheel-dir "$folder" opencv-python-headless
