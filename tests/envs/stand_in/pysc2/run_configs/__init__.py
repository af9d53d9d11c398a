import os
from pathlib import Path
from typing import NamedTuple

from absl import flags

from pysc2.run_configs import lib


class _Config(NamedTuple):
    version: lib.Version


def get(version: str | None = None) -> _Config:
    assert flags.FLAGS.is_parsed(), "as absl refuses flags that were not parsed"
    if version is not None:
        return _Config(lib.VERSIONS[version])
    folders = Path(os.environ["SC2PATH"], "Versions").iterdir()
    return _Config(lib.Version("latest", max(int(f.name.removeprefix("Base")) for f in folders)))
