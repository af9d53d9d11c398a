"use strict";
// A battle that one can step through: draws its numbers (race/viewing/report/battles.py) on a canvas.
window.battlePlayer = (() => {
  const STEP_SECONDS = 0.5, TURN = 2 * Math.PI;
  const unpack = async (text) => {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return JSON.parse(await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).text());
  };
  const healthColour = (share) => `hsl(${Math.round(120 * share)} 75% 45%)`;

  // Draws moment `at`, which may lie between two steps: units walk from one place to the next.
  function draw(canvas, battle, at) {
    const style = getComputedStyle(canvas), value = (name) => style.getPropertyValue(name).trim();
    const [left, bottom, right, top] = battle.window, wide = right - left, high = top - bottom;
    const room = canvas.clientWidth, tall = Math.min(room * high / wide, 0.75 * window.innerHeight, 620);
    const sharp = window.devicePixelRatio || 1, scale = Math.min(room / wide, tall / high);
    canvas.style.height = `${tall}px`;
    if (canvas.width !== Math.round(room * sharp) || canvas.height !== Math.round(tall * sharp)) {
      canvas.width = Math.round(room * sharp); canvas.height = Math.round(tall * sharp);
    }
    const pen = canvas.getContext("2d"), shift = (room - scale * wide) / 2;
    const px = (x) => shift + (x - left) * scale, py = (y) => (top - y) * scale;
    pen.setTransform(sharp, 0, 0, sharp, 0, 0);
    pen.fillStyle = value("--pit"); pen.fillRect(0, 0, room, tall);
    battle.ground.forEach((row, r) => [...row].forEach((cell, c) => {
      if (cell === "#") return;
      pen.fillStyle = value(cell === "^" ? "--cliff" : "--floor");
      pen.fillRect(px(Math.floor(left) + c), py(Math.ceil(top) - r), scale + 0.5, scale + 0.5);
    }));
    const step = Math.floor(at), share = at - step, next = Math.min(step + 1, battle.x.length - 1);
    const place = (k) => [battle.x, battle.y].map((column) => (column[step][k] * (1 - share) + column[next][k] * share) / 100);
    const health = battle.health[step], told = share > 0 ? next : step;
    const radius = (k) => Math.max(battle.radii[k] * scale, 4);
    // Whom each struck or healed on the way to the moment that is told of.
    battle.targets[told].forEach((target, k) => {
      if (target < 0) return;
      const [x, y] = place(k), [tx, ty] = place(target), friends = (k < battle.agents) === (target < battle.agents);
      pen.strokeStyle = friends ? value("--heals") : battle.colours[k]; pen.globalAlpha = 0.75; pen.lineWidth = friends ? 3 : 1.6;
      pen.beginPath(); pen.moveTo(px(x), py(y)); pen.lineTo(px(tx), py(ty)); pen.stroke();
      pen.globalAlpha = 1;
    });
    health.forEach((left, k) => {
      const [x, y] = place(k), size = radius(k), cx = px(x), cy = py(y);
      pen.lineWidth = 2;
      if (!left) {
        pen.globalAlpha = 0.45; pen.strokeStyle = battle.colours[k]; pen.beginPath();
        for (const [dx, dy] of [[1, 1], [1, -1]]) { pen.moveTo(cx - dx * size / 2, cy - dy * size / 2); pen.lineTo(cx + dx * size / 2, cy + dy * size / 2); }
        pen.stroke(); pen.globalAlpha = 1;
        return;
      }
      pen.fillStyle = battle.colours[k]; pen.beginPath(); pen.arc(cx, cy, size, 0, TURN); pen.fill();
      const ring = (part, width, colour) => {
        pen.lineWidth = 2.5; pen.strokeStyle = colour; pen.beginPath();
        pen.arc(cx, cy, size + width, -TURN / 4, -TURN / 4 + TURN * part); pen.stroke();
      };
      ring(left / 100, 1.5, healthColour(left / 100));
      if (battle.shield && battle.shield[step][k]) ring(battle.shield[step][k] / 100, 4.5, value("--shield"));
      if (size > 5.5) {
        pen.fillStyle = "#ffffff"; pen.textAlign = "center"; pen.textBaseline = "middle";
        pen.font = `600 ${Math.round(Math.min(size, 13))}px system-ui, sans-serif`;
        pen.fillText(battle.labels[k], cx, cy + 0.5);
      }
    });
  }

  // Builds the player of a packed battle in a place; returns what redraws it and what stops it.
  async function show(box, packed, who) {
    const battle = await unpack(packed), last = battle.x.length - 1;
    const make = (tag, more) => Object.assign(document.createElement(tag), more);
    const canvas = make("canvas", { tabIndex: 0 });
    const play = make("button", { type: "button" }), words = make("output", {});
    const slider = make("input", { type: "range", min: 0, max: last, step: 1, value: 0 });
    const speed = make("select", {}), bar = make("div", { className: "player" });
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `battle on ${battle.map}, by the ${who}`);
    slider.setAttribute("aria-label", "step"); speed.setAttribute("aria-label", "speed");
    for (const times of [0.5, 1, 2, 4]) speed.append(new Option(`${times} x`, times, times === 1, times === 1));
    let at = 0, before = null;
    const alive = (from, to) => battle.health[Math.floor(at)].slice(from, to).filter(Boolean).length;
    function paint() {
      const step = Math.floor(at), n = battle.agents, all = battle.names.length;
      draw(canvas, battle, at);
      slider.value = step; play.textContent = before === null ? "▶ play" : "❚❚ pause";
      words.textContent = `step ${step} of ${last}, ${(step * STEP_SECONDS).toFixed(1)} s: return ${battle.returns[step].toFixed(2)}, agents ${alive(0, n)}/${n}, enemies ${alive(n, all)}/${all - n}` + (step === last && battle.verdict ? `: ${battle.verdict === "time" ? "time is up" : battle.verdict}` : "");
      box.dataset.step = step;
    }
    function go(step) { at = Math.min(Math.max(step, 0), last); paint(); }
    function stop() { before = null; }
    function tick(now) {
      if (before === null) return;
      if (!box.isConnected) { stop(); return; }
      at += (now - before) / 1000 / STEP_SECONDS * Number(speed.value); before = now;
      if (at >= last) stop();
      go(at);
      if (before !== null) requestAnimationFrame(tick);
    }
    function toggle() {
      if (before !== null) { stop(); go(Math.floor(at)); return; }
      if (at >= last) at = 0;
      before = performance.now(); paint(); requestAnimationFrame(tick);
    }
    play.addEventListener("click", toggle);
    slider.addEventListener("input", () => { stop(); go(Number(slider.value)); });
    const keys = { ArrowRight: () => Math.floor(at) + 1, ArrowLeft: () => Math.ceil(at) - 1, Home: () => 0, End: () => last };
    for (const part of [canvas, slider]) part.addEventListener("keydown", (event) => {
      if (event.key === " ") toggle();
      else if (keys[event.key]) { const to = keys[event.key](); stop(); go(to); }
      else return;
      event.preventDefault();
    });
    bar.append(play, slider, speed);
    box.replaceChildren(canvas, bar, words);
    paint();
    return { paint, stop, playing: () => before !== null };
  }
  return { show };
})();
