#!/bin/bash
# Builds the package the way ROS 1 users do: as a member of a workspace, with catkin_make.
# usage: catkin_make_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

# The workspace lies elsewhere: a link to the package inside the package would be a loop for programs that follow links.
# The build folder lies beside the other one, so that ccache sees the same relative paths and knows the objects.
workspace="$(mktemp -d)"
trap 'rm -rf "$workspace"' EXIT
catkin_build=$build_dir-catkin
rm -rf "$catkin_build"
mkdir -p "$workspace/src"
ln -s "$source_dir" "$workspace/src/svort_ros"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH LD_LIBRARY_PATH PYTHONPATH
catkin_make -C "$workspace" --build "$catkin_build" --use-ninja -j "$(build_jobs)" -DSVORT_BUILD_TESTS=OFF \
  -DCATKIN_DEVEL_PREFIX="$catkin_build/devel" -DPYTHON_EXECUTABLE=$PYTHON -DPython3_EXECUTABLE=$PYTHON

source_setup "$catkin_build/devel/setup.bash"
[[ "$(readlink -f "$(rospack find svort_ros)")" == "$(readlink -f "$source_dir")" ]] ||
  fail "rospack finds $(rospack find svort_ros)"
rosrun svort_ros svort_replay --help | grep -q -- --output || fail "svort_replay --help does not mention --output"
