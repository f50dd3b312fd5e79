#!/bin/bash
# Builds the package the way ROS 1 users do: as a member of a workspace, with catkin_make.
# usage: catkin_make_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

# Beside the other build and with the same relative paths, so that ccache knows the objects. The link to the package
# inside the package is a loop for programs that follow links: it must not stay.
catkin_build=$build_dir-catkin
workspace=$catkin_build/workspace
rm -rf "$catkin_build"
mkdir -p "$workspace/src"
trap 'rm -f "$workspace/src/svort_ros"' EXIT
ln -s "$source_dir" "$workspace/src/svort_ros"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH LD_LIBRARY_PATH PYTHONPATH
catkin_make -C "$workspace" --build "$catkin_build" --use-ninja -j "$(build_jobs)" -DSVORT_BUILD_TESTS=OFF \
  -DCATKIN_DEVEL_PREFIX="$catkin_build/devel" -DPYTHON_EXECUTABLE=$PYTHON -DPython3_EXECUTABLE=$PYTHON

source_setup "$catkin_build/devel/setup.bash"
[[ "$(readlink -f "$(rospack find svort_ros)")" == "$(readlink -f "$source_dir")" ]] ||
  fail "rospack finds $(rospack find svort_ros)"
# Read to its end: grep -q would leave, and a program that writes to a closed pipe fails.
help=$("$catkin_build/devel/lib/svort_ros/svort_replay" --help)
grep -q -- --output <<<"$help" ||
  fail "svort_replay --help does not mention --output"
