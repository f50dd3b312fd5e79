#!/bin/bash
# Builds the package the way ROS 1 users do: as a member of a workspace, with catkin_make.
# usage: catkin_make_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

workspace=$build_dir/catkin_ws
mkdir -p "$workspace/src"
ln -sfn "$source_dir" "$workspace/src/svort_ros"
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH LD_LIBRARY_PATH PYTHONPATH
catkin_make -C "$workspace" --use-ninja -j "$(build_jobs)" -DSVORT_BUILD_TESTS=OFF \
  -DPYTHON_EXECUTABLE=$PYTHON -DPython3_EXECUTABLE=$PYTHON

source_setup "$workspace/devel/setup.bash"
[[ "$(readlink -f "$(rospack find svort_ros)")" == "$(readlink -f "$source_dir")" ]] ||
  fail "rospack finds $(rospack find svort_ros)"
rosrun svort_ros svort_replay --help | grep -q -- --output || fail "svort_replay --help does not mention --output"
