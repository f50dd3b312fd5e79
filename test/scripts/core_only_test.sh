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
bash test/scripts/install_test.sh "$source_dir" "$folder" core
