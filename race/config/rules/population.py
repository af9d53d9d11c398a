"""What the values of the population's settings must be."""

from race.config.rules import LARGEST_LAYER, Rule
from race.config.settings import EVOLUTIONS, Config, RaceConfig

MOST_JUDGED = 1000
"""Generations whose returns are kept of a team."""


def rules(config: Config) -> list[Rule]:
    """Of a resolved configuration."""
    race, learner = config.race, config.learner
    fewest = 3 + race.elite_copy + config.has_marl
    n_drawn = race.population_size + race.marl_among_teams
    assert race.vmm_weight is not None
    return [
        (
            1 <= race.marl_episodes <= LARGEST_LAYER,
            "race.marl-episodes",
            race.marl_episodes,
            f"from 1 to {LARGEST_LAYER}",
        ),
        (
            race.evolution in EVOLUTIONS or ":" in race.evolution,
            "race.evolution",
            race.evolution,
            f"{', '.join(EVOLUTIONS)}, or package.module:function for your own",
        ),
        (race.population_size >= 3, "race.population-size", race.population_size, "at least 3"),
        (
            race.evolution != "ga" or race.population_size >= fewest,
            "race.population-size",
            race.population_size,
            f"at least {fewest}: an elite, a second parent, "
            f"{'a copy of the elite, ' * race.elite_copy}a team for their offspring"
            f"{' and one for the injected MARL team' * config.has_marl} ({fewest - 1} do with "
            f"--race.no-elite-copy; for no population use --algo {config.base})",
        ),
        (
            0 <= race.surrogate_probability <= 1,
            "race.surrogate-probability",
            race.surrogate_probability,
            "from 0 to 1",
        ),
        *_fitness_rules(race),
        (
            race.learn_after == "generation" or race.surrogate_probability == 0,
            "race.learn-after",
            race.learn_after,
            "generation with --race.surrogate-probability above 0, where all of a population are "
            "judged by one PeVFA",
        ),
        (
            race.learn_after == "generation" or race.replayed == "all",
            "race.learn-after",
            race.learn_after,
            "generation with --race.replayed better: which half of a population is the better one "
            "is known when all have played",
        ),
        (race.surrogate_steps >= 1, "race.surrogate-steps", race.surrogate_steps, "at least 1"),
        (
            1 <= race.teams_per_batch <= n_drawn,
            "race.teams-per-batch",
            race.teams_per_batch,
            f"from 1 to {n_drawn}, the teams there are to draw from with --race.population-size "
            f"{race.population_size}"
            f"{', one more with --race.marl-among-teams' * (not race.marl_among_teams)}",
        ),
        (race.evolution_from >= 0, "race.evolution-from", race.evolution_from, "0 or more"),
        (
            race.own_share is None or 0 <= race.own_share <= 1,
            "race.own-share",
            race.own_share,
            "from 0 to 1, or None for what the replay buffer holds",
        ),
        (
            not config.one_head or race.evolution != "ga" or race.crossover != "agent",
            "race.crossover",
            race.crossover,
            "parameter or layer with --race.team-heads shared: a team's only head can be exchanged "
            "for another's, which makes a copy, but not in part",
        ),
        *_population_rules(race),
        (
            config.whole_teams or race.vfm_marl_weight + race.vfm_team_weight + race.vmm_weight > 0,
            "race.vmm-weight",
            race.vmm_weight,
            "above 0 where the weights of both terms of Eq. (2) are 0, since encoders would learn "
            "from nothing",
        ),
        (
            not (config.whole_teams and learner.shared_agents),
            "learner.shared-agents",
            learner.shared_agents,
            "False where whole teams evolve: each of their agents has an encoder of its own",
        ),
    ]


def _fitness_rules(race: RaceConfig) -> list[Rule]:
    episodes, generations = race.fitness_episodes, race.fitness_generations
    exact = race.surrogate_probability == 0
    return [
        (
            episodes >= 1 and episodes * race.population_size <= LARGEST_LAYER,
            "race.fitness-episodes",
            episodes,
            f"at least 1, and at most {LARGEST_LAYER} over all teams of the population",
        ),
        (
            episodes == 1 or exact,
            "race.fitness-episodes",
            episodes,
            "1 with --race.surrogate-probability above 0, which judges teams by one beginning each",
        ),
        (
            1 <= generations <= MOST_JUDGED,
            "race.fitness-generations",
            generations,
            f"from 1 to {MOST_JUDGED}",
        ),
        (
            generations == 1 or exact,
            "race.fitness-generations",
            generations,
            "1 with --race.surrogate-probability above 0: estimates of some generations and "
            "returns of others have no meaning together",
        ),
        (
            generations == 1 or race.head_learning_rate == 0,
            "race.fitness-generations",
            generations,
            "1 with --race.head-learning-rate above 0: teams that learn do not stay what they were",
        ),
    ]


def _population_rules(race: RaceConfig) -> list[Rule]:
    shares = (
        *("mutation_fraction", "mutation_probability", "agent_mutation_probability"),
        *("crossover_probability", "injection_probability", "value_awareness"),
        *("strong_share", "reset_share", "cem_elite_share", "cem_noise_decay"),
    )
    not_negative = (
        *("vmm_weight", "vfm_marl_weight", "vfm_team_weight", "head_learning_rate"),
        *("strong_strength", "mild_strength", "cem_noise_start", "cem_noise_end"),
    )
    above_0 = ("es_noise", "es_learning_rate")
    positive = ("tournament_size", "policy_embedding_size", "mine_size")
    value = race.__getattribute__
    rules: list[Rule] = [(0 <= value(name) <= 1, name, value(name), "in [0, 1]") for name in shares]
    rules += [(value(name) >= 0, name, value(name), "0 or more") for name in not_negative]
    rules += [(value(name) > 0, name, value(name), "above 0") for name in above_0]
    rules += [(value(name) >= 1, name, value(name), "at least 1") for name in positive]
    layers = race.mine_embedding_layers
    rules.append((layers in (1, 2), "mine_embedding_layers", layers, "1 or 2"))
    largest, total = race.largest_weight, race.strong_share + race.reset_share
    rules += [
        (total <= 1, "reset_share", race.reset_share, "at most 1 together with the strong share"),
        (largest is None or largest > 0, "largest_weight", largest, "above 0, or None"),
    ]
    return [(holds, f"race.{name.replace('_', '-')}", x, must) for holds, name, x, must in rules]
