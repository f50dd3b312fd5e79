#!/bin/bash
# Starts rviz with the shipped view on the replayed scan and looks at the picture: it must show a brain, axes, a slice.
# usage: rviz_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
picture=$work/picture.png
scripts/render_readme_picture --build "$build_dir" --output "$picture"

# count CROP CONDITION: per cent of the pixels of which the condition on r, g, b (0 to 255) is true.
count() {
  convert "$picture" -gravity center -crop "$1" +repage -depth 8 -alpha off ppm:- |
    "$PYTHON" -c '
import sys
data = sys.stdin.buffer.read()
pixels = data[data.index(b"\n255\n") + 5:]
hits = sum(1 for r, g, b in zip(pixels[0::3], pixels[1::3], pixels[2::3]) if eval(sys.argv[1]))
print(f"{300 * hits / len(pixels):.3f}")' "$2"
}
at_least() {
  echo "$1: $2 % of the pixels"
  awk -v value="$2" -v least="$3" 'BEGIN {exit !(value >= least)}' || fail "$1: only $2 % of the pixels, expected $3 %"
}

# The middle, where the view looks at the origin of the brain frame; the background is dark blue (20, 24, 34).
at_least "brain surface or slice in the middle" "$(count 30%x40%+0+0 'min(r, g, b) > 45')" 50
at_least "blue axis" "$(count 100%x100%+0+0 'b > 120 and r < 80 and g < 80')" 0.01
at_least "red axis" "$(count 100%x100%+0+0 'r > 120 and g < 80 and b < 80')" 0.01
at_least "orange frame of the current slice" "$(count 100%x100%+0+0 'r > 200 and 120 < g < 220 and b < 90')" 0.02
colours=$(convert "$picture" -gravity center -crop 30%x40%+0+0 +repage -format %k info:)
echo "colours in the middle: $colours"
((colours > 300)) || fail "the picture has only $colours colours in its middle: nothing is shaded"
