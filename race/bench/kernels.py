"""How many pieces of work a compiled program hands to the device.

A battle's arrays are small, so on an accelerator the time of a step follows the number of kernels
that are launched for it and hardly their size. That number can be read on any machine.
"""

import math
import re
from collections import Counter
from typing import Final, NamedTuple

_FREE: Final = frozenset(
    {
        *("parameter", "constant", "tuple", "get-tuple-element", "bitcast"),
        *("after-all", "add-dependency", "opt-barrier", "domain", "partition-id", "replica-id"),
    }
)
"""Instructions that name values and move none."""
_ARRAY: Final = re.compile(r"\w+\[([\d,]*)\]")
_NAME: Final = re.compile(r"^\s+(?:ROOT )?%?[\w.\-]+ = ")
_OPCODE: Final = re.compile(r"\s*([\w\-]+)\(")
_HEAD: Final = re.compile(r"^(ENTRY )?%?([\w.\-]+) .*{$")
_TURNS: Final = re.compile(r'"known_trip_count":{"n":"(\d+)"}')
_BRANCHES: Final = re.compile(r"branch_computations={([^}]*)}")


class _Instruction(NamedTuple):
    opcode: str
    empty: bool  # whether its result has no entries
    text: str

    def names(self, attribute: str) -> str:
        """The computation that an attribute names."""
        match = re.search(rf"\b{attribute}=%?([\w.\-]+)", self.text)
        if match is None:
            raise ValueError(f"There is no {attribute} in: {self.text.strip()}")
        return match[1]


def kernels_in(hlo: str) -> Counter[str]:
    """How often each kind of instruction is carried out when a compiled program runs once.

    What counts is every instruction that the compiler left standing alone: one for a ``fusion``,
    whatever it is made of; one for each library call (``custom-call``, ``dot``, ``convolution``,
    ``sort``, ...), ``copy``, ``reduce``, ``gather``, ``scatter``, ``broadcast`` or arithmetic that
    was not fused; one for a loop (``while``) or a choice (``conditional``) as such.

    - A loop adds the instructions of its body times its number of turns, and those of its
      condition once more often than that. Loops in loops multiply. A loop whose number of turns
      the compiler does not know is taken to turn once, so the count is then a lower bound.
    - A choice adds those of its branch with the most.
    - A ``call`` adds those of what it calls and nothing itself.
    - The second half of an instruction that comes in two (``copy-done``), those that only name
      values (parameters, constants, tuples and their elements, bitcasts) and those whose result has
      no entries do not count, nor do the scalar functions of reductions, sorts and scatters.

    Which instructions there are depends on the device that the program was compiled for.

    Args:
        hlo: what ``jax.jit(f).lower(...).compile().as_text()`` returns.

    Returns:
        Number of executions by opcode; their sum is the number of kernels.

    Raises:
        ValueError: if the text is not that of a compiled program.
    """
    entry, computations = _read(hlo)
    known: dict[str, Counter[str]] = {}

    def count(name: str) -> Counter[str]:
        if name not in known:
            known[name] = Counter()
            for instruction in computations[name]:
                known[name] += inside(instruction)
        return known[name]

    def inside(instruction: _Instruction) -> Counter[str]:
        found = Counter({instruction.opcode: 1})
        match instruction.opcode:
            case "while":
                turns = _turns(instruction.text)
                found += _times(count(instruction.names("body")), turns)
                found += _times(count(instruction.names("condition")), turns + 1)
            case "conditional":
                largest = max(map(count, _branches(instruction)), key=lambda each: each.total())
                found += largest
            case "call":
                return count(instruction.names("to_apply"))
            case opcode if opcode in _FREE or instruction.empty or opcode.endswith("-done"):
                return Counter()
        return found

    return count(entry)


def executions(hlo: str) -> dict[str, int]:
    """How often each computation is carried out when a compiled program runs once.

    Fusions and calls count, loops as often as they turn; of a choice every branch counts.

    Args:
        hlo: as `kernels_in` takes it.

    Returns:
        By the computations' names; those that are never carried out, as the scalar functions of
        reductions, have none.
    """
    entry, computations = _read(hlo)
    found: Counter[str] = Counter()

    def run(name: str, times: int) -> None:
        found[name] += times
        for instruction in computations[name]:
            match instruction.opcode:
                case "while":
                    turns = _turns(instruction.text)
                    run(instruction.names("body"), times * turns)
                    run(instruction.names("condition"), times * (turns + 1))
                case "conditional":
                    for branch in _branches(instruction):
                        run(branch, times)
                case "call":
                    run(instruction.names("to_apply"), times)
                case "fusion":
                    run(instruction.names("calls"), times)

    run(entry, 1)
    return dict(found)


def name_of_computation(line: str) -> str | None:
    """The name of the computation that a line of a compiled program begins."""
    head = _HEAD.match(line)
    return head[2] if head else None


def _times(counts: Counter[str], factor: int) -> Counter[str]:
    return Counter({opcode: number * factor for opcode, number in counts.items()})


def _turns(text: str) -> int:
    match = _TURNS.search(text)
    return int(match[1]) if match else 1


def _branches(instruction: _Instruction) -> list[str]:
    if match := _BRANCHES.search(instruction.text):
        return [name.strip().removeprefix("%") for name in match[1].split(",")]
    return [instruction.names(f"{which}_computation") for which in ("true", "false")]


def _read(hlo: str) -> tuple[str, dict[str, list[_Instruction]]]:
    """The name of the computation that is run, and the instructions of all."""
    entry, computations = "", dict[str, list[_Instruction]]()
    instructions: list[_Instruction] = []
    for line in hlo.splitlines():
        if head := _HEAD.match(line):
            instructions = computations[head[2]] = []
            entry = head[2] if head[1] else entry
        elif name := _NAME.match(line):
            instructions.append(_instruction(line, name.end()))
    if not entry:
        raise ValueError("The text names no ENTRY: it is not that of a compiled program.")
    return entry, computations


def _instruction(line: str, begin: int) -> _Instruction:
    """What follows the name: a type, which for several results is a tuple, and the opcode."""
    end = _end_of_tuple(line, begin) if line[begin] == "(" else line.index(" ", begin)
    opcode = _OPCODE.match(line, end)
    if opcode is None:
        raise ValueError(f"There is no opcode in: {line.strip()}")
    shapes = _ARRAY.findall(line[begin:end])
    sizes = [math.prod(int(size) for size in shape.split(",") if size) for shape in shapes]
    return _Instruction(opcode[1], bool(sizes) and not any(sizes), line)


def _end_of_tuple(line: str, begin: int) -> int:
    depth = 0
    for place in range(begin, len(line)):
        depth += (line[place] == "(") - (line[place] == ")")
        if not depth:
            return place + 1
    raise ValueError(f"A bracket is not closed in: {line.strip()}")
