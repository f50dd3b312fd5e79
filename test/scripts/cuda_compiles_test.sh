#!/usr/bin/env bash
# Compiles all CUDA kernels with nvcc, of CUDACXX, PATH or /usr/local/cuda. Skipped where there is none.
#   cuda_compiles_test.sh SOURCE_DIR
set -euo pipefail
source_dir=$1

for candidate in "${CUDACXX:-}" "$(command -v nvcc || true)" /usr/local/cuda/bin/nvcc; do
  if [[ -n "$candidate" && -x "$candidate" ]]; then
    nvcc=$candidate
    break
  fi
done
if [[ -z "${nvcc:-}" ]]; then
  echo "skipped: no nvcc in CUDACXX, PATH or /usr/local/cuda/bin"
  exit 77
fi

out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
shopt -s globstar nullglob
kernels=("$source_dir"/src/**/*.cu)
if [[ ${#kernels[@]} -eq 0 ]]; then
  echo "no .cu file below $source_dir/src"
  exit 1
fi
"$nvcc" --version | tail -n 2
for kernel in "${kernels[@]}"; do
  echo "compiling ${kernel#"$source_dir"/}"
  "$nvcc" -std=c++17 -O2 -fmad=false -Werror all-warnings -Xcompiler -Wall,-Wextra,-fPIC \
    -c "$kernel" -o "$out/$(basename "$kernel").o"
done
