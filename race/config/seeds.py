"""Several seeds, as people write them."""

from race.errors import ConfigError

MOST_SEEDS = 1000
"""Runs of one command: more is a slip of the hand."""


def parse_seeds(text: str) -> list[int]:
    """The seeds of ``1-5``, ``1,4,7`` or ``1-3,9``.

    Raises:
        ConfigError: if it is none of these, or names a seed twice.
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            begin, end = int(first), int(last if dash else first)
            if not 0 <= end - begin < MOST_SEEDS:
                raise ValueError("an empty range, or an endless one")
            seeds += range(begin, end + 1)
    except ValueError as error:
        raise ConfigError(
            f"--seeds is {text!r}, but it must be like 1-5, or 1,4,7, or 1-3,9, "
            f"and name at most {MOST_SEEDS} seeds."
        ) from error
    if len(seeds) > MOST_SEEDS:
        raise ConfigError(f"--seeds is {text!r}, which names more than {MOST_SEEDS} seeds.")
    if len(set(seeds)) < len(seeds):
        raise ConfigError(f"--seeds is {text!r}, which names a seed twice.")
    return seeds
