"""Small files of teams alone, checked byte by byte: the best tested ones, and those begun with.

A safetensors file whose header holds what is told of it, sealed together with a digest of the
arrays; nothing in it is ever run.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from race.errors import CheckpointError
from race.runs.sealed import parse_object, seal, unseal

SUFFIX = ".safetensors"
_KEY, _FORMAT = "race", "race-teams-1"


def write(path: Path, arrays: Mapping[str, NDArray[Any]], info: Mapping[str, Any]) -> None:
    """Writes a whole file or none; one that is there is replaced.

    Args:
        path: the file; its folder is made if missing.
        arrays: from `race.runs.trees.flatten`.
        info: anything that JSON can hold.

    Raises:
        CheckpointError: if it cannot be written.
    """
    held = {name: np.array(array, order="C") for name, array in arrays.items()}
    body = seal({**info, "format": _FORMAT, "arrays": _digest(held)})
    temporary = path.with_name(f".tmp-{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(held, temporary, metadata={_KEY: json.dumps(body)})
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.rename(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"{path} cannot be written: {error}. See that the disk is not full."
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def info_of(path: Path) -> dict[str, Any]:
    """What is told of a file, without reading its arrays.

    Raises:
        CheckpointError: if it is damaged, or none of race.
    """
    try:
        with safe_open(path, "numpy") as file:
            told = (file.metadata() or {})[_KEY]
        body, sealed = unseal(parse_object(told))
        if not sealed or body.get("format") != _FORMAT:
            raise ValueError("it is of another format")
        return body
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise _damaged(path, error) from error


def read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and what is told of them.

    Raises:
        CheckpointError: if the file is damaged, or none of race.
    """
    info = info_of(path)
    try:
        arrays = load_file(path)
    except (OSError, SafetensorError) as error:
        raise _damaged(path, error) from error
    if info["arrays"] != _digest(arrays):
        raise _damaged(path, "the digest of its arrays differs")
    return arrays, info


def _damaged(path: Path, why: object) -> CheckpointError:
    return CheckpointError(
        f"{path} cannot be used: {why}. It is missing, was damaged, or is no file of race's teams."
    )


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    total = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        array = arrays[name]
        total.update(f"{name} {array.dtype} {array.shape}\n".encode())
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
