"""RACE: multi-agent reinforcement learning coupled with an evolving population of teams."""

__version__ = "0.1.0"
