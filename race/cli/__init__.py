"""The command line: ``race COMMAND ...``. Each command is a module of this package.

A command is added as a module with `main` and a line in `COMMANDS`; nothing below imports it.
"""

import difflib
import importlib
import re
import sys
import time

from race import __version__
from race.cli import streams
from race.errors import RaceError, say

_BEGAN = time.perf_counter()

COMMANDS = {
    "train": "train a team",
    "sweep": "train many runs: combinations of settings, seeds, tasks",
    "reproduce": "make figures of the paper: plan, train what is missing, draw",
    "resume": "go on with a run exactly where it was",
    "evaluate": "play test episodes with a trained team and report its returns",
    "render": "make a video of a trained team, or of a battle",
    "export": "write a trained team to a file that runs elsewhere (ONNX, StableHLO, numpy)",
    "plot": "draw learning curves of one or more runs",
    "compare": "say which method is better, and how sure that is",
    "report": "make a page about runs that needs no network",
    "show": "show what a run is, without running any code of it",
    "archive": "put the results of many runs into one small file",
    "list": "show tasks, algorithms, ablations and presets",
    "describe": "show who sees what and moves what in a task",
    "bench": "measure speed and memory on this machine",
    "doctor": "show what is installed, what is missing and how to mend it",
}

_OUT_OF_MEMORY = "this machine does not have the memory for it."
_SMALLER = (
    " Use smaller networks or batches (--learner.hidden-sizes, --learner.batch-size) or a smaller "
    "buffer (--learner.replay-capacity). On tasks with discrete actions these are "
    "--facmac.hidden-size, --facmac.batch-size and --facmac.replay-capacity."
)

_EXAMPLE = """\
For example:
  race train mamujoco/HalfCheetah-2x3 --seed 1 --env-steps 100000 --run-dir runs/first
  race evaluate runs/first
  race render runs/first --out team.mp4
  race plot runs/first --out curves.png

`race COMMAND --help` explains a command and all its options."""


def main(arguments: list[str] | None = None) -> None:
    """Runs a command. Exits with 0, 1 (failed, with a message), 2 (bad usage) or 130 (Ctrl-C)."""
    streams.prepare()
    try:
        _run(arguments)
    except BrokenPipeError:  # the reader of our output, such as `head`, has gone
        streams.silence(sys.stdout)
        sys.exit(141)
    except OSError as error:
        streams.silence(sys.stdout)
        say(f"race: the output could not be written: {error}.")
        sys.exit(1)
    finally:
        failure = streams.finish()
    if failure is not None:
        say(f"race: the output could not be written: {failure}.")
        sys.exit(1)


def _run(arguments: list[str] | None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return
    if arguments[0] in ("-V", "--version"):
        print(f"race {__version__}")
        return
    command, *rest = arguments
    if any(word == "" or re.fullmatch("--[^=]+=", word) for word in rest):
        say(f"race {command}: an argument is empty. Is a variable of the shell not set?")
        sys.exit(2)
    if command not in COMMANDS:
        near = difflib.get_close_matches(command, COMMANDS, n=1)
        hint = f" Did you mean `race {near[0]}`?" if near else ""
        say(f"race: there is no command {command!r}.{hint}\n\n{_overview()}")
        sys.exit(2)
    try:
        importlib.import_module(f"race.cli.{command}").main(rest)
    except KeyboardInterrupt:
        say(f"\nrace {command}: interrupted.")
        sys.exit(130)
    except Exception as error:
        told = _told(command, error)
        if told is None:  # a mistake of ours: its traceback is what helps
            raise
        say(f"race {command}: {told}")
        sys.exit(1)


def _told(command: str, error: Exception) -> str | None:
    """What a user is told of an error; None if it is none of theirs or of their machine's."""
    out_of_memory = _OUT_OF_MEMORY + (_SMALLER if command in ("train", "resume", "sweep") else "")
    match error:
        case BrokenPipeError():
            return None
        case RaceError():
            return str(error)
        case MemoryError():
            return out_of_memory
        case OSError():
            return f"{error}. See that the disk is not full and that files can be read and written."
        case RuntimeError() if "RESOURCE_EXHAUSTED" in str(error):  # what JAX calls it
            return out_of_memory
    return None


def seconds_since_start() -> float:
    """Seconds since the command line was entered."""
    return time.perf_counter() - _BEGAN


def _overview() -> str:
    lines = "\n".join(f"  {name:<10}{what}" for name, what in COMMANDS.items())
    return (
        "usage: race COMMAND ...\n\n"
        "RACE trains teams of cooperating agents: multi-agent reinforcement learning\n"
        "coupled with an evolving population of teams.\n\n"
        f"{lines}\n\n{_EXAMPLE}"
    )


if __name__ == "__main__":
    main()
