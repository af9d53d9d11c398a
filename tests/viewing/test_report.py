"""The page about runs: its data are those of `compare`, and it needs nothing from outside."""

import base64
import gzip
import json
import re
import resource
import shutil
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from written_runs import experiment, written_run

from race.cli import main
from race.errors import RaceError
from race.runs import archive
from race.runs.results import load
from race.viewing.comparison import compare
from race.viewing.curves import aggregate
from race.viewing.report import evolution
from race.viewing.report.content import as_text, content_of
from race.viewing.report.evolution import Story
from race.viewing.report.page import page_of
from race.viewing.report.serving import server
from race.viewing.scores import scores_of
from race.viewing.tables import as_json

pytest.importorskip("plotly")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
KIND = {name: number for number, name in enumerate(evolution.KINDS)}


def team(number: int, fitness: float, origin: str, **told: Any) -> dict[str, Any]:
    return {"id": number, "fitness": fitness, "origin": origin, **told}


# Three generations of three teams: the elite stays, 4 is a mutated copy of it, 5 the MARL team;
# then 6 is the parent at place 1 after a mutation, and 7 a child of 4 and 5 by agents.
TEAMS = [
    [team(0, 1.0, "initial"), team(1, 3.0, "initial"), team(2, 2.0, "initial")],
    [
        team(5, 9.0, "injected"),
        team(1, 3.5, "elite"),
        team(4, 4.0, "copy", parents=[1], changes=[[0, 1, 0]]),
    ],
    [
        team(5, 8.0, "elite"),
        team(6, 1.0, "parent", changes=[[1, 0, 0]]),
        team(7, 10.0, "offspring", parents=[[4], [5]]),
    ],
]


def generations() -> list[dict[str, Any]]:
    return [
        {
            "kind": "generation",
            "generation": number + 1,
            "env_steps": 100 * (number + 1),
            "wall_seconds": 10.0 * (number + 1),
            "loss/critic": 1.0 / (number + 1),
            "injection/elite_rate": number / 2,
            "teams": teams,
        }
        for number, teams in enumerate(TEAMS)
    ]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = experiment(tmp_path_factory.mktemp("report"))
    written_run(
        *(path / "evolved", [(100, 1.0), (300, 2.0)], None, "return_mean", generations()),
        task="probe/target",
    )
    return path


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return page_of(content_of(load([folder]), "auto", "selected", None), title="<A> & B")


def parts(page: str) -> dict[str, str]:
    return dict(re.findall(r'<script type="[^"]+" id="(\w+)">(.*?)</script>', page, re.DOTALL))


def test_the_data_of_the_page_are_those_of_compare_and_plot(folder: Path, page: str) -> None:
    data = json.loads(parts(page)["content"])
    runs = load([folder])
    scores = scores_of(runs)
    assert data["comparison"] == json.loads(json.dumps(as_json(compare(scores))))
    at = ("mamujoco/Hopper-3x1", "MATD3", "return_mean", "selected", "env_steps")
    (band,) = [
        b
        for b in data["bands"]
        if (b["task"], b["method"], b["metric"], b["team"], b["axis"]) == at
    ]
    drawn = aggregate([run.curve for run in scores.of(*at[:2])])
    assert band["x"] == drawn.x.tolist()
    assert band["mean"] == pytest.approx(drawn.mean.tolist(), rel=1e-4)
    assert band["low"] == pytest.approx(drawn.low.tolist(), rel=1e-4)
    assert {(run["task"], run["method"], run["seed"]) for run in data["runs"]} == {
        (run.task, run.method, run.seed) for run in scores.runs
    }
    (run,) = [run for run in data["runs"] if run["task"] == "probe/target"]
    assert run["training"]["loss/critic"] == [1.0, 0.5, 0.33333]
    assert run["tests"]["eval/selected/return_mean"] == [1.0, 2.0]


def test_the_page_asks_for_nothing_from_outside(page: str) -> None:
    assert "default-src 'none'" in page
    library = parts(page)["plotly"]
    assert "Plotly" in gzip.decompress(base64.b64decode(library)).decode()
    own = page.replace(library, "")
    assert not re.search(r"https?:|//[a-z]", own.replace("// ", ""))
    assert re.findall(r'(?:src|href)="([^"]*)"', own) == ["data:,"]
    assert "<title>&lt;A&gt; &amp; B</title>" in page
    assert len(page) < 3.5e6


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here; slow tests say more of pages in one")
def test_a_browser_draws_the_page(page: str, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(page)
    words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'user'}"]
    words += ["--virtual-time-budget=20000", "--dump-dom", (tmp_path / "page.html").as_uri()]
    done = subprocess.run([str(CHROMIUM), *words], capture_output=True, text=True, timeout=120)
    assert 'data-drawn="1"' in done.stdout
    assert done.stdout.count('class="main-svg"') > 10


def test_names_cannot_end_the_script() -> None:
    text = as_text({"name": "</script><script>alert(1)\u2028"})
    assert "<" not in text
    assert "\u2028" not in text
    assert json.loads(text)["name"] == "</script><script>alert(1)\u2028"


def test_how_teams_came_about() -> None:
    story = Story(generations())
    assert sorted(story.ids) == [0, 1, 2, 4, 5, 6, 7]
    assert story.born(4) == (2, 4.0, KIND["mutation"], (1,))
    assert story.born(6) == (3, 1.0, KIND["mutation"], (1,))  # who had its place before
    assert story.born(7) == (3, 10.0, KIND["crossover"], (4, 5))
    assert story.born(5).kind == KIND["injected"]
    told = evolution.fitness_of_teams(story)
    assert told["generation"] == [1, 2, 3]
    assert told["fitness"][1] == [9.0, 3.5, 4.0]
    # A team that lives on keeps the kind of its birth.
    assert told["kind"][2] == [KIND[k] for k in ("injected", "mutation", "crossover")]


def test_ancestry_and_winners() -> None:
    found = evolution.ancestry(Story(generations()))
    assert sorted(found["id"]) == [1, 4, 5, 6, 7]
    assert found["generation"] == sorted(found["generation"], reverse=True)
    assert found["parents"][found["id"].index(7)] == [4, 5]
    assert found["cut"] == [False]
    counts = evolution.winners(Story(generations()))  # 1, 5 and 7
    assert (sum(counts), counts[KIND["crossover"]], counts[KIND["initial"]]) == (3, 1, 1)
    assert evolution.ancestry(Story([]))["id"] == []


def test_many_generations_are_thinned_and_the_last_is_kept() -> None:
    rows = [
        {"generation": g, "teams": [team(g, float(g), "copy", parents=[g - 1] if g else [])]}
        for g in range(1000)
    ]
    told = evolution.fitness_of_teams(Story(rows))
    assert len(told["generation"]) <= evolution.MOST_GENERATIONS
    assert told["generation"][-1] == 999
    found = evolution.ancestry(Story(rows))
    assert (len(found["id"]), found["cut"]) == (evolution.MOST_ANCESTORS, [True])


def test_archives_have_no_lineage_and_runs_without_tests_are_shown(tmp_path: Path) -> None:
    path = written_run(tmp_path / "young", [], None, "return_mean", generations())
    young = content_of(load([path]), "auto", "selected", None)
    assert young["comparison"] is None
    assert "not been an evaluation" in young["remarks"][0]
    assert young["runs"][0]["teams"] is not None
    archive.write(tmp_path / "kept.jsonl.gz", load([path]))
    kept = content_of(load([tmp_path / "kept.jsonl.gz"]), "auto", "selected", None)
    assert kept["runs"][0]["teams"] is None


def test_settings_that_differ(tmp_path: Path) -> None:
    for seed, alpha in ((1, 0.2), (2, 0.4)):
        made = written_run(tmp_path / str(seed), [(100, 1.0)], seed=seed)
        config = json.loads((made / "config.json").read_text())
        config["race"]["mutation_fraction"] = alpha
        (made / "config.json").write_text(json.dumps(config))
    written_run(tmp_path / "base", [(100, 1.0)], algo="matd3")
    told = content_of(load([tmp_path]), "auto", "selected", None)["settings"]
    (row,) = (row for row in told["rows"] if row[0] == "race.mutation_fraction")
    assert sorted(row[1:]) == ["-", "0.2", "0.4"]
    assert {row[0] for row in told["rows"]} == {"race.mutation_fraction", "algo"}


@pytest.fixture
def watched(folder: Path, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    runs = shutil.copytree(folder / "evolved", tmp_path / "run")

    def make(mark: str) -> str:
        content = content_of(load([runs]), "auto", "selected", None)
        return page_of(content, title="runs", watched=mark)

    with server([runs], make, 0) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        yield runs, f"http://127.0.0.1:{serving.server_port}/"
        serving.shutdown()
        thread.join()


def asked(address: str) -> str:
    with urllib.request.urlopen(address) as answer:
        return str(answer.read().decode())


def test_a_served_page_renews_itself_when_rows_are_written(watched: tuple[Path, str]) -> None:
    runs, address = watched
    first, mark = asked(address), asked(address + "fingerprint")
    assert f'data-watched="{mark}"' in first
    assert asked(address) == first
    with (runs / "metrics.jsonl").open("a") as file:
        row = {"kind": "evaluation", "env_steps": 400, "eval/selected/return_mean": 7.25}
        file.write(json.dumps(row | {"wall_seconds": 40.0}) + "\n")
    assert asked(address + "fingerprint") != mark
    assert "7.25" in asked(address)
    (runs / "metrics.jsonl").write_text("torn\n{")  # a message, not the end of the server
    assert "is no row of metrics" in asked(address)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        asked(address + "etc/passwd")


def test_a_port_that_is_taken(watched: tuple[Path, str]) -> None:
    runs, address = watched
    port = int(address.rstrip("/").rpartition(":")[2])
    with pytest.raises(RaceError, match="Choose another with --port"):
        server([runs], lambda mark: mark, port)
    with pytest.raises(RaceError, match="--port"):
        server([runs], lambda mark: mark, 99999)
    with pytest.raises(RaceError, match="does not exist"):
        server([runs / "nowhere"], lambda mark: mark, 0)


def test_the_command(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "page.html"
    main(["report", str(folder), "--out", str(out), "--title", "mine"])
    assert "Page: " in capsys.readouterr().out
    assert "<h1>mine</h1>" in out.read_text()
    (tmp_path / "nothing").mkdir()
    for words, said in (
        ([], "Say which runs"),
        ([str(folder), "--out", "page.pdf"], "must end with .html"),
        ([str(tmp_path / "nothing")], "holds none"),
        ([str(written_run(tmp_path / "empty", []))], "no rows of metrics"),
    ):
        with pytest.raises(SystemExit):
            main(["report", *words])
        assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_hundred_long_runs_take_under_twenty_seconds_and_twenty_under_six_megabytes(
    tmp_path: Path,
) -> None:
    rows = generations()
    many = [
        rows[g % 3] | {"generation": g, "env_steps": 100 * g, "wall_seconds": g * 1.0}
        for g in range(1, 1801)
    ]
    points = [(900 * k, float(k)) for k in range(1, 201)]
    for seed in range(100):
        path = tmp_path / f"{seed // 20}" / f"{seed}"
        written_run(path, points, None, "return_mean", many, seed=seed)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    words = ["report", str(tmp_path), "--out", str(tmp_path / "all.html")]
    # In a process of its own: checks of shapes and types would triple the time.
    subprocess.run([sys.executable, "-m", "race", *words], check=True)
    # Of the processor: what others do meanwhile does not count.
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 20
    main(["report", str(tmp_path / "0"), "--out", str(tmp_path / "some.html")])
    assert (tmp_path / "some.html").stat().st_size < 6e6
