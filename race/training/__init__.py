"""Training: a run from start or checkpoint to its end, generation by generation.

The order of a run's events is decided here, what they do to networks in `race.algorithms`.
"""
