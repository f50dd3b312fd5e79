#!/bin/bash
# Starts rviz with the shipped view on the replayed scan and looks at the picture: it must show a brain.
# usage: rviz_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
picture=$work/picture.png
scripts/render_readme_picture --build "$build_dir" --output "$picture"

# The middle of the window, where the view looks at the origin of the brain frame.
convert "$picture" -gravity center -crop 40%x50%+0+0 +repage "$work/middle.png"
colours=$(identify -format %k "$work/middle.png")
# Background is the dark colour of the view; what is lighter than it belongs to brain, slice or axes.
lit=$(convert "$work/middle.png" -colorspace Gray -threshold 20% -format '%[fx:100*mean]' info:)
# Axes and slice outline are the only saturated things: red, green and blue lines, orange frame.
saturated=$(convert "$work/middle.png" -colorspace HSL -channel G -separate -threshold 80% -format '%[fx:10000*mean]' info:)
printf 'middle of the picture: %s colours, %s %% lit, %s of 10000 pixels saturated\n' "$colours" "$lit" "$saturated"
((colours > 500)) || fail "the picture has only $colours colours in its middle: no shaded surface"
awk -v v="$lit" 'BEGIN {exit !(v > 15)}' || fail "only $lit % of the picture's middle is lit: no brain"
awk -v v="$saturated" 'BEGIN {exit !(v > 2)}' || fail "the picture shows neither axes nor slice"
