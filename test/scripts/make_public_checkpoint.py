#!/usr/bin/python3
"""Writes a file laid out like a public SVoRT training checkpoint, with the weights of deterministic_weights.h.

    make_public_checkpoint.py PARAMETERS.json OUTPUT.pt     (the JSON is what `svort_checkpoint parameters` prints)
"""
import json
import re
import sys
import zlib
from collections import OrderedDict

import numpy as np
import torch


def hashed(name, count):
    """Multiples of 2^-23 in [-1, 1)."""
    mask = np.uint64(0xFFFFFFFF)
    h = (np.arange(count, dtype=np.uint64) * np.uint64(2654435761) + np.uint64(zlib.crc32(name.encode()))) & mask
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B), (16, 1)):
        h = ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & mask
    return (h >> np.uint64(8)) / 2.0**23 - 1.0


def values(name, shape, shapes):
    if name.endswith(".w"):
        frequencies = 1e-3 ** (np.arange(shape[1]) / (shape[1] - 1.0))
        return np.broadcast_to(frequencies.reshape(1, -1, 1), shape)
    v = hashed(name, int(np.prod(shape))).reshape(shape)
    if name.endswith(".bias"):
        norm = len(shapes[name[:-4] + "weight"]) == 1
        return v * (0.1 if norm else 0.02)
    if len(shape) == 1:
        block = re.search(r"layer\d+\.\d+\.bn([23])\.weight$", name)
        last = block and (block.group(1) == "3" or name.replace("bn2.", "bn3.") not in shapes)
        return (1.0 + 0.1 * v) * (0.25 if last else 1.0)
    v = v * (np.sqrt(3.0) * np.sqrt((2.0 if len(shape) == 4 else 1.0) / np.prod(shape[1:])))
    return v * (6.0 if re.match(r"svrnet(\d+|\.\d+)\.fc\.weight$", name) else 1.0)


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        parameters = json.load(file)
    shapes = dict(map(tuple, [(name, tuple(shape)) for name, shape in parameters]))
    model = OrderedDict()
    for name, shape in shapes.items():
        model[name] = torch.from_numpy(np.array(values(name, shape, shapes), dtype=np.float32))
    torch.save({"model": model, "iter": 0, "loss": {"alpha": 0.999, "value": {}}}, sys.argv[2])


if __name__ == "__main__":
    main()
