"""Bad input by the hundred: a command, its exit code, and words that its message must have."""

from typing import NamedTuple


class Case(NamedTuple):
    """A command line after ``race``, in a directory of its own."""

    command: str
    words: tuple[str, ...]
    code: int = 1
    parsed: bool = False
    """Whether it is the parser that must find it, so that nothing may stand in for it."""


def _cases(prefix: str, told: dict[str, str | tuple[str, ...]]) -> list[Case]:
    return [
        Case(prefix.format(name), (words,) if isinstance(words, str) else words)
        for name, words in told.items()
    ]


# Settings: every value must be refused by the name of its setting.

_CHAIN = "train probe/chain --learner.random-steps 50 "
_SETTINGS: dict[str, str] = {
    "seed": "-1 2147483648 99999999999999999999",
    "env-steps": "0 -5 20 2147483648 10000000000000000000000",
    "learner.batch-size": "0 1 -3 16385 2000000",
    "learner.actor-learning-rate": "0 -1 nan inf 1e300 1e-300",
    "learner.critic-learning-rate": "0 -1 nan inf 1e39",
    "learner.gradient-clip": "0 -1 nan inf 1e300",
    "learner.discount": "1 -0.1 1.5 nan 0.99999999999",
    "learner.target-update-rate": "0 -1 1.1 nan inf",
    "learner.policy-delay": "0 -1 99999999999",
    "learner.exploration-noise": "-1 nan inf 1e308 1e6",
    "learner.smoothing-noise": "-1 nan inf 1e308",
    "learner.smoothing-clip": "-1 nan inf 1e308",
    "learner.replay-capacity": "0 10 1073741825 100000000000",
    "learner.gradient-steps-per-env-step": "0 -1 101 nan inf",
    "race.population-size": "0 -1 3 4 16385 99999999999",
    "race.mutation-fraction": "-0.1 1.1 nan inf",
    "race.vmm-weight": "-1 nan inf 1e300",
    "race.mutation-probability": "-0.1 1.1 nan",
    "race.agent-mutation-probability": "-0.1 1.1 nan",
    "race.tournament-size": "0 -1 99999999999",
    "race.policy-embedding-size": "0 16385",
    "race.mine-size": "0 16385 100000000000",
    "race.teams-per-batch": "0 -1 6 100000000000",
    "race.mine-embedding-layers": "0 3 100000000000",
    "env.retries": "-1 1001 99999999999999999999",
    "env.step-seconds": "0 -1 nan inf 1e7",
    "evaluation.every": "0 -1 99999999999999999999",
    "evaluation.episodes": "0 -1 16385 1000000000000",
    "checkpoint.minutes": "-1 nan inf",
    "checkpoint.keep": "0 -1 99999999999",
    "checkpoint.keep-best": "-1 1001",
}
_MATCHING = "train probe/matching "
_FACMAC: dict[str, str] = {
    "facmac.mixer-size": "0 16385",
    "facmac.hypernet-size": "0 -1 16385",
    "facmac.hidden-size": "0 16385",
    "facmac.value-size": "0 16385",
    "facmac.batch-size": "1 16385",
    "facmac.actor-learning-rate": "0 -1 nan inf",
    "facmac.critic-learning-rate": "0 nan 1e-300",
    "facmac.gradient-clip": "0 nan inf",
    "facmac.discount": "1 -0.1 nan 0.99999999999",
    "facmac.td-lambda": "-0.1 1.1 nan",
    "facmac.target-update-every": "0 99999999999",
    "facmac.epsilon-start": "-0.1 1.1 nan",
    "facmac.epsilon-finish": "-0.1 1.1",
    "facmac.epsilon-steps": "0 99999999999",
    "facmac.replay-capacity": "31 1073741825",
    "facmac.gradient-steps-per-episode": "0 101 nan inf",
}
SETTINGS = [
    Case(f"{task}--{name} {value}", (name,))
    for task, table in ((_CHAIN, _SETTINGS), (_MATCHING, _FACMAC))
    for name, values in table.items()
    for value in values.split()
] + [
    Case(f"{_CHAIN}--learner.hidden-sizes 0 8", ("learner.hidden-sizes",)),
    Case(f"{_CHAIN}--learner.hidden-sizes 8 16385", ("learner.hidden-sizes",)),
    Case("train probe/chain --learner.random-steps -1", ("learner.random-steps",)),
    Case("train probe/chain --learner.random-steps 2000000", ("random-steps",)),
    Case(f"{_CHAIN}--env.step-seconds 1 --env.processes False", ("env.step-seconds", "process")),
    Case(
        "train mamujoco/Ant-2x4 --env.agent-obsk 99999999999999999999", ("env.agent-obsk", "1000")
    ),
    Case("train mamujoco/Ant-2x4 --env.agent-obsk -1", ("env.agent-obsk",)),
]

# Settings, and whole choices, without effect.

EFFECTLESS = [
    Case(f"train {options}", (told,))
    for options, told in {
        "probe/chain --env.agent-obsk 1": "--env.agent-obsk would have no effect",
        "probe/chain --env.library-observation": "--env.library-observation would have no effect",
        "probe/matching --env.processes True": "one compiled program",
        "probe/matching --env.retries 1": "--env.retries would have no effect",
        "probe/matching --learner.discount 0.9": "--learner.discount would have no effect",
        "probe/matching --preset td3": "--preset td3 has no effect",
        "probe/chain --facmac.td-lambda 0.5": "--facmac.td-lambda would have no effect",
        "probe/chain --algo matd3 --race.mine-size 64": "--race.mine-size would have no effect",
        "probe/chain --algo matd3 --base maddpg": "--base would have no effect",
        "probe/chain --algo maddpg --learner.policy-delay 3": "MATD3 alone has it",
        "probe/chain --base facmac --learner.smoothing-noise 0.3": "MATD3 alone has it",
        "probe/matching --algo facmac --facmac.value-size 16": "--facmac.value-size would have no",
        "probe/chain --jobs 2": "--jobs has no effect without --seeds",
        "probe/matching --algo matd3": "Use --algo facmac",
        "bad_tasks:fine --env.agent-obsk 1": "--env.agent-obsk would have no effect",
        "mamujoco/Ant-2x4 --env.library-observation --env.agent-obsk 1": "chooses for itself",
    }.items()
]

# Tasks that cannot be, before anything is made.

_TASK = "train bad_tasks:{} --algo matd3 --learner.random-steps 100 --env-steps 130"
TASKS = [
    *_cases(
        _TASK,
        {
            "task_none": "returned None instead of a race.types.Task",
            "task_raises": ("task_raises failed: KeyError: 'boom', in", "bad_tasks.py, line"),
            "task_exits": ("it called sys.exit('bye'), in", "bad_tasks.py, line"),
            "task_exits_silently": ("it called sys.exit(), in", "bad_tasks.py, line"),
            "task_env": "returned Box",
            "task_two": "missing 1 required positional argument",
            "not_callable": "has no function not_callable",
            "no_such": "has no function no_such",
            "make_raises": "RuntimeError: boom in make",
            "make_exits": "it called sys.exit('bye')",
            "make_none": "make(None) returned None instead of a gymnasium environment",
            "make_text": "make(None) returned str 'env'",
            "act_unbounded": "no finite bounds",
            "act_equal": "low below high",
            "act_huge": "no larger than 1e+15",
            "act_narrow": "in 32 bits too",
            "act_whole": "of whole numbers",
            "act_discrete": "the action space must be a Box",
            "act_square": "the action space must be a Box",
            "space_dict": "FlattenObservation",
            "space_image": "the observation space must be a Box",
            "space_none": "the observation space must be a Box",
            "index_overlap": "exactly one agent",
            "index_nobody": "at least one observation entry",
            "index_missing": "exactly one agent",
            "index_negative": "an entry of obs_index is -1",
            "index_large": "outside the state of size 4",
            "index_fraction": "an entry of obs_index is 0.7",
            "index_text": "an entry of obs_index is 'a'",
            "index_flat": "obs_index is [0, 1]",
            "index_none": "obs_index is None",
            "index_agents": "must describe the same agents",
            "limit_zero": "episode_limit is 0",
            "limit_negative": "episode_limit is -5",
            "limit_fraction": "episode_limit is 20.5",
            "limit_float": "write 20",
            "limit_text": "episode_limit is '20'",
            "limit_none": "no time limit",
            "name_none": "must be a text",
            "name_empty": "must be a text",
        },
    ),
    Case("train no_such_module:task", ("there is no module no_such_module",)),
    Case("train no.such.module:task", ("there is no module no",)),
    Case("train :task", ("There is no task ':task'",)),
    Case("train bad_tasks:", ("There is no task 'bad_tasks:'",)),
    Case("train bad_tasks.py:fine", ("there is no module bad_tasks.py",)),
    Case("train broken_module:task", ("SyntaxError", "broken_module.py, line 1")),
    Case("train exiting_module:task", ("it called sys.exit(0), in", "exiting_module.py, line 3")),
    Case("train needy_module:task", ("needs the module no_such_thing",)),
    Case("train micro/no_such_map", ("nearest",)),
    Case("train micro/nowhere.toml", ("cannot be read",)),
    Case("train mamujoco/Ant-9x9", ("mamujoco/Ant-",)),
    Case("train mamujoco/NoRobot-2x1", ("nearest",)),
    Case("train probe/nothing", ("nearest",)),
    Case("train [/red]", ("There is no task '[/red]'",)),
]

# Environments that break the contract at once: found in a trial, before a run is made.

_STEP = "at step 1 of the episode"
_SHAPE = "but the task says (4,)"
_TRIED: dict[str, tuple[str, ...]] = {
    "reset_alone": ("in the reset", "an array of shape (4,)", "return observation, {}"),
    "reset_none": ("in the reset", "returned None instead of the pair"),
    "reset_list": ("a list of 1",),
    "reset_info_none": ("a tuple of 2", "return observation, {}"),
    "reset_nan": ("entry 0 of the observation is nan",),
    "reset_shape": ("has shape (5,)", _SHAPE),
    "reset_scalar": ("has shape ()", _SHAPE),
    "reset_one": ("has shape (1,)", _SHAPE),
    "reset_dict": ("is a dictionary ('left')", "FlattenObservation"),
    "reset_text": ("is str 'abcd'",),
    "reset_raises": ("in the reset", "ValueError: boom in reset, in", "bad_tasks.py, line"),
    "reset_exits": ("in the reset", "it called sys.exit(), in", "bad_tasks.py, line"),
    "four": (_STEP, "a tuple of 4", "a time limit is truncated"),
    "none": (_STEP, "step returned None"),
    "six": ("a tuple of 6",),
    "info_list": ("a tuple of 5",),
    "obs_none": (_STEP, "is None"),
    "obs_text": ("is str 'abcd'",),
    "obs_five": ("has shape (5,)", _SHAPE),
    "obs_one": ("has shape (1,)", _SHAPE),
    "obs_column": ("has shape (4, 1)", _SHAPE),
    "obs_square": ("has shape (4, 4)", _SHAPE),
    "obs_scalar": ("has shape ()", _SHAPE),
    "obs_objects": ("type object",),
    "obs_complex": ("type complex128",),
    "obs_ragged": ("is no array of shape (4,)",),
    "obs_dict": ("is a dictionary ('left')",),
    "obs_nan": ("entry 1 of the observation is nan", "That is no number"),
    "obs_inf": ("entry 3 of the observation is inf", "not finite"),
    "obs_1e300": ("entry 0 of the observation is 1e+300", "scale it"),
    "obs_1e30": ("entry 0 of the observation is 1e+30", "scale it"),
    "reward_none": ("the reward is None",),
    "reward_text": ("the reward is str '1.5'",),
    "reward_agents": ("the reward is a list of 2 (1.0, 2.0)", "Add up"),
    "reward_dict": ("the reward is a dictionary",),
    "reward_array": ("the reward is an array of shape (2,)",),
    "reward_complex": ("the reward is complex 1j",),
    "reward_nan": ("the reward is nan",),
    "reward_inf": ("the reward is inf",),
    "reward_1e38": ("the reward is 1e+38", "scale it"),
    "done_none": ("terminated is None", "for the whole team"),
    "done_text": ("terminated is str 'False'",),
    "done_agents": ("terminated is a list of 2 (False, False)",),
    "done_array": ("terminated is an array of shape (2,)",),
    "done_dict": ("terminated is a dictionary ('agent_0')",),
    "done_number": ("terminated is int 2",),
    "cut_agents": ("truncated is a list of 2",),
    "cut_text": ("truncated is str 'False'",),
    "raises": (_STEP, "RuntimeError: boom in step, in", "bad_tasks.py, line"),
    "raises_nothing": ("RuntimeError, in", "bad_tasks.py, line"),
    "raises_lines": ("line one line two line four",),
    "raises_disk": ("No space left on device", "bad_tasks.py, line"),
    "raises_pipe": ("the simulator has gone",),
    "raises_memory": ("MemoryError, in", "bad_tasks.py"),
    "raises_stop": ("StopIteration, in",),
    "raises_assert": ("AssertionError: [/red] is no markup",),
    "raises_gym": ("ResetNeeded",),
    "exits": ("it called sys.exit(), in", "bad_tasks.py, line"),
    "exits_three": ("it called sys.exit(3)",),
    "exits_text": ("it called sys.exit('bye')",),
}
TRIED = _cases(_TASK, dict(_TRIED.items()))

# The same in the middle of a run: in its random steps, where nothing has been learned yet.

LATE = _cases(
    _TASK + " --learner.hidden-sizes 4 4 --learner.batch-size 4 --env.retries 0 --run-dir run",
    {
        "reset_late": "boom in reset",
        "late_interrupts": ("KeyboardInterrupt, in", "bad_tasks.py, line"),
        "third_make": ("there are two licences only, in", "bad_tasks.py, line"),
        **{
            f"late_{name}": words
            for name, words in _TRIED.items()
            if name.startswith(("obs_", "reward_", "done_", "raises", "exits", "none"))
        },
    },
)

# Environments with discrete actions.

_GAME = "train bad_tasks:{} --algo facmac --env-steps 50"
GAMES = _cases(
    _GAME,
    {
        "g_done_agents": ("after 1 step:", "terminated is a list of 2"),
        "g_done_dict": "terminated is a dictionary ('agent_0')",
        "g_done_text": "terminated is str 'False'",
        "g_reward_agents": "the reward is a list of 2",
        "g_reward_text": "the reward is str '1.5'",
        "g_reward_nan": "the reward is nan",
        "g_limit_number": 'info["episode_limit"] is int 6, but must be one True or False for the '
        "whole team, and no number",
        "g_limit_text": 'info["episode_limit"] is str',
        "g_two": "step must return (reward, terminated, info)",
        "g_four": "step must return (reward, terminated, info)",
        "g_none": "step must return (reward, terminated, info)",
        "g_raises": ("boom in step", "bad_tasks.py, line"),
        "g_exits": ("it called sys.exit(0)", "bad_tasks.py, line"),
        "g_obs_nan": "entry (0, 0) of what get_obs returned is nan",
        "g_obs_short": "what get_obs returned has shape (1, 3)",
        "g_obs_ragged": "what get_obs returned is no array",
        "g_obs_none": "what get_obs returned is None",
        "g_state_inf": "of what get_state returned is",
        "g_state_long": "what get_state returned has shape (7,)",
        "g_masked": "no action is available to agent 0",
        "g_mask_negative": "has the entry -1",
        "g_mask_fraction": "has the entry 0.2",
        "g_mask_short": "has shape (1, 3)",
        "g_mask_text": "must be an array of numbers",
        "g_shape_tuple": "obs_shape is a whole number",
        "g_no_limit": "episode_limit is a whole number",
        "g_no_agents": "n_agents is a whole number",
        "g_info_none": "it returned None",
        "o_mask": "has the entry -1",
        "o_idle": "no action is available to agent 0",
        "o_obs_shape": "obs has shape (3, 2)",
        "o_state_none": "state is None",
        "o_state_nan": "entry 0 of state is nan",
        "o_array": "must be a dictionary of obs [2, 3]",
        "o_done_agents": "terminated is a list of 2",
        "o_zero": "episode_limit is 0",
        "o_none": "n_actions is None",
        "o_1e3": "episode_limit is 1000.0",
        "o_text": "n_agents is '2'",
    },
)

# Words that mean nothing, and files that are none.

USAGE = [
    Case(command, (told,), code, parsed=True)
    for command, told, code in (
        ("trian probe/chain", "Did you mean `race train`", 2),
        ("train", "TASK", 2),
        ("train probe/chain --no-such-flag 3", "no-such-flag", 2),
        ("train probe/chain --learner.batch-size many", "many", 2),
        ("train probe/chain --algo sarsa", "sarsa", 2),
        ("train probe/chain --seed 1.5", "1.5", 2),
        ("train probe/chain --facmac.replay-precision float64", "float64", 2),
        ("train probe/chain --run-dir=", "an argument is empty", 2),
        ("train probe/chain --seeds 1-99999999999999999999", "at most 1000", 1),
        ("train probe/chain --seeds 5-1", "--seeds is", 1),
        ("train probe/chain --seeds 1,1", "twice", 1),
        ("train probe/chain --seeds 1-3 --jobs 0", "--jobs is 0", 1),
        ("train probe/chain --run-dir file", "is a file", 1),
        ("train probe/chain --run-dir file/run", "file/run", 1),
        (f"train probe/chain --run-dir {'x' * 300}", "too long", 1),
        ("train probe/chain --run-dir loop/run", "symbolic links", 1),
        ("evaluate nowhere", "not the directory of a run", 1),
        ("evaluate file", "not the directory of a run", 1),
        ("evaluate [/red]", "[/red] is not the directory", 1),
        (f"evaluate {'x' * 300}", "too long", 1),
        ("evaluate nowhere --episodes 0", "--episodes is 0", 1),
        ("evaluate nowhere --episodes 1000000000000", "at most 1000000", 1),
        ("evaluate nowhere --seed -1", "--seed is -1", 1),
        ("resume nowhere", "not the directory of a run", 1),
        ("render nowhere", "not the directory of a run", 1),
        ("render nowhere --out team.avi", ".mp4 or .gif", 1),
        ("render nowhere --seconds 1e308", "at most 100000", 1),
        ("render nowhere --seconds nan", "0 or more", 1),
        ("render nowhere --seed 99999999999", "below 2147483648", 1),
        ("plot", "which runs", 1),
        ("plot nowhere", "not a directory", 1),
        ("plot file", "not a directory", 1),
        ("archive", "which runs", 1),
        ("archive nowhere", "not a directory", 1),
        ("show nowhere", "not the directory of a run", 1),
        ("show nowhere --rows -1", "--rows is -1", 1),
        ("bench --only no-such-subject", "no-such-subject", 1),
    )
]
