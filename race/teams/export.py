"""A team as a file that runs elsewhere, without JAX and without this library.

Before a file is put in place it is read back as its user will, and must act as the team does, on
random observations and on those of an episode; else it is refused.
"""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple, get_args

from race import ALGORITHM_VERSION, __version__
from race.errors import ConfigError, ExportError
from race.runs import metrics
from race.runs.aside import written_aside
from race.runs.directory import RunDirectory
from race.teams.checking import RANDOM, TOLERANCE, Moments, checked, shown_to
from race.teams.formats import (
    SUFFIXES,
    Format,
    card_text,
    made_with,
    read,
    signature,
    written,
)
from race.teams.portable import Portable
from race.teams.team import Team
from race.types import EnvSpec


class Exported(NamedTuple):
    """A file that was written."""

    path: Path
    card: Path
    bytes: int
    difference: float
    """The largest between the file and the team, in the units of `TOLERANCE`."""


def export(
    team: Team, out: Path, kind: Format | None = None, *, per_agent: bool = False
) -> list[Exported]:
    """Writes a team, or each of its agents, with a card (JSON) beside each file.

    Args:
        team: the team.
        out: the file; of each agent, ``NAME-agent0.onnx`` and so on.
        kind: its format. None: what its name ends with.
        per_agent: one file for each agent, which then needs no other, instead of one for all.

    Raises:
        ConfigError: if the format is not known, or its package is missing.
        ExportError: if a file does not act as the team does, or cannot be written.
        TaskError: if the environment fails that an episode is played in.
    """
    chosen = format_of(out, kind)
    shown = shown_to(team)
    files = []
    for number in range(team.spec.n_agents) if per_agent else [None]:
        part = team.portable if number is None else team.agent(number)
        path = out if number is None else out.with_name(f"{out.stem}-agent{number}{out.suffix}")
        content = written(part, chosen, number is not None)
        function = read(content, chosen, part, number is not None)
        difference = checked(function, team, number, shown, path)
        card = path.with_name(f"{path.name}.json")
        told = _card(team, part, number, chosen, path, content, shown, difference)
        _put(path, content)
        _put(card, card_text(told).encode())
        files.append(Exported(path, card, len(content), difference))
    return files


def format_of(out: Path, kind: str | None) -> Format:
    """The format that is meant.

    Raises:
        ConfigError: if there is no such, or the name says another.
    """
    ending = {suffix: name for name, suffix in SUFFIXES.items()}.get(out.suffix.lower())
    if kind is not None and kind not in get_args(Format):
        raise ConfigError(f"There is no format {kind!r}; there are {', '.join(get_args(Format))}.")
    if kind is None and ending is None:
        raise ConfigError(
            f"{out} does not say its format: let it end with {', '.join(SUFFIXES.values())}, or "
            "name it with --format."
        )
    if None not in (kind, ending) and kind != ending:
        raise ConfigError(f"{out} is called as {ending} is, but its format is to be {kind}.")
    found: Any = kind or ending
    return found


def _card(
    team: Team,
    part: Portable,
    agent: int | None,
    kind: Format,
    path: Path,
    content: bytes,
    shown: Moments,
    difference: float,
) -> dict[str, Any]:
    """What the file is, for people and programs."""
    trained, spec = team.trained, team.spec
    inputs, outputs = signature(part, agent is not None)
    described: dict[str, Any] = {
        "race_team": 1,
        "file": path.name,
        "format": kind,
        "sha256": hashlib.sha256(content).hexdigest(),
        "task": trained.config.task,
        "method": trained.config.method,
        "team": team.name,
        "agent": agent,
        "agents": spec.n_agents,
        "agent_names": team.agent_names,
        "layer_norm": part.layer_norm,
        "obs": f"as the environment shows it{_normalised(part)}",
        "inputs": {n: {"shape": ["batch", *s], "dtype": d} for n, (s, d) in inputs.items()},
        "outputs": {n: {"shape": ["batch", *s], "dtype": d} for n, (s, d) in outputs.items()},
    }
    if isinstance(spec, EnvSpec):
        one = None if agent is None else [agent]
        who = range(spec.n_agents) if one is None else one
        described |= {
            "obs_sizes": [spec.obs_sizes[i] for i in who],
            "obs_of_state": [list(spec.obs_index[i]) for i in who],
            "action_entries": [list(spec.action_index[i]) for i in who],
            "action_units": "the environment's, from low to high",
            "action_low": part.arrays["low"].tolist(),
            "action_high": part.arrays["high"].tolist(),
        }
    else:
        described |= {
            "n_actions": spec.n_actions,
            "memory": "zeros at the beginning of an episode; then next_memory of the step before",
        }
    return described | {
        "episode_limit": spec.episode_limit,
        "test": _tested(team),
        "trained": {
            "run": trained.identity,
            "env_steps": trained.progress.env_steps,
            "seed": trained.config.seed,
        },
        "checked": {
            "random_observations": RANDOM,
            "real_observations": shown.real,
            "largest_difference": difference,
            "tolerance": TOLERANCE,
        },
        "versions": {"race": __version__, "algorithm": str(ALGORITHM_VERSION), **made_with(kind)},
    }


def _normalised(part: Portable) -> str:
    return "; normalised inside" if "obs.mean" in part.arrays else ""


def _tested(team: Team) -> dict[str, Any] | None:
    """The newest test of the team that the run's rows hold, up to its checkpoint."""
    path, steps = team.run_dir, team.trained.progress.env_steps
    file = RunDirectory(path).metrics
    if not file.exists():
        return None
    names = ("return_mean", "return_std", "length_mean", "win_rate")
    for row in reversed(metrics.read(file, team.trained.identity)):
        if row.get("kind") == "evaluation" and row["env_steps"] <= steps:
            of_team = {n: row.get(f"eval/{team.name}/{n}") for n in names}
            told = {name: value for name, value in of_team.items() if value is not None}
            episodes = team.trained.config.evaluation.episodes
            return {"env_steps": row["env_steps"], "episodes": episodes, **told}
    return None


def _put(path: Path, content: bytes) -> None:
    """A whole file or none.

    Raises:
        ExportError: if it cannot be written.
    """
    with written_aside(path, ExportError) as temporary:
        temporary.write_bytes(content)
