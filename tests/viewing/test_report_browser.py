"""The page in a real browser: it draws, filters work, nothing is fetched, a phone can show it."""

import json
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_report import generations
from written_runs import experiment, written_run

from race.cli import main
from race.config.settings import RaceConfig
from race.runs.results import load
from race.viewing.report.content import content_of
from race.viewing.report.page import page_of
from race.viewing.report.serving import server

pytestmark = pytest.mark.slow
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    with playwright.sync_playwright() as library:
        try:
            started = library.chromium.launch(executable_path=found, args=["--no-sandbox"])
        except playwright.Error as error:
            pytest.skip(f"no Chromium: {error}")
        yield started
        started.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = experiment(tmp_path_factory.mktemp("browser"))
    written_run(
        *(folder / "evolved", [(100, 1.0), (300, 2.0)], None, "return_mean", generations()),
        task="probe/target",
    )
    main(["report", str(folder), "--out", str(folder / "page.html")])
    return (folder / "page.html").as_uri()


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page with battles and videos of two runs that were trained for a moment."""
    folder = tmp_path_factory.mktemp("shown")
    tiny = "--env-steps 130 --evaluation.episodes 1 --facmac.batch-size 2"
    for seed in ("1", "2"):
        words = ["train", "micro/3m", *tiny.split(), "--seed", seed]
        main([*words, "--run-dir", str(folder / seed)])
    words = ["--replays", "all", "--videos", "--out", str(folder / "page.html")]
    main(["report", str(folder), *words])
    return (folder / "page.html").as_uri()


class Window:
    """A page with all that it said and asked for."""

    def __init__(self, browser: Any, address: str, width: int = 1200, scheme: str = "light"):
        size = {"width": width, "height": 900}
        self.page = browser.new_context(viewport=size, color_scheme=scheme).new_page()
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.error = pytest.importorskip("playwright.sync_api").Error
        self.page.goto(address)
        self.wait("document.body.dataset.drawn")

    def wait(self, condition: str) -> None:
        """Until a condition holds; the library's own waiting needs what the page forbids."""
        for _ in range(300):
            try:
                if self.page.evaluate(f"Boolean({condition})"):
                    return
            except self.error:  # it is being loaded
                pass
            time.sleep(0.05)
        raise AssertionError(f"it never came to {condition}")

    def traces(self, place: str = "curves") -> list[list[str]]:
        """Names of what is drawn, for each chart of a section."""
        found: list[list[str]] = self.page.evaluate(
            f"[...document.querySelectorAll('#{place} .chart')].map(c => c.data.map(t => t.name))"
        )
        return found


def test_it_draws_and_asks_for_nothing(browser: Any, address: str) -> None:
    window = Window(browser, address)
    assert window.said == []
    assert window.asked == [address]
    assert len(window.traces()) == 3
    names = {name for chart in window.traces() for name in chart}
    assert {"MATD3 (5)", "RACE(MATD3) (5)", "RACE(MATD3) (1)", "seed 1"} <= names
    assert len(window.traces("losses")) == 1
    assert window.page.locator("#curves svg.main-svg").count() >= 3
    assert window.page.locator("#tables table").count() == 4


def test_filters_work(browser: Any, address: str) -> None:
    window = Window(browser, address)
    window.page.locator("#tasks label", has_text="probe").click()
    assert len(window.traces()) == 2
    window.page.locator("#methods input[value='MATD3']").click()
    assert all("MATD3 (5)" not in chart for chart in window.traces())
    window.page.locator("#seeds input[value='2']").click()
    for chart in window.traces():  # four seeds alone, without the mean of five
        assert chart == ["RACE(MATD3) (seeds alone)"] * 4
    # What was chosen outlives a reload.
    window.page.reload()
    window.wait("document.body.dataset.drawn")
    assert window.traces() == [["RACE(MATD3) (seeds alone)"] * 4] * 2
    window.page.select_option("#axis", "wall_time")
    x = window.page.evaluate("document.querySelector('#curves .chart').data[0].x")
    assert x == pytest.approx([10 / 60, 20 / 60, 30 / 60], rel=1e-4)
    assert window.said == []


def test_evolution_is_drawn_as_recorded(browser: Any, address: str) -> None:
    window = Window(browser, address)
    place = window.page.evaluate(
        "[...document.querySelectorAll('#run option')].findIndex(o => o.text.includes('probe'))"
    )
    window.page.select_option("#run", index=place)
    drawn = window.page.evaluate(
        "[...document.querySelectorAll('#evolution .chart')].map(c => c.data.map("
        "t => [t.name, t.mode, t.x, t.y]))"
    )
    fitness, tree, won, injected = drawn
    assert {name for name, *_ in fitness} == {"initial", "mutation", "crossover", "injected"}
    edges = [
        (x[i], x[i + 1]) for _, mode, x, _ in tree if mode == "lines" for i in range(0, len(x), 3)
    ]
    # 1 -> 4, 1 -> 6, 4 -> 7, 5 -> 7, by the generations of their births.
    assert sorted(edges) == [(1, 2), (1, 3), (2, 3), (2, 3)]
    assert sum(won[0][3]) == 3
    assert [name for name, *_ in injected] == ["elite"]


def test_battles_can_be_stepped_through(browser: Any, shown: str) -> None:
    window = Window(browser, shown, width=390)
    window.wait("document.querySelector('#fought canvas')")
    page, canvas = window.page, window.page.locator("#fought canvas")

    def step() -> int:
        return int(page.locator("#fought > div").get_attribute("data-step"))

    def picture() -> str:
        return str(canvas.evaluate("c => c.toDataURL()"))

    last = int(page.locator("#fought input").get_attribute("max"))
    assert 0 < last <= 60
    assert step() == 0
    first = picture()
    canvas.focus()
    for key, expected in (("ArrowLeft", 0), ("ArrowRight", 1), ("End", last), ("ArrowRight", last)):
        page.keyboard.press(key)
        assert step() == expected
    assert f"step {last} of {last}" in page.locator("#fought output").text_content()
    assert picture() != first
    page.locator("#fought input").evaluate(
        "s => { s.value = 3; s.dispatchEvent(new Event('input')); }"
    )
    assert step() == 3
    page.keyboard.press("Home")
    assert picture() == first
    page.select_option("#fought select", "4")
    page.locator("#fought button").click()
    window.wait("Number(document.querySelector('#fought > div').dataset.step) >= 4")
    assert "pause" in page.locator("#fought button").text_content()
    canvas.focus()
    page.keyboard.press(" ")
    stopped = step()
    assert "play" in page.locator("#fought button").text_content()
    # The other run, by filter and by choice.
    page.select_option("#battle", index=1)
    window.wait("document.querySelector('#fought > div')?.dataset.step === '0'")
    assert stopped >= 4
    page.locator("#seeds input[value='2']").click()
    assert page.locator("#battle option").count() == 1
    window.wait("document.querySelector('#fought canvas')")
    page.locator("#seeds input[value='1']").click()
    assert "No battle" in page.locator("#fought").text_content()
    assert window.page.evaluate("document.documentElement.scrollWidth") == 390
    assert window.said == []


def test_videos_play_and_distances_are_drawn(browser: Any, shown: str) -> None:
    window = Window(browser, shown)
    assert window.page.locator("#videos video").count() == 2
    window.wait("[...document.querySelectorAll('video')].every(v => v.readyState > 0)")
    told = "[...document.querySelectorAll('video')].map(v => [v.duration, v.videoWidth])"
    for duration, width in window.page.evaluate(told):
        assert duration > 0.5
        assert width == 960
    sizes = "JSON.parse(document.getElementById('content').textContent).runs.map(r => r.video.data)"
    assert all(len(data) < 2e6 for data in window.page.evaluate(sizes))
    (heat,) = window.page.evaluate(
        "[...document.querySelectorAll('#evolution .chart')].map(c => c.data[0])"
        ".filter(t => t.type === 'heatmap')"
    )
    assert [name.split()[0] for name in heat["x"]] == ["team"] * 5 + ["MARL"]
    assert [row[k] for k, row in enumerate(heat["z"])] == [0] * 6
    window.page.locator("#seeds input[value='2']").click()
    assert window.page.locator("#videos video").count() == 1
    assert window.said == []
    assert [url for url in window.asked if not url.startswith("blob:")] == [shown]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_both_themes_can_be_read(browser: Any, address: str, scheme: str) -> None:
    window = Window(browser, address, scheme=scheme)
    bright = "(c => c.match(/\\d+/g).slice(0, 3).reduce((a, b) => a + Number(b), 0) / 765)"
    back, text = window.page.evaluate(
        f"[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
        f".map({bright})"
    )
    assert (back < 0.2 and text > 0.8) if scheme == "dark" else (back > 0.8 and text < 0.2)
    paper = "document.querySelector('#curves .chart').layout.paper_bgcolor"
    before = window.page.evaluate(paper)
    window.page.click("#theme")
    assert window.page.evaluate(paper) != before
    assert window.said == []


def test_a_phone_can_show_it(browser: Any, address: str) -> None:
    window = Window(browser, address, width=390)
    assert window.page.evaluate("document.documentElement.scrollWidth") == 390
    widths = window.page.evaluate(
        "[...document.querySelectorAll('.chart .main-svg')].map(svg => svg.clientWidth)"
    )
    assert all(300 < width <= 390 for width in widths)
    window.page.locator("#methods input[value='MATD3']").click()
    assert all("MATD3 (5)" not in chart for chart in window.traces())


def test_a_watched_page_loads_itself_again(browser: Any, tmp_path: Path) -> None:
    runs = written_run(tmp_path / "run", [(100, 1.0)])

    def make(mark: str) -> str:
        content = content_of(load([runs]), "auto", "selected", None)
        return page_of(content, title="runs", watched=mark)

    with server([runs], make, 0) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        window = Window(browser, f"http://127.0.0.1:{serving.server_port}/")
        points = "document.querySelector('#curves .chart')?.data?.[0].x.length"

        def write(steps: int) -> None:
            with (runs / "metrics.jsonl").open("a") as file:
                row = {"kind": "evaluation", "env_steps": steps, "eval/selected/return_mean": 2.0}
                file.write(json.dumps(row | {"wall_seconds": 20.0}) + "\n")

        write(200)
        window.wait(f"{points} === 2")
        # Not under the hands of somebody.
        window.page.keyboard.press("Tab")
        write(300)
        for _ in range(8):
            time.sleep(0.5)
            assert window.page.evaluate(f"{points} === 2")
            window.page.keyboard.press("Tab")
        window.wait(f"{points} === 3")
        assert window.said == []
        assert {url.rpartition("/")[2] for url in window.asked} <= {"", "fingerprint"}
        serving.shutdown()
        thread.join()


def test_long_names_leave_room_for_curves(browser: Any, tmp_path: Path) -> None:
    for seed in range(8):
        race = RaceConfig(
            mutation_fraction=0.1 + seed / 10, vmm_weight=1e-3 * 2**seed, population_size=5 + seed
        )
        written_run(tmp_path / f"{seed}", [(100, 1.0), (200, 2.0)], seed=seed, race=race)
    main(["report", str(tmp_path), "--out", str(tmp_path / "page.html")])
    window = Window(browser, (tmp_path / "page.html").as_uri(), width=390)
    plot = window.page.locator("#curves .chart .nsewdrag").bounding_box()
    assert plot["height"] > 150
    keys = window.page.locator("#curves .keys button")
    assert keys.count() == 8
    assert all(keys.nth(k).bounding_box()["x"] + 20 < 390 for k in range(8))
    shown = "document.querySelector('#curves .chart').data.filter(t => t.visible !== false).length"
    before = window.page.evaluate(shown)
    keys.first.click()
    assert window.page.evaluate(shown) < before
    keys.first.click()
    assert window.page.evaluate(shown) == before
    # Words before a choice are whole.
    assert window.page.locator("label", has_text="run").first.bounding_box()["height"] < 50
    assert window.said == []
