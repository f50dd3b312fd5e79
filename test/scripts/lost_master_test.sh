#!/bin/bash
# Kills the ROS master in the middle of a stack: the node must answer every slice, and write the scan when it ends.
# usage: lost_master_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

source_setup "$build_dir/devel/setup.bash"
programs=$build_dir/devel/lib/svort_ros
work="$(mktemp -d)"
trap 'stop_all; rm -rf "$work"' EXIT
use_private_ros "$work/ros"
start_master
read -r _ master <<<"${started[0]}"

start INT "$programs/svort_node" "_node/output_directory:=$work/out" >"$work/node.txt" 2>&1
read -r _ node <<<"${started[-1]}"
# Four times the pace of the scanner leaves seconds to interrupt.
start INT "$programs/stack_player_node" "_stacks:=[data/real/sub-01_run-1_T2w.nii.gz]" \
  "_masks:=[data/real/sub-01_run-1_T2w_desc-brain_mask.nii.gz]" _scan_id:=lost _realtime:=4 >"$work/player.txt" 2>&1
read -r _ player <<<"${started[-1]}"

answered() { grep -cE '^.*\[ *[0-9]+/ *22\]' "$work/node.txt" || true; }
wait_for() { # SECONDS COMMAND...
  local i seconds=$1
  shift
  for ((i = 0; i < seconds * 10; ++i)); do
    if "$@"; then return 0; fi
    sleep 0.1
  done
  cat "$work/node.txt" "$work/player.txt" >&2
  fail "timed out: $*"
}
some() { (($(answered) >= 6)); }
all() { (($(answered) == 22)); }
wait_for 60 some
before=$(answered)
pkill -KILL -P "$master" || true # rosmaster and rosout are its children
kill -KILL "$master"
((before < 22)) || fail "the master was killed too late: the stack was through"
echo "master killed after $before of 22 slices"
wait_for 60 all

stop INT "$player"
stop INT "$node"
rows=$(($(wc -l <"$work/out/lost/updates.csv") - 1))
poses=$(($(wc -l <"$work/out/lost/poses.csv") - 1))
echo "written: $rows arrivals, $poses poses"
((rows == 22 && poses == 16)) || fail "expected 22 arrivals and 16 poses"
