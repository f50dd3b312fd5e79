#!/bin/bash
# Installs the build into an empty prefix, hides the build from it, and uses what was installed.
# usage: install_test.sh SOURCE_DIR BUILD_DIR ros|core
set -euo pipefail
source_dir=$1 build_dir=$2 variant=$3
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

work="$(mktemp -d)"
trap 'stop_all; rm -rf "$work"' EXIT
# catkin fixes the prefix when it configures; DESTDIR puts a folder of our own before it.
prefix=$work$(sed -n 's/^CMAKE_INSTALL_PREFIX:PATH=//p' "$build_dir/CMakeCache.txt")
DESTDIR=$work cmake --install "$build_dir" >"$work/install.log" || {
  cat "$work/install.log"
  fail "cmake --install failed"
}
# Nothing may come from the build folder's environment.
unset LD_LIBRARY_PATH CMAKE_PREFIX_PATH ROS_PACKAGE_PATH PYTHONPATH PKG_CONFIG_PATH

say "Headers"
folders=(geometry acquisition reconstruction sequence live)
[[ $variant == core ]] || folders+=(io ros)
for folder in "${folders[@]}"; do
  for header in "$source_dir/include/svort_ros/$folder"/*.h; do
    cmp "$header" "$prefix/include/svort_ros/$folder/$(basename "$header")"
  done
done
if [[ $variant == core ]]; then
  [[ ! -e $prefix/include/svort_ros/ros ]] || fail "the core's installation holds headers of the ROS layer"
fi

say "A project that uses the installed core"
build_consumer() {
  cmake -S "$source_dir/test/scripts/consumer" -B "$work/consumer" -G Ninja -DCMAKE_PREFIX_PATH="$prefix" \
    -DCMAKE_CXX_COMPILER_LAUNCHER="$(command -v ccache || true)" || return 1
  ninja -C "$work/consumer"
}
build_consumer >"$work/consumer.log" 2>&1 || {
  cat "$work/consumer.log"
  fail "the project does not build"
}
answer="$("$work/consumer/consumer")"
[[ $answer == "accepted, head at z = 12.0 mm" ]] || fail "the project printed '$answer'"

if [[ $variant == core ]]; then exit 0; fi

say "Files that ROS looks for"
for file in package.xml nodelet_plugins.xml LICENSE config/svort.rviz data/real/README.md data/real/LICENSE; do
  cmp "$source_dir/$file" "$prefix/share/svort_ros/$file"
done
for file in "$source_dir"/launch/* "$source_dir"/config/*.yaml "$source_dir"/data/real/*.nii.gz; do
  [[ -e $file ]] || continue
  cmp "$file" "$prefix/share/svort_ros/${file#"$source_dir"/}"
done
for message in Slice SliceStatus SlicePose SequenceEstimate Volume; do
  [[ -s $prefix/include/svort_ros/$message.h ]] || fail "the installation lacks svort_ros/$message.h"
done

source_setup "$prefix/setup.bash"
[[ "$(rospack find svort_ros)" == "$prefix/share/svort_ros" ]] || fail "rospack finds $(rospack find svort_ros)"
"$PYTHON" -c 'from svort_ros.msg import Slice, SequenceEstimate, SliceStatus, Volume'

say "Programs"
for program in svort_node stack_player_node nifti_to_bag svort_replay; do
  file=$prefix/lib/svort_ros/$program
  [[ -x $file ]] || fail "the installation lacks $program"
  ! ldd "$file" | grep -F -e 'not found' -e "$build_dir" || fail "$program does not use the installed libraries"
done
rosrun svort_ros svort_replay --help >"$work/help.txt"
grep -q -- --output "$work/help.txt" || fail "svort_replay --help does not mention --output"
rosrun svort_ros svort_replay --stacks "$prefix/share/svort_ros/data/real/sub-01_run-1_T2w.nii.gz" \
  --masks "$prefix/share/svort_ros/data/real/sub-01_run-1_T2w_desc-brain_mask.nii.gz" \
  --output "$work/replay" >"$work/replay.log" 2>&1 || {
  cat "$work/replay.log"
  fail "the installed svort_replay failed"
}
[[ -s $work/replay/volume.nii.gz ]] || fail "svort_replay wrote no volume"

say "Nodelet"
use_private_ros "$work/ros"
start_master
start INT rosrun nodelet nodelet standalone svort_ros/SvortNodelet __name:=svort >"$work/nodelet.log" 2>&1
for ((i = 0; i < 100; ++i)); do
  if rosservice type /svort/save >/dev/null 2>&1; then
    echo "The nodelet is up"
    exit 0
  fi
  sleep 0.2
done
cat "$work/nodelet.log"
fail "the installed nodelet offers no service /svort/save within 20 s"
