"""Settings that would have no effect: a mistake, and a costly one if it is not told."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

from race.config.hyper import NUMBERS_OF_EVOLUTIONS
from race.config.settings import Config, EnvConfig, FacmacConfig, LearnerConfig, RaceConfig
from race.errors import ConfigError

NETWORKS = {
    "learner": ("hidden_sizes", "layer_norm"),
    "facmac": ("hidden_size", "layer_norm", "replay_precision"),
}
"""Of the learner's settings, those that matter where nothing is learned by gradients."""

_MATD3_ALONE = ("policy_delay", "smoothing_noise", "smoothing_clip")
_MIXER = ("mixer_size", "hypernet_size")
_OBSERVATION = ("agent_obsk", "local_categories", "global_categories")
_PARALLEL = (
    *("agents", "others", "team_reward", "state", "episode_limit"),
    "largest_observation",
)
_SURROGATE = ("surrogate_probability", "surrogate_steps")
_OF_EPISODES = ("vmm_reduction", "mine_negatives")
_HOST = ("processes", "retries", "step_seconds")
_SHARED_ENCODERS = (
    *("vmm_weight", "vfm_marl_weight", "vfm_team_weight", "value_awareness"),
    *("policy_embedding_size", "mine_size", "team_draw", "marl_among_teams", "one_pevfa"),
    *("pevfa_target", "policy_embedding", "utility_embedding", "head_learning_rate", *_SURROGATE),
    *(*_OF_EPISODES, "team_heads", "mine_embedding_layers", "teams_per_batch"),
)
_OF_UNLIKE_AGENTS = ("agent_mutation_probability", "selection", "places", "utility_embedding")
_BESIDE_MARL = (
    *("injection_probability", "marl_episodes", "evolution_from", "own_share", "replayed"),
    "learn_after",
)
_DRAWN_ANEW = ("cem", "es")
_OF_EVOLUTIONS = {
    "ga": (
        *("crossover", "mutation", "selection", "tournament_size", "elite_copy", "mutation_draw"),
        "places",
        *NUMBERS_OF_EVOLUTIONS["ga"],
    ),
    "cem": NUMBERS_OF_EVOLUTIONS["cem"],
    "es": NUMBERS_OF_EVOLUTIONS["es"],
}


class Facts(NamedTuple):
    """What a task is, as far as settings have effects because of it."""

    discrete: bool
    """Whether its actions are."""
    reads_env: bool
    """Whether it reads what its agents observe."""
    on_host: bool
    """Whether its environments run on the host."""
    reads_parallel: bool = False
    """Whether it reads who the team of an environment of PettingZoo or JaxMARL is."""
    reads_game: bool = False
    """Whether it reads which interpreter plays StarCraft II."""


def refuse_without_effect(asked: Config, defaults: LearnerConfig, task: Facts) -> None:
    """Refuses settings that nothing would read.

    Args:
        asked: what was asked for, before presets are filled in.
        defaults: the learner settings of the preset.
        task: what the task is.

    Raises:
        ConfigError: naming the settings, and why they would have no effect.
    """
    told: dict[str, list[str]] = {}
    for name, why in without_effect(asked, defaults, task).items():
        told.setdefault(why, []).append(f"--{name.replace('_', '-')}")
    if told:
        sentences = [
            f"{' and '.join(names)} would have no effect {w}." for w, names in told.items()
        ]
        raise ConfigError(f"{' '.join(sentences)} Leave out what has no effect.")


def without_effect(asked: Config, defaults: LearnerConfig, task: Facts) -> dict[str, str]:
    """The settings that are not what they usually are, though nothing would read them; and why."""
    found: dict[str, str] = {}
    for name, why in _idle(asked, task):
        if name not in found and setting(asked, name) != usual(name, defaults):
            found[name] = why
    return found


def setting(config: Config, name: str) -> Any:
    """The value of a setting, such as ``race.evolution``."""
    group, _, field = name.rpartition(".")
    return getattr(getattr(config, group) if group else config, field)


def usual(name: str, defaults: LearnerConfig) -> Any:
    """The value of a setting that nobody asked for."""
    group, _, field = name.rpartition(".")
    return getattr(defaults if group == "learner" else _DEFAULTS[group], field)


def idle(asked: Config, task: Facts) -> frozenset[str]:
    """The names of settings that nothing would read, such as ``learner.policy_delay``."""
    return frozenset(name for name, _ in _idle(asked, task))


_DEFAULTS: dict[str, Any] = {
    "": Config(""),
    "facmac": FacmacConfig(),
    "race": RaceConfig(),
    "env": EnvConfig(),
}


def _idle(asked: Config, task: Facts) -> Iterator[tuple[str, str]]:
    """The settings that nothing reads, and why."""
    yield from _idle_of_population(asked, task.discrete)
    yield from _idle_of_pevfa(asked, task.discrete)
    yield from _idle_of_learner(asked, task.discrete)
    if not task.reads_env:
        why = f"on {asked.task}, whose agents observe what they do in any case"
        yield from ((f"env.{name}", why) for name in (*_OBSERVATION, "library_observation"))
    elif asked.env.library_observation:
        why = "with --env.library-observation, which chooses for itself"
        yield from ((f"env.{name}", why) for name in _OBSERVATION)
    if not task.reads_parallel:
        why = f"on {asked.task}, which is no PettingZoo or JaxMARL task"
        yield from ((f"env.{name}", why) for name in _PARALLEL)
    if not task.reads_game:
        yield "env.python", f"on {asked.task}, which is no game of StarCraft II"
    if not (task.reads_parallel or task.reads_game):
        why = f"on {asked.task}, whose environment takes no arguments"
        yield "env.kwargs", why
    if not task.on_host:
        why = f"on {asked.task}, which runs in one compiled program"
        yield from ((f"env.{name}", why) for name in _HOST)


def _idle_of_population(asked: Config, discrete: bool) -> Iterator[tuple[str, str]]:
    race = asked.race
    if not asked.has_population:
        why = f"with --algo {asked.algo}, which has no population"
        yield from ((f"race.{name}", why) for name in _names(RaceConfig))
        return
    if asked.whole_teams:
        own = f"with --algo {asked.algo}" if asked.algo != "race" else "with --race.no-sharing"
        names = [*_SHARED_ENCODERS, *["sharing"] * (asked.algo != "race")]
        yield from ((f"race.{name}", f"{own}: each team has networks of its own") for name in names)
    elif race.team_heads == "shared" and discrete:
        why = "with --race.team-heads shared, where a team is one policy"
        yield from ((f"race.{name}", why) for name in _OF_UNLIKE_AGENTS)
    if not asked.has_marl:
        why = f"with --algo {asked.algo}, which has no MARL team"
        yield from ((f"race.{name}", why) for name in _BESIDE_MARL)
    if race.evolution in _DRAWN_ANEW:
        why = f"with --race.evolution {race.evolution}, which draws every team anew"
        yield "race.fitness_generations", why
    for evolution, settings in _OF_EVOLUTIONS.items():
        if evolution != race.evolution:
            why = f"with --race.evolution {race.evolution}: it is of {evolution}"
            yield from ((f"race.{name}", why) for name in settings)


def _idle_of_pevfa(asked: Config, discrete: bool) -> Iterator[tuple[str, str]]:
    base = _base(asked, discrete)
    if base != "matd3":
        yield "race.policy_embedding", f"with {base}, whose PeVFA is one critic"
    if base != "facmac":
        yield "race.utility_embedding", f"with {base}, whose PeVFA has no utilities"
    if discrete:
        why = f"on {asked.task}, whose actions are discrete"
        yield from ((f"race.{name}", why) for name in _SURROGATE)
        return
    if asked.race.surrogate_probability == 0:
        yield "race.surrogate_steps", "with --race.surrogate-probability 0"
    why = f"on {asked.task}, whose actions are continuous"
    yield from ((f"race.{name}", f"{why}: minibatches hold no episodes") for name in _OF_EPISODES)
    yield "race.population_actions", f"{why}: its policies leave nothing to chance"
    yield "race.team_heads", f"{why}: those of its agents are not the same"


def _base(asked: Config, discrete: bool) -> str:
    """The gradient learner that is asked for, or that there is where none is."""
    if not asked.has_population:
        return asked.algo
    return asked.base or ("facmac" if discrete else "matd3")


def _idle_of_learner(asked: Config, discrete: bool) -> Iterator[tuple[str, str]]:
    evolves, algo, base = asked.has_population, asked.algo, _base(asked, discrete)
    if not evolves and asked.base != algo:
        yield "base", f"with --algo {algo}, which is its own gradient learner"
    if not asked.has_marl:
        why = f"with --algo {algo}, where nothing is learned by gradients"
        yield "base", why
        yield "env.reward_scale", why
        group, kind = ("facmac", FacmacConfig) if discrete else ("learner", LearnerConfig)
        idle = (name for name in _names(kind) if name not in NETWORKS[group])
        yield from ((f"{group}.{name}", why) for name in idle)
    if discrete:
        why = (
            f"on {asked.task}. Its actions are discrete; the settings of its learner are --facmac.*"
        )
        yield from ((f"learner.{name}", why) for name in _names(LearnerConfig))
        if asked.has_marl and (not evolves or asked.whole_teams):
            yield "facmac.value_size", "without shared encoders, which alone need state values"
        return
    why = f"on {asked.task}. Its actions are continuous; its learner's settings are --learner.*"
    mixes = _MIXER if base == "facmac" and asked.has_marl else ()
    yield from ((f"facmac.{name}", why) for name in _names(FacmacConfig) if name not in mixes)
    if base != "matd3" and asked.has_marl:
        why = f"with {base}: MATD3 alone has it"
        yield from ((f"learner.{name}", why) for name in _MATD3_ALONE)


def _names(group: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(group)]
