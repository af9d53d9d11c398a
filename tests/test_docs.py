"""Every command that the README and the documents show runs, in their order, at a small size."""

import dataclasses
import importlib
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from race.cli import COMMANDS, main
from race.cli.train import _parse
from race.config.ablations import ablated
from race.config.presets import resolve
from race.config.settings import Config
from race.envs import make_task
from race.types import DiscreteTask

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "results/README.md"]

# Options given twice count as given last, so that these make any training a short one.
SMALL = {
    "train": "--env-steps 700 --evaluation.episodes 1",
    "resume": "--env-steps 13000",
    "evaluate": "--episodes 1",
    "render": "--seconds 0.3",
    "bench": "--only env/Hopper*",
    "export": "",
    "plot": "",
    "compare": "",
    "report": "",
    "reproduce": "--scale 0.0007 --learner.hidden-sizes 10 8 --learner.random-steps 600 "
    "--evaluation.episodes 1",
    "archive": "",
    "show": "",
    "sweep": "",
    "list": "",
    "describe": "",
    "doctor": "",
}

READERS = {"plot", "compare", "report", "reproduce"}
"""Commands that read results."""

CONTINUOUS = (
    "--learner.random-steps 600 --learner.hidden-sizes 10 8 "
    "--learner.batch-size 4 --learner.gradient-steps-per-env-step 0.01"
)


def small(words: list[str]) -> list[str]:
    """A command that is done soon."""
    if "--draw-only" in words:
        return words
    options = shlex.split(SMALL[words[0]])
    if "--seeds" in words:
        options += ["--seeds", "1-2"]
    if words[0] == "train" and (
        words[1] == "--config" or not isinstance(make_task(words[1]), DiscreteTask)
    ):
        # EA learns nothing by gradients.
        options += shlex.split("--learner.hidden-sizes 10 8" if "ea" in words else CONTINUOUS)
    return [*words, *options]


def shown(document: Path) -> list[str]:
    """The lines in shell blocks of a document that call `race`."""
    blocks = re.findall(r"```sh\n(.*?)```", document.read_text(), re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [
        line.split("  #")[0].strip() for line in lines if re.match(r"(taskset .* )?race ", line)
    ]


TUTORIALS = tuple(sorted((ROOT / "docs/tutorials").glob("*.md")))
LONG = (ROOT / "docs/runs.md", ROOT / "docs/micro.md", ROOT / "results/README.md", *TUTORIALS)
"""Documents whose commands take a minute and more."""


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(path, id=path.name, marks=[pytest.mark.slow] if path in LONG else [])
        for path in DOCUMENTS
    ],
)
def test_commands_in_documents_run(
    document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if document.name != "README.md" or document.parent != ROOT:
        # Documents after the README may use the run that its first command makes.
        first = ["train", "mamujoco/HalfCheetah-2x3", "--run-dir", "runs/first"]
        if any("runs/first" in line for line in shown(document)):
            main([*small(first), "--env-steps", "7000"])
    for block in re.findall(r"```toml\n(task = .*?)```", document.read_text(), re.DOTALL):
        one = block.replace('["race", "matd3"]', '"matd3"').replace('"1-3"', '"1"')
        one = one.replace(
            "env_steps = 30_000",
            "env_steps = 700\nlearner.random_steps = 600\n"
            "learner.gradient_steps_per_env_step = 0.01",
        )
        for name in ("sweep.toml", "settings.toml"):
            Path(name).write_text(one.replace("[1e-3, 3e-4]", "1e-3"))
    for line in shown(document):
        words = shlex.split(line)
        for word in words:
            # Figures of results show runs besides those whose commands are shown.
            if word.startswith("results/") and (ROOT / word).exists() and READERS & {*words}:
                Path(word).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / word, word)
        main(small(words[words.index("race") + 1 :]))
    for example in re.findall(r"```python\n(.*?)```", document.read_text(), re.DOTALL):
        # It reads a run of these commands.
        if 'race.load("runs/battle' in example or document in TUTORIALS:
            exec(example, {})


def test_lengths_of_training_in_documents_are_possible() -> None:
    """As they stand: where commands are run, they are made smaller."""
    checked = 0
    for document in DOCUMENTS:
        for block in re.findall(r"```(?:sh)?\n(.*?)```", document.read_text(), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                if not line.startswith("race train ") or "--env-steps" not in line:
                    continue
                chosen = _parse(shlex.split(line.split("  #")[0])[2:])
                fields = {field.name for field in dataclasses.fields(Config)}
                asked = Config(**{n: v for n, v in vars(chosen).items() if n in fields})
                discrete = asked.task.startswith(("micro/", "smac"))
                resolve(ablated(asked, chosen.ablation, discrete), discrete=discrete)
                checked += 1
    assert checked > 6


@pytest.mark.slow
def test_modules_called_in_documents_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    shortened = {"cases": "", "tournament": "--battles 2 3s_vs_3z"}
    called = []
    for document in DOCUMENTS:
        for block in re.findall(r"```sh\n(.*?)```", document.read_text(), re.DOTALL):
            for module, words in re.findall(
                r"^python -m race\.envs\.micro\.(\w+)(.*)$", block, re.M
            ):
                called.append(module)
                files = [
                    str(file)
                    for word in shlex.split(words)
                    for file in (sorted(ROOT.glob(word)) or [word])
                ]
                run = importlib.import_module(f"race.envs.micro.{module}").main
                assert run([*files, *shlex.split(shortened[module])]) == 0
    assert sorted(set(called)) == ["cases", "tournament"]


def test_examples_of_battles_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from race.envs.micro import make

    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/micro.md").read_text()
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(examples) == 2
    for example in examples:
        exec(example, {})
    (table,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    Path("3m.toml").write_text(table)
    assert (make("3m.toml").shape.n_allies, make("3m.toml").shape.n_enemies) == (3, 3)


def test_python_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page from its beginning to its end, with a smaller run."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/python.md").read_text()
    learner = '{"hidden_sizes": (6, 5), "random_steps": 60, "gradient_steps_per_env_step": 0.05}'
    for long, short in (
        ("mamujoco/HalfCheetah-2x3", "mamujoco/Hopper-3x1"),
        ("50_000", '70, algo="matd3", evaluation={"episodes": 1}'),
        ('{"batch_size": 256}', learner),
        ("seconds=5", "seconds=0.1"),
        ("episodes=10", "episodes=2"),
    ):
        assert long in text
        text = text.replace(long, short)
    names: dict[str, Any] = {}
    for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(example, names)
    assert names["stopped"].finished
    assert abs(names["same"] - names["team"].act(state=names["state"])).max() < 1e-5
    assert names["video"].frames > 1


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((ROOT / "docs/first-run.ipynb").read_text())
    assert notebook["nbformat"] == 4
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["run"].finished
    assert len(names["tests"]) > 4


def test_the_readme_names_every_command() -> None:
    text = (ROOT / "README.md").read_text()
    assert all(f"`race {command}" in text for command in COMMANDS)


def test_make_targets_exist() -> None:
    targets = re.findall(r"^make (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert targets == ["demo", "test"]
    makefile = (ROOT / "Makefile").read_text()
    assert all(f"\n{target}:" in makefile for target in targets)


@pytest.mark.slow
def test_the_demo_makes_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = (ROOT / "Makefile").read_text().split("\ndemo: ")[1].split("\n\n")[0]
    monkeypatch.chdir(tmp_path)
    settings = (ROOT / "docs/examples/demo.toml").read_text()
    assert "env_steps = 80_000" in settings
    Path("docs/examples").mkdir(parents=True)
    Path("docs/examples/demo.toml").write_text(
        settings.replace("80_000", "3_000\nlearner.random_steps = 2_900\nevaluation.episodes = 1")
    )
    commands = re.findall(r"\$\(BIN\)/race (.*)", recipe)
    assert len(commands) == 3
    for command in commands:
        words = shlex.split(command)
        main([*words, *(["--seconds", "0.3"] if words[0] == "render" else [])])
    for made in re.findall(r"demo/\w+\.\w+", (ROOT / "README.md").read_text()):
        assert Path(made).stat().st_size > 1000
