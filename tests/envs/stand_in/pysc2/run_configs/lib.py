from typing import NamedTuple


class Version(NamedTuple):
    game_version: str
    build_version: int


VERSIONS = {"4.10.0": Version("4.10.0", 75689), "4.6.2": Version("4.6.2", 69232)}
