"""Every setting of a run, with the paper's symbol beside it.

A `Config` is frozen and passed explicitly. It is written to ``config.json`` at the start of a
run and read back by every other command, so a run directory explains itself.
"""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from race.config.compute import ComputeConfig

Algo = Literal["race", "merl", "ea", "matd3", "maddpg", "facmac"]
Base = Literal["matd3", "maddpg", "facmac"]
Preset = Literal["paper", "td3", "demo"]
ReplayPrecision = Literal["float16", "float32"]
MutationDraw = Literal["row", "weight"]
Level = Literal["agent", "parameter", "layer"]
Selection = Literal["team", "agent"]
Places = Literal["ranked", "agent"]
TeamDraw = Literal["once", "each"]
PevfaTarget = Literal["target", "online"]
PolicyEmbedding = Literal["shared", "each"]
UtilityEmbedding = Literal["team", "agent"]
VmmReduction = Literal["mean", "sum"]
MineNegatives = Literal["steps", "episodes"]
PopulationActions = Literal["greedy", "sampled"]
TeamHeads = Literal["agent", "shared"]
Replayed = Literal["all", "better"]
LearnAfter = Literal["generation", "episode"]
EVOLUTIONS = ("ga", "cem", "es")
TeamName = Literal["marl", "champion", "selected"]
TeamReward = Literal["mean", "sum"]
StateSource = Literal["auto", "environment", "observations"]


@dataclass(frozen=True)
class LearnerConfig:
    """The gradient learner of continuous actions, with and without a population."""

    hidden_sizes: tuple[int, int] = (400, 300)
    """Units of the two layers of each encoder and critic (Table 1, Table 2)."""
    layer_norm: bool = True
    """Normalise the layers of encoders, critics and PeVFA before each activation."""
    shared_agents: bool = False
    """One encoder for all agents, which is told the agent's number, instead of one each."""
    last_layer_scale: float = 1.0
    """What the last layers of the MARL team, the critic and the PeVFA are multiplied by at the
    start."""
    batch_size: int = 128
    """Transitions in a minibatch."""
    actor_learning_rate: float = 1e-3
    """Adam step size of the encoders and the MARL team's heads."""
    encoder_learning_rate: float | None = None
    """That of the encoders, if it is to be another."""
    critic_learning_rate: float = 1e-3
    """Adam step size of the critic, the PeVFA, the state-value net and MINE."""
    gradient_clip: float = 10.0
    """Largest norm of a gradient: of all agents' encoders together, of all heads, of a critic."""
    discount: float = 0.99
    """Discount factor, the paper's gamma."""
    target_update_rate: float = 0.005
    """Share of the online network mixed into its target at each target update (TD3's tau)."""
    policy_delay: int = 2
    """Critic steps per policy, encoder and target step. MADDPG and FACMAC always use 1."""
    exploration_noise: float = 0.1
    """Standard deviation of the noise on the MARL team's actions, as a share of their range."""
    smoothing_noise: float = 0.2
    """Standard deviation of target policy smoothing. MADDPG and FACMAC use none."""
    smoothing_clip: float = 0.5
    """Largest smoothing noise."""
    replay_capacity: int = 1_000_000
    """Transitions that the replay buffer holds."""
    random_steps: int = 10_000
    """Environment steps of uniformly random actions before the first generation."""
    random_steps_owed: bool = False
    """The random steps too are owed gradient steps, all in the first generation."""
    gradient_steps_per_env_step: float = 1.0
    """Gradient steps for each environment step that is owed some."""


@dataclass(frozen=True)
class FacmacConfig:
    """FACMAC on discrete actions, where it is recurrent and learns from whole episodes.

    On continuous actions its mixer is this one, and everything else as for the other learners.
    """

    mixer_size: int = 32
    """Units of the monotonic mixing network."""
    hypernet_size: int = 64
    """Units of the hidden layers of the mixer's two-layer hypernetworks."""
    hidden_size: int = 64
    """Units of the encoder: of the layer before the GRU, and of the GRU."""
    utility_sizes: tuple[int, int] = (64, 64)
    """Units of the two layers of the agents' utilities."""
    value_size: int = 32
    """Units of the state-value net (Appendix A.1)."""
    layer_norm: bool = False
    """Normalise the layers of the encoder, the utilities and their PeVFA before each ReLU."""
    batch_size: int = 32
    """Episodes in a minibatch."""
    actor_learning_rate: float = 2.5e-3
    """Adam step size of the encoder and the MARL team's head."""
    encoder_learning_rate: float | None = None
    """That of the encoder, if it is to be another."""
    last_layer_scale: float = 1.0
    """What the last layers of the MARL team, the utilities and their PeVFA are multiplied by at
    the start."""
    critic_learning_rate: float = 5e-4
    """Adam step size of utilities, mixers, the state-value net and MINE."""
    gradient_clip: float = 10.0
    """Largest norm of a gradient: of the encoder, of the head, of utilities and mixer together."""
    discount: float = 0.99
    """Discount factor, the paper's gamma."""
    td_lambda: float = 0.8
    """Lambda of the targets: 0 looks one step ahead, 1 to the end of the episode."""
    target_update_every: int = 200
    """Gradient steps after which targets become copies of the networks."""
    epsilon_start: float = 0.5
    """Share of the MARL team's actions that are random, at the beginning."""
    epsilon_finish: float = 0.05
    """The same in the end."""
    epsilon_steps: int = 50_000
    """Environment steps from the one to the other."""
    replay_capacity: int = 5_000
    """Episodes that the replay buffer holds."""
    replay_precision: ReplayPrecision | None = None
    """What observations and states are stored as; float32 takes twice the memory. None: float16 on
    micro/*, whose numbers are about 1, else float32: float16 merges 10001 and 10002."""
    gradient_steps_per_episode: float = 1.0
    """Gradient steps for each episode collected, from the first full minibatch on."""


@dataclass(frozen=True)
class RaceConfig:
    """The population, its evolution and the shared encoder's losses (Section 3, Tables 2, 3)."""

    population_size: int = 5
    """Teams of the population, the paper's n."""
    evolution: str = "ga"
    """How the population evolves: ga (the paper's genetic algorithm), cem (cross-entropy method),
    es (evolution strategy), or package.module:function for your own."""
    cem_elite_share: float = 0.5
    """Share of the population that the cross-entropy method moves towards."""
    cem_noise_start: float = 1e-3
    """What it adds to the variance of each weight, at first."""
    cem_noise_end: float = 1e-5
    """The same in the end."""
    cem_noise_decay: float = 0.95
    """What is left of the difference of the two after a generation."""
    es_noise: float = 0.05
    """Standard deviation of the teams around the evolution strategy's mean."""
    es_learning_rate: float = 0.02
    """Adam step size of its mean."""
    sharing: bool = True
    """All teams share the encoders. Without, each team of the population has networks of its own,
    and there is no PeVFA: MERL with agent-level operators."""
    mutation_fraction: float | None = None
    """Share of a picked head's weights that mutate, the paper's alpha. None: Tables 3 and 4, else
    0.5, on tasks with discrete actions 0.05; with merl and ea 0.1."""
    vmm_weight: float | None = None
    """Weight of Value-Aware MI Maximization, the paper's beta. None: Tables 3 and 4, else
    0.01."""
    vfm_marl_weight: float = 1.0
    """Weight of the MARL team's value in what the encoders climb, the first term of Eq. (2)."""
    vfm_team_weight: float = 1.0
    """Weight of a population team's value there, the second term of Eq. (2)."""
    head_learning_rate: float = 0.0
    """Step size at which the team W_j of Eq. (2) climbs its own value with the encoders, by plain
    gradient steps on its heads. 0: the population changes by evolution alone."""
    value_awareness: float = 1.0
    """How much the mutual information of a state counts by its value: 1 as in Eq. (5), 0 not at
    all, so that every state has the weight 1."""
    crossover_probability: float = 1.0
    """Probability that two offspring exchange heads; else they are copies of their parents."""
    injection_probability: float = 1.0
    """Probability that the MARL team enters the population at the end of a generation."""
    mutation_probability: float = 0.9
    """Probability that a team that is not the elite mutates."""
    agent_mutation_probability: float = 0.5
    """Probability that an agent of a mutating team is picked (at least one is)."""
    crossover: Level | None = None
    """What two parents exchange: policies of agents, rows of whole teams with no regard to agents
    (parameter), or rows of random layers. None: agent, with merl and ea layer, where a team has one
    head for all agents parameter."""
    mutation: Level | None = None
    """What a mutation draws its weights from: the policies of picked agents, whole teams with no
    regard to agents (parameter), or random layers. None: agent, with merl and ea layer."""
    selection: Selection = "team"
    """Whether parents, and who gives way to offspring, are chosen once per team or for each agent
    anew; fitness and elite are the team's."""
    places: Places = "ranked"
    """Where the elite's copy and the offspring go: whole into the places of those that give way, by
    their fitness, or each agent's heads into these places in a random order of the agent's own, as
    if each agent evolved by itself."""
    mutation_draw: MutationDraw | None = None
    """Whether a mutation's kind (strong, reset or mild) is drawn once per row or once per weight.
    None: row, with merl and ea weight."""
    strong_share: float = 0.05
    """Share of mutations that are strong, N(0, (strong-strength w)^2) for a weight w."""
    reset_share: float = 0.05
    """Share of mutations that draw a weight anew, from N(0, 1); the others are mild."""
    strong_strength: float = 10.0
    """Standard deviation of a strong mutation, in units of the weight."""
    mild_strength: float = 0.1
    """Standard deviation of a mild mutation, in units of the weight."""
    largest_weight: float | None = 10.0
    """What mutates is kept within it. None: no bound."""
    elite_copy: bool = True
    """A copy of the elite enters the next population and is open to mutation."""
    team_draw: TeamDraw = "once"
    """Whether a gradient step draws one team of the population for both Eqs. (1) and (2) or one
    for each."""
    teams_per_batch: int = 1
    """Different teams that such a draw takes. The losses of PeVFA and state values and the second
    term of Eq. (2) are the means over them, each with the whole minibatch."""
    marl_among_teams: bool = False
    """The MARL team is among the teams that are drawn."""
    pevfa_target: PevfaTarget = "target"
    """Encoders over which W_j acts in the PeVFA's targets of Eq. (1): target, its actions smoothed
    like the MARL team's, or online, its actions as they are."""
    policy_embedding: PolicyEmbedding = "shared"
    """Whether the two critics of a PeVFA share a policy embedding or have one each."""
    utility_embedding: UtilityEmbedding = "team"
    """What FACMAC's PeVFA tells the utility of an agent of a team's policies: the embedding of the
    team, or that of the agent's own. Its mixer sees the team's (Appendix A.1)."""
    vmm_reduction: VmmReduction = "mean"
    """Whether Eq. (5) is the mean over the steps of a minibatch of episodes, or the mean over its
    episodes of the sums over their steps: as much larger as episodes are long."""
    mine_negatives: MineNegatives = "steps"
    """What Eq. (3) contrasts an agent's embedding in an episode with: the same agent's at other
    steps, of any episode, or those of all agents of other episodes at the same time of theirs."""
    one_pevfa: bool = False
    """The PeVFA serves the MARL team too, and there is no other critic (Section 3.2)."""
    team_heads: TeamHeads = "agent"
    """Discrete actions: whether a team of the population has a head for each agent, or one through
    which all of its agents act, as the MARL team does. A team is then one policy."""
    population_actions: PopulationActions = "greedy"
    """Discrete actions of the population in training: the policies' best, or sampled from the
    policies, as the MARL team's are. In tests they are the best."""
    marl_episodes: int = 1
    """Episodes of the MARL team in a generation, for one of each team of the population."""
    own_share: float | None = None
    """Share of a minibatch that is the MARL team's own experience; the rest is others', random
    steps among them. None: what the replay buffer holds, about a sixth with five teams."""
    replayed: Replayed = "all"
    """Which episodes of a generation go into the replay buffer: all, or, of the population's, the
    better ones alone, which returned no less than their median. The MARL team's always do."""
    learn_after: LearnAfter = "generation"
    """When gradient steps are made: in one block after all episodes of a generation, or, after
    each episode, those that it owes; the teams then play one after the other."""
    fitness_episodes: int = 1
    """Episodes of each team of the population in a generation; their mean return is its fitness."""
    fitness_generations: int = 1
    """Generations over which a team's returns are averaged into its fitness: this one, and those
    before it in which its heads were what they are now. The encoders have moved in between."""
    surrogate_probability: float = 0.0
    """Probability that a generation judges the population by the beginnings of its episodes and
    what the PeVFA expects after them, as the code does that the paper's evolution is taken from;
    else by whole episodes. On tasks with continuous actions."""
    surrogate_steps: int = 200
    """Steps of such a beginning."""
    evolution_from: int = 0
    """Environment steps before which the MARL team plays alone and nothing evolves."""
    tournament_size: int = 3
    """Teams from which the second parent is the best."""
    policy_embedding_size: int = 64
    """Units of the policy embedding network (Table 2)."""
    mine_size: int = 128
    """Units of the MINE networks (Appendix A.1)."""
    mine_embedding_layers: int = 1
    """Layers in MINE that encode an embedding, 1 (Appendix A.1) or 2; a state is encoded by two."""


def _depths(words: list[str]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(word.split(",")) for word in words)


Categories = Annotated[
    tuple[tuple[str, ...], ...],
    # On the command line one word per distance: --env.local-categories qpos,qvel qpos
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="NAME,NAME...",
        instance_from_str=_depths,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(depth) for depth in value],
    ),
]


@dataclass(frozen=True)
class EnvConfig:
    """What Multi-Agent MuJoCo shows, who is a team of others' environments, where these run."""

    agent_obsk: int = 0
    """Observe joints up to this distance; 0 is the agent's own joints only (Section 4.1)."""
    local_categories: Categories = (("qpos", "qvel"),)
    """What is observed of the joints at each distance 0, 1, ..., such as: qpos,qvel qpos. The last
    repeats."""
    global_categories: tuple[str, ...] = ()
    """What is observed of the torso."""
    library_observation: bool = False
    """Use gymnasium-robotics' own default observation instead of the three settings above."""
    kwargs: str = "{}"
    """Arguments of an environment of PettingZoo, JaxMARL or SMAC, as a JSON object, such as
    '{"N": 4}'."""
    python: str | None = None
    """Of smac/* and smacv2/*: the interpreter in which SMAC is installed, which need not have
    race. None: this one."""
    agents: str = "*"
    """Its agents that are the team: patterns such as 'adversary_*', with commas in between."""
    others: str = "random"
    """What its other agents do: random, or package.module:function, which is called with (agent,
    observation, action space, numpy generator) and returns an action (PettingZoo)."""
    team_reward: TeamReward = "mean"
    """What the team is paid: the mean or the sum of its agents' rewards. An agent that is not there
    gets 0."""
    state: StateSource = "auto"
    """The global state: the environment's own (state(), world_state), or what all agents observe.
    auto: its own, if there is one and it is not too large."""
    episode_limit: int | None = None
    """Steps after which an episode is cut off (truncated). None: what the environment calls
    max_cycles or max_steps."""
    largest_observation: int = 4096
    """Most entries of what an agent observes, and of the environment's own state."""
    reward_scale: float = 1.0
    """What rewards are multiplied by before anything is learned from them. Returns, in metrics and
    for the population's fitness, stay in the task's own units."""
    normalise: bool = False
    """Show networks every entry of what agents observe, and of the state, less its mean and divided
    by its standard deviation over all that the run's teams have seen, within +-10."""
    processes: bool | None = None
    """Run each environment in a process of its own. None: where it pays (slow physics and
    enough cores), for games of StarCraft II, and where steps have a time limit."""
    retries: int = 3
    """How often an episode is played anew in a fresh environment when its environment fails (an
    error, a dead process, a step that takes too long), once the task has shown that it works."""
    step_seconds: float | None = None
    """Longest time of a step; environments then run in processes. None: no limit. Making and
    resetting one may take ten times as long, at least a minute."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Test episodes during training, without exploration noise."""

    every: int | None = None
    """Environment steps between evaluations (at the next end of a generation). None: 5,000, on
    tasks with discrete actions 10,000."""
    episodes: int | None = None
    """Episodes per team and evaluation. None: 10, on tasks with discrete actions 32."""


@dataclass(frozen=True)
class CheckpointConfig:
    """When the whole state is written to disk."""

    minutes: float = 5.0
    """Wall time between checkpoints; 0 writes one at every opportunity (100 gradient steps)."""
    keep: int = 2
    """Newest checkpoints kept."""
    keep_best: int = 0
    """Best tested teams kept besides, in DIR/best: the teams alone, without what goes on."""


@dataclass(frozen=True)
class Config:
    """A whole run."""

    task: str
    algo: Algo = "race"
    base: Base | None = None  # until presets are filled in
    ablation: tuple[str, ...] = ()
    """Names of what was taken away (`race.config.ablations`); the settings below say it too."""
    discrete: bool = False
    seed: int = 1
    env_steps: int = 1_000_000
    init_from: str | None = None
    """The run whose teams it began with, in place of random ones."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    facmac: FacmacConfig = field(default_factory=FacmacConfig)
    race: RaceConfig = field(default_factory=RaceConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)

    @property
    def has_population(self) -> bool:
        """Whether teams evolve."""
        return self.algo in ("race", "merl", "ea")

    @property
    def has_marl(self) -> bool:
        """Whether there is a MARL team, and so anything to learn by gradients."""
        return self.algo != "ea"

    @property
    def whole_teams(self) -> bool:
        """Whether whole networks evolve instead of heads over shared encoders."""
        return self.has_population and not (self.algo == "race" and self.race.sharing)

    @property
    def one_head(self) -> bool:
        """Whether all agents of a team of the population act through one head."""
        evolves_heads = self.has_population and not self.whole_teams
        return evolves_heads and self.discrete and self.race.team_heads == "shared"

    @property
    def n_marl_teams(self) -> int:
        """Episodes of the MARL team in a generation."""
        if not self.has_marl:
            return 0
        return self.race.marl_episodes if self.has_population else 1

    @property
    def tells_own(self) -> bool:
        """Whether the replay buffer tells the MARL team's experience from others'."""
        return self.has_population and self.race.own_share is not None

    @property
    def n_population_teams(self) -> int:
        """Episodes of the population in a generation."""
        return self.race.population_size * self.race.fitness_episodes * self.has_population

    @property
    def n_teams(self) -> int:
        """Teams of a generation: the population and the MARL team, as often as they play."""
        return self.n_population_teams + self.n_marl_teams

    @property
    def in_turns(self) -> bool:
        """Whether the teams of a generation play one after the other, and not all at once."""
        return self.has_population and self.race.learn_after == "episode"

    @property
    def method(self) -> str:
        """The method's name as figures show it, such as ``RACE(MATD3)``."""
        name = self.algo.upper()
        return f"{name}({str(self.base).upper()})" if self.algo in ("race", "merl") else name

    @property
    def policy_delay(self) -> int:
        """Critic steps per policy step."""
        return 1 if self.discrete else self.learner.policy_delay
