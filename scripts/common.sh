# shellcheck shell=bash
# Shared by the scripts of this folder. Source it; it changes to the root of the project.

set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)"
cd "$ROOT"

# catkin's code generators need Debian's interpreter; another python3 earlier on PATH lacks their modules. ROS's own
# Python programs start with "env python3", so the order on PATH matters to them as well.
PYTHON=/usr/bin/python3
export PATH="/usr/bin:$PATH"

# Copies of the project in other folders share what ccache has compiled.
export CCACHE_BASEDIR="$ROOT"

say() { printf '== %s\n' "$*"; }
fail() {
  printf 'error: %s\n' "$*" >&2
  exit 1
}

# A compiler process of LibTorch code takes up to 2 GiB.
build_jobs() {
  local cores memory_kib jobs
  cores=$(nproc)
  memory_kib=$(awk '/^MemAvailable:/ {print $2}' /proc/meminfo)
  jobs=$((memory_kib / 2097152))
  ((jobs >= 1)) || jobs=1
  ((jobs <= cores)) || jobs=$cores
  echo "$jobs"
}

# configure_and_build FOLDER "TARGETS" [CMAKE_ARGUMENT...]; no targets means all.
configure_and_build() {
  local folder=$1 targets
  read -r -a targets <<<"$2"
  shift 2
  mkdir -p "$folder"
  say "Configure $folder"
  cmake -S . -B "$folder" -G Ninja -DPYTHON_EXECUTABLE=$PYTHON -DPython3_EXECUTABLE=$PYTHON \
    -DCMAKE_INSTALL_PREFIX="$ROOT/install" "$@" >"$folder.log" 2>&1 || {
    cat "$folder.log" >&2
    fail "cmake failed; its output is above and in $folder.log"
  }
  mv "$folder.log" "$folder/configure.log"
  say "Build $folder with $(build_jobs) jobs"
  ninja -C "$folder" -j "$(build_jobs)" "${targets[@]}" || fail "the build in $folder failed; the compiler's messages are above"
}

free_port() {
  "$PYTHON" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

# use_private_ros FOLDER: ROS talks to this machine only, on a port of its own, and writes its logs into FOLDER.
use_private_ros() {
  mkdir -p "$1"
  unset ROS_HOSTNAME ROS_NAMESPACE
  export ROS_IP=127.0.0.1
  ROS_MASTER_URI="http://127.0.0.1:$(free_port)"
  ROS_HOME="$(cd "$1" && pwd -P)"
  export ROS_MASTER_URI ROS_HOME ROS_LOG_DIR="$ROS_HOME/log"
  # A line appears when it is said, also where it is not written to a terminal.
  export ROSCONSOLE_STDOUT_LINE_BUFFERED=1
}

# start SIGNAL COMMAND...: runs it in the background; stop_all ends it with that signal, the newest process first.
# Programs of roscpp and roslaunch end cleanly on INT; rviz leaves INT alone, which is off in background processes.
started=()
start() {
  local signal=$1
  shift
  "$@" &
  started+=("$signal $!")
}
stop() {
  local i
  kill "-$1" "$2" 2>/dev/null || return 0
  for ((i = 0; i < 100; ++i)); do
    kill -0 "$2" 2>/dev/null || return 0
    sleep 0.1
  done
  kill -KILL "$2" 2>/dev/null || true
}
stop_all() {
  local i signal pid
  for ((i = ${#started[@]} - 1; i >= 0; --i)); do
    read -r signal pid <<<"${started[i]}"
    stop "$signal" "$pid"
  done
  started=()
}

# start_master: a ROS master at ROS_MASTER_URI; returns when it answers.
start_master() {
  local i
  mkdir -p "$ROS_LOG_DIR"
  start INT roscore -p "${ROS_MASTER_URI##*:}" >"$ROS_LOG_DIR/roscore.txt" 2>&1
  for ((i = 0; i < 150; ++i)); do
    if rosparam get /run_id >/dev/null 2>&1; then return 0; fi
    kill -0 "${started[-1]#* }" 2>/dev/null || break
    sleep 0.2
  done
  cat "$ROS_LOG_DIR/roscore.txt" >&2
  fail "roscore did not start at $ROS_MASTER_URI; its output is above"
}

# plain_output: without the colours of rosconsole.
plain_output() { sed -u 's/\x1b\[[0-9;]*m//g'; }

# play PROGRAMS_DIR NODE_PID FACTOR STACK... MASK...: sends the stacks, the player being the scanner, while the node
# lives. More parameters of the player can be set with rosparam before.
play() {
  local programs=$1 node=$2 factor=$3 half player
  shift 3
  half=$(($# / 2))
  rosparam set /stack_player/stacks "[$(join "${@:1:half}")]"
  rosparam set /stack_player/masks "[$(join "${@:half+1}")]"
  start INT "$programs/stack_player_node" __name:=stack_player "_realtime:=$factor"
  player=${started[-1]#* }
  while kill -0 "$player" 2>/dev/null; do
    kill -0 "$node" 2>/dev/null || return 1
    sleep 0.2
  done
  wait "$player"
}
join() { local IFS=,; echo "$*"; }

# source_setup FILE: catkin's setup files use unset variables.
source_setup() {
  [[ -f $1 ]] || fail "$1 is missing: build first"
  set +u
  # shellcheck disable=SC1090
  source "$1"
  set -u
}
