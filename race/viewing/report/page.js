"use strict";
(() => {
  const data = JSON.parse(document.getElementById("content").textContent);
  const $ = (id) => document.getElementById(id);
  const METRICS = { return_mean: "test return", win_rate: "test win rate", length_mean: "length of test episodes" };
  const TEAMS = { selected: "selected", marl: "MARL team", champion: "champion", best: "best of two tests (biased upwards)" };
  // What teams are, in the order of `kinds`: colours that both themes show.
  const KIND_COLOURS = ["#8b93a1", "#b9bec7", "#2f7ed8", "#e08a1e", "#8a5cd1", "#d62728", "#2ca02c", "#17a2a2"];
  const order = (key) => ["loss", "time", "marl", "population", "injection", "operators"].indexOf(key.split("/")[0]);
  const unique = (list) => [...new Set(list)].sort((a, b) => (a > b) - (a < b));
  const dark = () => document.documentElement.dataset.theme === "dark";

  // What was chosen outlives a reload; without a place to keep it, it does not.
  const kept = (() => { try { return JSON.parse(sessionStorage.getItem("race-report")) || {}; } catch { return {}; } })();
  const keep = (key, value) => {
    kept[key] = value;
    try { sessionStorage.setItem("race-report", JSON.stringify(kept)); } catch { /* a page from a file may have none */ }
  };

  function colour(method) {
    const known = data.colours[method] || "#888888";
    return known === "#222222" && dark() ? "#e4e7ec" : known;
  }
  function faint(hex, alpha) {
    const part = (i) => parseInt(hex.slice(i, i + 2), 16);
    return `rgba(${part(1)},${part(3)},${part(5)},${alpha})`;
  }

  const off = { tasks: new Set(kept.tasks), methods: new Set(kept.methods), seeds: new Set(kept.seeds) };
  const shown = (run) => !off.tasks.has(run.task) && !off.methods.has(run.method) && !off.seeds.has(run.seed);

  function boxes(id, values, mark) {
    for (const value of values) {
      const label = document.createElement("label"), box = document.createElement("input");
      box.type = "checkbox"; box.checked = !off[id].has(value); box.value = value;
      box.addEventListener("change", () => {
        box.checked ? off[id].delete(value) : off[id].add(value);
        keep(id, [...off[id]]); drawAll();
      });
      label.append(box);
      if (mark) {
        const swatch = document.createElement("span");
        swatch.className = "swatch"; swatch.dataset.method = value; label.append(swatch);
      }
      label.append(String(value)); $(id).append(label);
    }
  }
  function choices(id, values, words, redraw) {
    for (const value of values) $(id).append(new Option(words(value), value));
    if (values.includes(kept[id])) $(id).value = kept[id];
    $(id).addEventListener("change", () => { keep(id, $(id).value); redraw(); });
  }

  function table(place, columns, rows, caption, note) {
    const box = document.createElement("div"), grid = document.createElement("table");
    box.className = "scroll"; box.tabIndex = 0;
    if (caption) place.append(Object.assign(document.createElement("h3"), { textContent: caption }));
    const head = grid.createTHead().insertRow();
    for (const name of columns) head.append(Object.assign(document.createElement("th"), { textContent: name }));
    const body = grid.createTBody();
    for (const row of rows) { const line = body.insertRow(); for (const cell of row) Object.assign(line.insertCell(), { textContent: cell, className: String(cell).length > 32 ? "long" : "" }); }
    box.append(grid); place.append(box);
    if (note) place.append(Object.assign(document.createElement("p"), { className: "note", textContent: note }));
  }

  function layout(title, x, y, more = {}) {
    const style = getComputedStyle(document.documentElement), value = (name) => style.getPropertyValue(name).trim();
    const axis = { gridcolor: value("--line"), zerolinecolor: value("--line"), automargin: true };
    return {
      title: { text: `${title}<br><sub>${[y, x].filter(Boolean).join(", by ")}</sub>`, font: { size: 14 }, x: 0.02, xanchor: "left" }, font: { color: value("--text"), size: 12 },
      paper_bgcolor: value("--back"), plot_bgcolor: value("--back"), margin: { l: 40, r: 12, t: 64, b: 36 },
      xaxis: { ...axis }, yaxis: { ...axis }, showlegend: false, hovermode: "closest", ...more,
    };
  }
  const OPTIONS = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
  // Drawn once all boxes of a section are there: only then is it known how wide each is.
  const waiting = [];
  function chart(place, traces, form) {
    const card = document.createElement("div"), box = document.createElement("div");
    card.className = "card"; box.className = "chart"; card.append(box, keys(box, traces)); place.append(card); waiting.push([box, traces, form]);
  }
  // What the colours are, below the chart: long names would leave a legend inside of it no room for curves.
  function keys(box, traces) {
    const list = document.createElement("div");
    list.className = "keys";
    const group = (trace) => trace.legendgroup || trace.name;
    for (const trace of traces.filter((t) => t.name && t.showlegend !== false)) {
      const key = document.createElement("button"), swatch = document.createElement("span");
      Object.assign(key, { type: "button", title: "show or hide" }); key.setAttribute("aria-pressed", "true");
      swatch.className = "swatch"; swatch.style.background = (trace.line || trace.marker).color;
      key.append(swatch, trace.name); list.append(key);
      key.addEventListener("click", () => {
        const on = key.getAttribute("aria-pressed") !== "true", mine = traces.flatMap((t, i) => (group(t) === group(trace) ? [i] : []));
        key.setAttribute("aria-pressed", String(on)); Plotly.restyle(box, { visible: on }, mine);
      });
    }
    return list;
  }
  function draw() { for (const [box, traces, form] of waiting.splice(0)) Plotly.newPlot(box, traces, form, OPTIONS); }
  function clear(place) {
    for (const box of place.querySelectorAll(".chart")) Plotly.purge(box);
    place.replaceChildren();
  }
  const xName = () => $("axis").selectedOptions[0].text;

  function curves() {
    clear($("curves"));
    const team = $("team").value, metric = $("metric").value, axis = $("axis").value;
    for (const task of unique(data.runs.filter(shown).map((run) => run.task))) {
      const traces = [];
      for (const method of unique(data.runs.filter((run) => run.task === task && shown(run)).map((run) => run.method))) {
        const all = data.runs.filter((run) => run.task === task && run.method === method), some = all.filter(shown);
        const band = data.bands.find((b) => b.task === task && b.method === method && b.team === team && b.metric === metric && b.axis === axis);
        const whole = band && some.length === all.length, hue = colour(method), group = { legendgroup: method };
        if (whole && band.low) {
          traces.push({ ...group, x: band.x, y: band.low, mode: "lines", line: { width: 0 }, hoverinfo: "skip", showlegend: false });
          traces.push({ ...group, x: band.x, y: band.high, mode: "lines", line: { width: 0 }, fill: "tonexty", fillcolor: faint(hue, 0.16), hoverinfo: "skip", showlegend: false });
        }
        let told = whole;
        for (const run of some) {
          const y = run.tests[run.keys[`${team}/${metric}`]];
          if (!y) continue;
          traces.push({ ...group, x: run.tests[axis], y, mode: "lines", line: { width: whole ? 0.8 : 1.4, color: faint(hue, whole ? 0.5 : 0.9) }, name: whole ? `seed ${run.seed}` : `${method} (seeds alone)`, showlegend: !told, hovertemplate: `seed ${run.seed}: %{y}<extra>${method}</extra>` });
          told = true;
        }
        if (whole) traces.push({ ...group, x: band.x, y: band.mean, mode: band.x.length > 1 ? "lines" : "markers", line: { width: 2.6, color: hue }, marker: { color: hue }, name: `${method} (${band.seeds})` });
      }
      if (traces.length) chart($("curves"), traces, layout(task, xName(), METRICS[metric]));
    }
    draw();
    if (!$("curves").children.length) $("curves").append(Object.assign(document.createElement("p"), { className: "note", textContent: "No tests of the runs that are chosen." }));
  }

  function losses() {
    clear($("losses"));
    const key = $("training").value, axis = $("axis").value;
    for (const task of unique(data.runs.filter(shown).map((run) => run.task))) {
      const seen = new Set(), traces = [];
      for (const run of data.runs.filter((r) => r.task === task && shown(r) && r.training[key])) {
        traces.push({ x: run.training[axis], y: run.training[key], mode: "lines", line: { width: 1.2, color: colour(run.method) }, name: run.method, legendgroup: run.method, showlegend: !seen.has(run.method), hovertemplate: `seed ${run.seed}: %{y}<extra>${run.method}</extra>` });
        seen.add(run.method);
      }
      if (traces.length) chart($("losses"), traces, layout(task, xName(), key));
    }
    draw();
  }

  function evolved() { return data.runs.filter((run) => run.population && shown(run)); }
  function runList() {
    const list = evolved(), before = kept.run;
    $("run").replaceChildren(...list.map((run) => new Option(label(run), run.name)));
    if (list.some((run) => run.name === before)) $("run").value = before;
  }
  const HIDDEN = { showlegend: false, hoverinfo: "skip" };
  function evolution() {
    clear($("evolution"));
    const run = evolved().find((r) => r.name === $("run").value), place = $("evolution");
    $("no-evolution").textContent = run ? (run.teams ? "" : "Archives keep no lineage: of this run there are rates alone.") : "No run with a population is chosen.";
    $("of-distances").hidden = true;
    if (!run) return;
    if (run.teams) {
      const { generation, fitness, kind } = run.teams;
      const traces = data.kinds.map((name, k) => {
        const x = [], y = [];
        fitness.forEach((row, g) => row.forEach((value, p) => { if (kind[g][p] === k) { x.push(generation[g]); y.push(value); } }));
        return { x, y, mode: "markers", type: "scatter", marker: { size: 4, color: KIND_COLOURS[k] }, name };
      }).filter((trace) => trace.x.length);
      chart(place, traces, layout("Fitness of every team, by how it came about", "generation", "training return"));
      const a = run.ancestry, at = new Map(a.id.map((id, i) => [id, i])), edges = data.kinds.map(() => ({ x: [], y: [] }));
      a.id.forEach((_, i) => a.parents[i].forEach((parent) => {
        const j = at.get(parent);
        if (j !== undefined) { edges[a.kind[i]].x.push(a.generation[j], a.generation[i], null); edges[a.kind[i]].y.push(a.fitness[j], a.fitness[i], null); }
      }));
      const tree = edges.map((e, k) => ({ ...e, ...HIDDEN, mode: "lines", line: { width: 1, color: faint(KIND_COLOURS[k], 0.7) }, legendgroup: data.kinds[k] })).filter((e) => e.x.length);
      data.kinds.forEach((name, k) => {
        const some = a.id.map((_, i) => i).filter((i) => a.kind[i] === k);
        if (some.length) tree.push({ x: some.map((i) => a.generation[i]), y: some.map((i) => a.fitness[i]), text: some.map((i) => `team ${a.id[i]}, from ${a.parents[i].join(", ") || "nobody"}`), mode: "markers", marker: { size: 7, color: KIND_COLOURS[k] }, name, legendgroup: name, hovertemplate: "%{text}<br>generation %{x}, fitness %{y}<extra></extra>" });
      });
      chart(place, tree, layout(`Where the last teams come from${a.cut[0] ? " (the newest part)" : ""}`, "generation of birth", "fitness when first measured"));
      const won = data.kinds.map((name, k) => [name, run.winners[k], KIND_COLOURS[k]]).filter((w) => w[1]);
      chart(place, [{ type: "bar", x: won.map((w) => w[0].replace(" and ", "<br>and ")), y: won.map((w) => w[1]), marker: { color: won.map((w) => w[2]) } }], layout("Teams that were the fittest of a generation", "", "teams"));
    }
    distances(run.distances, place);
    const lines = (title, keys) => {
      const traces = keys.filter(([key]) => run.training[key]).map(([key, name, hue]) => ({ x: run.training[$("axis").value], y: run.training[key], mode: "lines", name, line: { color: hue, width: 2 } }));
      if (traces.length) chart(place, traces, layout(title, xName(), "share, over the run so far", { yaxis: { range: [0, 1], gridcolor: "rgba(128,128,128,.25)", automargin: true } }));
    };
    lines("What became of injected MARL teams", [["injection/elite_rate", "elite", "#d62728"], ["injection/parent_rate", "parent", "#e08a1e"], ["injection/discarded_rate", "discarded", "#8b93a1"]]);
    lines("Children better than their better parent", [["operators/crossover_better_rate", "crossover", KIND_COLOURS[2]], ["operators/mutation_better_rate", "mutation", KIND_COLOURS[3]], ["operators/crossover_and_mutation_better_rate", "both", KIND_COLOURS[4]]]);
    draw();
  }

  function distances(found, place) {
    if (!found) return;
    $("of-distances").hidden = false;
    const { teams, matrix, steps, mean, to_marl } = found, names = teams.map((name) => name.replace(" (elite)", "*")), many = teams.length > 12;
    chart(place, [{ type: "heatmap", x: names, y: names, z: matrix, zmin: 0, zmax: 1.5, colorscale: "Viridis", text: teams.map((a) => teams.map((b) => `${a}, ${b}`)), texttemplate: many ? "" : "%{z:.2f}", hovertemplate: "%{text}<br>distance %{z}<extra></extra>", colorbar: { thickness: 10, outlinewidth: 0 } }],
      layout(`Distances between teams at step ${steps[steps.length - 1].toLocaleString("en")} (*: elite)`, "", "by weights", { xaxis: { type: "category", tickangle: -40, automargin: true }, yaxis: { type: "category", autorange: "reversed", automargin: true } }));
    if (steps.length > 1) {
      const traces = [[mean, "mean over pairs of teams", KIND_COLOURS[2]], [to_marl, "MARL team to elite", KIND_COLOURS[5]]].filter(([y]) => y.some((value) => value !== null));
      chart(place, traces.map(([y, name, hue]) => ({ x: steps, y, name, mode: "lines+markers", line: { color: hue } })), layout("Distances in the checkpoints that were kept", "environment steps", "distance", { yaxis: { rangemode: "tozero", gridcolor: "rgba(128,128,128,.25)", automargin: true } }));
    }
  }

  const label = (run) => `${run.task}, ${run.method}, seed ${run.seed}`;
  let fought = null; // the battle that is shown
  function battleList() {
    const list = data.runs.filter((run) => run.battle && shown(run)), before = kept.battle;
    $("battle").replaceChildren(...list.map((run) => new Option(label(run), run.name)));
    if (list.some((run) => run.name === before)) $("battle").value = before;
  }
  async function battle() {
    const run = data.runs.find((r) => r.battle && shown(r) && r.name === $("battle").value);
    if (fought && fought.name === (run && run.name)) { if (fought.player) fought.player.paint(); return; }
    if (fought && fought.player) fought.player.stop();
    $("fought").replaceChildren();
    const mine = fought = run ? { name: run.name, player: null } : null;
    if (!run) { $("fought").append(Object.assign(document.createElement("p"), { className: "note", textContent: "No battle of the runs that are chosen." })); return; }
    const box = document.createElement("div"), player = await battlePlayer.show(box, run.battle.packed, run.battle.who);
    if (fought !== mine) return; // another was chosen meanwhile
    $("fought").append(box); mine.player = player; player.paint();
  }

  const films = new Map(); // kept when filters change, so that they play on
  function film(run) {
    if (!films.has(run.name)) {
      const figure = document.createElement("figure"), video = document.createElement("video"), words = document.createElement("figcaption");
      const bytes = Uint8Array.from(atob(run.video.data), (c) => c.charCodeAt(0));
      Object.assign(video, { controls: true, muted: true, loop: true, preload: "metadata", src: URL.createObjectURL(new Blob([bytes], { type: "video/mp4" })) });
      video.setAttribute("playsinline", "");
      words.textContent = `${label(run)}: ${run.video.told}`; figure.append(video, words); films.set(run.name, figure);
    }
    return films.get(run.name);
  }
  function videos() { $("videos").replaceChildren(...data.runs.filter((run) => run.video && shown(run)).map(film)); }

  function drawAll() {
    document.querySelectorAll("#methods .swatch").forEach((s) => { s.style.background = colour(s.dataset.method); });
    curves(); losses(); runList(); evolution(); battleList(); battle(); videos();
    document.body.dataset.drawn = String(Number(document.body.dataset.drawn || 0) + 1);
  }

  function theme(name) { document.documentElement.dataset.theme = name; }
  theme(kept.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
  $("theme").addEventListener("click", () => { theme(dark() ? "light" : "dark"); keep("theme", dark() ? "dark" : "light"); drawAll(); });

  async function library() {
    const packed = Uint8Array.from(atob($("plotly").textContent), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }
  function watch() {
    const known = document.body.dataset.watched;
    if (!known) return;
    let touched = 0; // when somebody last did something: what is being looked at is not taken away
    for (const kind of ["pointerdown", "keydown", "wheel"]) addEventListener(kind, () => { touched = Date.now(); }, { passive: true });
    const busy = () => Date.now() - touched < 8000 || (fought && fought.player && fought.player.playing()) || [...document.querySelectorAll("video")].some((v) => !v.paused);
    setInterval(async () => {
      if (busy()) return;
      try { const now = await (await fetch("fingerprint")).text(); if (now !== known) location.reload(); } catch { /* the server has gone */ }
    }, 3000);
  }

  boxes("tasks", unique(data.runs.map((run) => run.task)));
  boxes("methods", unique(data.runs.map((run) => run.method)), true);
  boxes("seeds", unique(data.runs.map((run) => run.seed)));
  choices("team", Object.keys(TEAMS), (t) => TEAMS[t], curves);
  choices("metric", Object.keys(METRICS).filter((m) => data.bands.some((b) => b.metric === m)), (m) => METRICS[m], curves);
  choices("axis", ["env_steps", "wall_time"].filter((a) => !$("axis").querySelector(`[value=${a}]`)), (a) => a, drawAll);
  if (kept.axis) $("axis").value = kept.axis;
  choices("training", unique(data.runs.flatMap((run) => Object.keys(run.training))).filter((k) => k.includes("/")).sort((a, b) => order(a) - order(b)), (k) => k, losses);
  $("run").addEventListener("change", () => { keep("run", $("run").value); evolution(); });
  $("battle").addEventListener("change", () => { keep("battle", $("battle").value); battle(); });
  $("battle-part").hidden = !data.runs.some((run) => run.battle);
  $("video-part").hidden = !data.runs.some((run) => run.video);
  addEventListener("resize", () => { if (fought && fought.player) fought.player.paint(); });
  for (const line of data.not_made) $("not-made").append(Object.assign(document.createElement("li"), { textContent: line }));
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  for (const line of data.remarks) $("remarks").append(Object.assign(document.createElement("li"), { textContent: line }));
  for (const t of data.tables) table($("tables"), t.columns, t.rows, t.title, t.note);
  $("legend").textContent = data.tables.length ? data.legend : "";
  table($("fates"), data.fates.columns, data.fates.rows);
  table($("settings"), data.settings.columns, data.settings.rows);
  table($("runs"), ["run", "task", "method", "seed", "steps", "of", "wall time", "algorithm version"],
    data.runs.map((r) => [r.name, r.task, r.method, r.seed, r.steps.toLocaleString("en"), r.asked.toLocaleString("en"), r.time, r.version]));
  library().then(drawAll, (error) => { $("curves").textContent = `This browser cannot unpack the drawing library: ${error}`; });
  watch();
})();
