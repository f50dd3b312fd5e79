#!/bin/bash
# A checkpoint laid out like a public one becomes, through the converter, the network that the library makes itself;
# broken ones are refused with a message that names the fault.
# usage: convert_checkpoint_test.sh SOURCE_DIRECTORY SVORT_CHECKPOINT VERSION CRC32
set -euo pipefail
source_directory=$1 svort_checkpoint=$2 version=$3 crc32=$4
python=/usr/bin/python3  # Debian's, which has torch
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

fail() {
  echo "FAILED: $*" >&2
  exit 1
}
# refused MESSAGE COMMAND...: the command must end with 2 and say MESSAGE
refused() {
  local message=$1 output status=0
  shift
  output=$("$@" 2>&1) || status=$?
  [[ $status == 2 ]] || fail "'$*' ended with $status: $output"
  [[ $output == *"$message"* ]] || fail "'$*' did not say '$message' but: $output"
}
convert=("$python" "$source_directory/scripts/convert_checkpoint.py")

"$svort_checkpoint" parameters "$version" >"$work/parameters.json"
"$python" "$source_directory/test/scripts/make_public_checkpoint.py" "$work/parameters.json" "$work/public.pt"
"${convert[@]}" "$work/public.pt" "$work/converted.pt"
"$svort_checkpoint" info "$work/converted.pt" | tee "$work/info"
grep -q "^network: $version$" "$work/info" || fail "not network $version"
grep -q "^crc32: $crc32$" "$work/info" || fail "other weights than the rule's ($crc32)"

head -c 100000 "$work/public.pt" >"$work/truncated.pt"
refused "truncated.pt: is truncated" "${convert[@]}" "$work/truncated.pt" "$work/out.pt"
refused "nothing.pt: cannot be read" "${convert[@]}" "$work/nothing.pt" "$work/out.pt"
refused "is a checkpoint of svort_ros already" "${convert[@]}" "$work/converted.pt" "$work/out.pt"
refused "truncated, or not a checkpoint of svort_ros" "$svort_checkpoint" info "$work/public.pt"
rm "$work/converted.pt"

"$python" - "$work" <<'PYTHON'
import collections
import sys

import torch

work = sys.argv[1]
model = torch.load(work + "/public.pt")["model"]
first = next(iter(model))


def write(name, entries):
    torch.save({"model": collections.OrderedDict(entries)}, work + "/" + name)


small = {name: value for name, value in model.items() if value.dim() == 1}
write("missing.pt", {name: value for name, value in model.items() if name != first})
write("strange.pt", {"encoder.weight": torch.zeros(3)})
write("text.pt", {**small, "note": "hello"})
write("nan.pt", {**small, "last": torch.full((2,), float("nan"))})


class Code:
    def __reduce__(self):
        return (open, (work + "/written", "w"))


torch.save({"model": Code()}, work + "/code.pt")
PYTHON
"${convert[@]}" "$work/missing.pt" "$work/out.pt"
refused "does not fit network $version: missing $(sed -n '1s/^\[\["\([^"]*\)".*/\1/p' "$work/parameters.json")" \
  "$svort_checkpoint" info "$work/out.pt"
refused "fit neither version 1 nor version 2" "${convert[@]}" "$work/strange.pt" "$work/out.pt"
refused "the entry 'note' of 'model' is not a tensor" "${convert[@]}" "$work/text.pt" "$work/out.pt"
refused "the parameter last holds NaN or infinity" "${convert[@]}" "$work/nan.pt" "$work/out.pt"
refused "it wants io.open" "${convert[@]}" "$work/code.pt" "$work/out.pt"
[[ ! -e $work/written ]] || fail "the file's code was run"
echo "convert_checkpoint: passed"
