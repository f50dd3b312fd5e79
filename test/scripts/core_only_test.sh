#!/bin/bash
# Configures and builds the core without ROS, and uses its installation.
# usage: core_only_test.sh SOURCE_DIR BUILD_DIR
set -euo pipefail
source_dir=$1 build_dir=$2
# shellcheck source=../../scripts/common.sh
source "$source_dir/scripts/common.sh"

folder=$build_dir-core  # beside the other, so that ccache sees the same relative paths
unset CMAKE_PREFIX_PATH ROS_PACKAGE_PATH LD_LIBRARY_PATH PYTHONPATH
configure_and_build "$folder" "" -DCMAKE_BUILD_TYPE=Release -DSVORT_WITH_ROS=OFF -DSVORT_BUILD_TESTS=OFF
for library in "$folder"/libsvort_*.so; do
  # Direct dependencies only: Debian's LibTorch itself uses OpenCV.
  ! readelf -d "$library" | grep NEEDED | grep -E 'libros|libtf2|libopencv|libvtk|libyaml-cpp|libnifti' ||
    fail "$(basename "$library") needs more than LibTorch and Eigen"
done

say "Train from a pack of volumes"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
# A pack as anybody can write one with PyTorch: an ellipsoid with a bright core off its centre.
"$PYTHON" - "$work/pack.pt" <<'PYTHON'
import sys
import torch

def text(words):
    return torch.tensor(list(words.encode()), dtype=torch.uint8)

axis = torch.arange(24, dtype=torch.float32) * 4 - 46
z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
mask = (x / 32) ** 2 + (y / 40) ** 2 + (z / 30) ** 2 < 1
image = mask * (0.5 + 0.5 * ((x - 8) ** 2 + y**2 + z**2 < 200))
torch.save({"format": text("svort brain volumes 1"), "count": torch.tensor(1), "name_0": text("ellipsoid"),
            "image_0": image, "mask_0": mask, "resolution_mm_0": torch.tensor(4.0, dtype=torch.float64)}, sys.argv[1])
PYTHON
printf 'volumes: [%s]\nheld_out: [%s]\n' "$work/pack.pt" "$work/pack.pt" >"$work/training.yaml"
train() {
  "$folder/svort_train" --config "$work/training.yaml" --output "$work/run" --network.width 8 --network.dim 12 \
    --network.heads 2 --network.layers 1 --network.hidden 12 --trainer.scans_per_step 1 --trainer.log_steps 1 \
    --trainer.validation_scans 1 "$@"
}
train --trainer.total_steps 2
train --trainer.total_steps 3 --resume
[[ $(wc -l <"$work/run/training.csv") == 4 ]] || fail "training.csv has no row for each of three steps"
"$folder/svort_checkpoint" info "$work/run/weights.pt" | grep -q ellipsoid || fail "the weights do not name their volume"
train --resume --trainer.precision bfloat16 --trainer.device cpu 2>"$work/refused.txt" && fail "mixed precision ran on the CPU"
grep -q "mixed precision is for GPUs" "$work/refused.txt" || fail "mixed precision was refused without a reason"
sed -i 's/pack.pt/brain.nii.gz/' "$work/training.yaml"
train --resume 2>"$work/refused.txt" && fail "a NIfTI volume was read"
grep -q "reads packs of volumes" "$work/refused.txt" || fail "a NIfTI volume was refused without a reason"

bash test/scripts/install_test.sh "$source_dir" "$folder" core
