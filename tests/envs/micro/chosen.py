"""The maps that tests of every map run on: some of each kind in a usual run, the others if slow."""

import pytest

from race.envs.micro import map_names

USUAL = frozenset(
    {
        *("2s3z", "MMM2", "2c_vs_64zg", "2s_vs_1sc", "so_many_baneling", "3s_vs_3z"),
        *("2m_vs_1z", "bane_vs_bane", "6h_vs_8z", "corridor"),
    }
)
"""Shields or none, healers, beams, bursts on either side, cliffs, a structure, walls, half tiles, a
point of attack that is drawn."""

MAPS = [pytest.param(name, marks=() if name in USUAL else pytest.mark.slow) for name in map_names()]
