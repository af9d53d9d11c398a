from typing import NamedTuple


class Map(NamedTuple):
    path: str


def get(name: str) -> Map:
    return Map(f"SMAC_Maps/{name}.SC2Map")
