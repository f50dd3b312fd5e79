#!/usr/bin/python3
"""Turns a public SVoRT checkpoint (version 1 or 2) into a file that svort_ros loads.

    convert_checkpoint.py PUBLIC.pt OUTPUT.pt [--half]

Only tensors, containers and plain values are unpickled: a file that wants anything else is refused before it can run
code. The version follows from the
parameters' names. Check the result, every name and shape included, with: svort_checkpoint info OUTPUT.pt
"""
import argparse
import collections
import hashlib
import os
import pickle
import sys
import zipfile

import torch

FORMAT, FORMAT_VERSION = "svort_ros checkpoint", 1
MARKS = {"v1": "svrnet.0.", "v2": "svrnet1."}  # how the parameters' names of a version begin


class ConversionError(Exception):
    pass


class WeightsUnpickler(pickle.Unpickler):
    """Reads the dictionary in a file of torch.save, and refuses every name but those that tensors need.

    torch.load of Debian's torch 1.13 does not do: with weights_only it refuses floats, which public checkpoints hold,
    and without, it ignores the pickle module that it is given.
    """

    STORAGES = {
        "DoubleStorage": torch.float64,
        "FloatStorage": torch.float32,
        "HalfStorage": torch.float16,
        "BFloat16Storage": torch.bfloat16,
        "LongStorage": torch.int64,
        "IntStorage": torch.int32,
        "ByteStorage": torch.uint8,
        "BoolStorage": torch.bool,
    }

    def __init__(self, archive, folder):
        super().__init__(archive.open(folder + "data.pkl"), encoding="utf-8")
        self.archive, self.folder, self.storages = archive, folder, {}

    def find_class(self, module, name):
        if module == "torch" and name in self.STORAGES:
            return self.STORAGES[name]
        allowed = {
            ("collections", "OrderedDict"): collections.OrderedDict,
            ("torch._utils", "_rebuild_tensor_v2"): self.rebuild_tensor,
            ("torch._utils", "_rebuild_parameter"): lambda data, *_: data,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"it wants {module}.{name}")
        return allowed[module, name]

    def persistent_load(self, pid):
        _, dtype, key, _, _ = pid
        if key not in self.storages:
            content = bytearray(self.archive.read(f"{self.folder}data/{key}"))
            self.storages[key] = torch.frombuffer(content, dtype=dtype) if content else torch.empty(0, dtype=dtype)
        return self.storages[key]

    @staticmethod
    def rebuild_tensor(storage, offset, size, stride, *_):
        return storage.as_strided(size, stride, offset)


def load_weights(path):
    with zipfile.ZipFile(path) as archive:
        pickles = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise pickle.UnpicklingError("it holds no data.pkl")
        return WeightsUnpickler(archive, pickles[0][: -len("data.pkl")]).load()


def read_public(path):
    """The parameters of a public training checkpoint: {"model": state_dict, ...}, or a state_dict itself."""
    try:
        content = load_weights(path)
    except OSError as error:
        raise ConversionError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:  # the unpickler raises many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConversionError(f"{path}: is truncated, or not a file of weights alone ({reason})") from error
    if isinstance(content, dict) and content.get("format") == FORMAT:
        raise ConversionError(f"{path}: is a checkpoint of svort_ros already")
    model = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(model, dict) or not model:
        raise ConversionError(f"{path}: holds no parameters (expected a dictionary with the key 'model')")
    for name, value in model.items():
        if not isinstance(name, str) or not isinstance(value, torch.Tensor):
            raise ConversionError(f"{path}: the entry {name!r} of 'model' is not a tensor")
        if not value.is_floating_point():
            raise ConversionError(f"{path}: the parameter {name} does not hold floating-point numbers")
        if not torch.isfinite(value).all():
            raise ConversionError(f"{path}: the parameter {name} holds NaN or infinity")
    return model


def version_of(model, path):
    found = [version for version, mark in MARKS.items() if any(name.startswith(mark) for name in model)]
    if len(found) != 1:
        raise ConversionError(f"{path}: its parameters' names fit neither version 1 nor version 2 of SVoRT "
                              f"(first: {next(iter(model))})")
    return found[0]


def parameter_sha256(parameters):
    """As in svort_ros/network/checkpoint.h."""
    digest = hashlib.sha256()
    for name in sorted(parameters):
        value = parameters[name]
        kind = str(value.dtype).replace("torch.", "") + " " + "x".join(str(size) for size in value.shape)
        digest.update(name.encode() + b"\0" + kind.encode() + b"\0")
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()


def convert(source, target, half):
    model = read_public(source)
    version = version_of(model, source)
    kind = torch.float16 if half else torch.float32
    # Copies: a tensor that is a view would take its whole storage into the file.
    parameters = {name: value.detach().to(kind).clone().contiguous() for name, value in model.items()}
    with open(source, "rb") as file:
        source_hash = hashlib.sha256(file.read()).hexdigest()
    content = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "network": version,
        "options": {},  # the network's defaults are the public checkpoints' options
        "parameters": parameters,
        "provenance": {
            "source": os.path.basename(source),
            "source_sha256": source_hash,
            "converted_by": "scripts/convert_checkpoint.py",
        },
        "sha256": parameter_sha256(parameters),
    }
    unfinished = target + ".part"
    try:
        torch.save(content, unfinished)
        os.replace(unfinished, target)
    except (OSError, RuntimeError) as error:
        raise ConversionError(f"{target}: cannot be written ({error})") from error
    return version, len(parameters)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="PUBLIC.pt")
    parser.add_argument("target", metavar="OUTPUT.pt")
    parser.add_argument("--half", action="store_true", help="store float16: half the size, about 3 digits")
    arguments = parser.parse_args()
    try:
        version, count = convert(arguments.source, arguments.target, arguments.half)
    except ConversionError as error:
        print(f"convert_checkpoint.py: {error}", file=sys.stderr)
        return 2
    print(f"{arguments.target}: SVoRT {version}, {count} parameters")
    return 0


if __name__ == "__main__":
    sys.exit(main())
