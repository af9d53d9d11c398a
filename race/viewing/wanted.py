"""What may be asked of a video, known before anything that takes time is imported."""

from pathlib import Path

from race.errors import ConfigError, RenderError

MOST_SECONDS = 100_000


def check_video(out: Path, seconds: float | None, seed: int) -> None:
    """Refuses what cannot be filmed.

    Raises:
        RenderError: if ``out`` is no video.
        ConfigError: for numbers that cannot be.
    """
    if out.suffix.lower() not in (".mp4", ".gif"):
        raise RenderError(f"{out} is no video: the name must end with .mp4 or .gif.")
    if seed < 0 or (seconds is not None and not 0 <= seconds <= MOST_SECONDS):
        raise ConfigError(
            f"--seed and --seconds must be 0 or more, and --seconds at most {MOST_SECONDS}."
        )


def check_seed(seed: int) -> None:
    """Refuses a seed that no episode of a run can have.

    Raises:
        ConfigError: if it is one.
    """
    if seed >= 2**31:
        raise ConfigError(f"The --seed of an episode must be below {2**31}.")
