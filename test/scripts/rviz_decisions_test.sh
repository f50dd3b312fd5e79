#!/bin/bash
# Starts rviz with the view of decisions on the replayed scan and looks at the picture: slices coloured by quality,
# coverage, outlines of planned slices.
# usage: rviz_decisions_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
picture=$work/picture.png
scripts/render_readme_picture --view decisions --build "$build_dir" --output "$picture"

# at_least WHAT CONDITION PER_CENT: so many pixels must fulfil the condition on r, g, b (0 to 255).
at_least() {
  local share
  share=$(convert "$picture" -depth 8 -alpha off ppm:- | "$PYTHON" -c '
import sys
data = sys.stdin.buffer.read()
pixels = data[data.index(b"\n255\n") + 5:]
hits = sum(1 for r, g, b in zip(pixels[0::3], pixels[1::3], pixels[2::3]) if eval(sys.argv[1]))
print(f"{300 * hits / len(pixels):.3f}")' "$2")
  echo "$1: $share % of the pixels"
  awk -v value="$share" -v least="$3" 'BEGIN {exit !(value >= least)}' || fail "$1: only $share %, expected $3 %"
}
at_least "good slices (green)" 'g > 120 and r < 0.75 * g and b < 0.6 * g' 1
at_least "planned slices (magenta)" 'r > 150 and b > 130 and g < 0.7 * b' 0.1
at_least "anything at all" 'max(r, g, b) > 60' 3
