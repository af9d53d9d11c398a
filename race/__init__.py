"""RACE: multi-agent reinforcement learning coupled with an evolving population of teams."""

__version__ = "0.2.0"

ALGORITHM_VERSION = 2
"""Raised whenever equal settings and seeds begin to give other numbers than before."""
