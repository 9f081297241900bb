// Plays recorded shifts of one cell in step: their cells, a clock, and a cursor in the figure, all at one time of the shift.
"use strict";

// Difference-coded 16-bit values after a line of JSON, see `packed` of scenarios/show/page.py.
async function readPlayback(id) {
  const bytes = new Uint8Array(await unpack(id)), end = bytes.indexOf(10);
  const listed = JSON.parse(new TextDecoder().decode(bytes.subarray(0, end))), arrays = {};
  let at = end + 1;
  for (const { name, shape, scale, first_s, step_s } of listed) {
    const count = shape.reduce((a, b) => a * b, 1), moments = shape[shape.length - 1];
    const values = new Int16Array(bytes.slice(at, at + 2 * count).buffer);
    at += 2 * count;
    for (let row = 0; row < count; row += moments) for (let i = row + 1; i < row + moments; i++) values[i] += values[i - 1];
    arrays[name] = { values, scale, moments, first_s, step_s, rows: count / moments };
  }
  return arrays;
}

// Value of a row at a time, linear between moments.
function valueAt(array, row, timeS) {
  const x = Math.min(array.moments - 1, Math.max(0, (timeS - array.first_s) / array.step_s));
  const i = Math.min(array.moments - 2, Math.floor(x)), from = row * array.moments;
  if (array.moments < 2) return array.values[from] * array.scale;
  return (array.values[from + i] * (1 - x + i) + array.values[from + i + 1] * (x - i)) * array.scale;
}

// Value of a row at the last moment not after a time.
function stateAt(array, row, timeS) {
  const i = Math.min(array.moments - 1, Math.max(0, Math.floor((timeS - array.first_s) / array.step_s + 1e-6)));
  return array.values[row * array.moments + i] * array.scale;
}

// Plays the shifts; a figure that is drawn later gets its cursor by `attach`. `begin`: as `Playback.clock`, or null.
async function startReplay(unitS, begin) {
  const model = JSON.parse(document.getElementById("cell-model").textContent);
  const shifts = await Promise.all([...document.querySelectorAll(".replay .cell")].map(async (place, i) =>
    ({ place, now: place.nextElementSibling, data: await readPlayback(`playback-${i}`), cell: null, modes: null })));
  const first = shifts[0].data, joints = first.q.rows / model.arms.length, beginS = first.q.first_s;
  const endS = Math.max(...shifts.map(({ data: { q } }) => q.first_s + (q.moments - 1) * q.step_s));
  const play = document.getElementById("play"), slider = document.getElementById("time"), speed = document.getElementById("speed");
  const clock = document.getElementById("clock"), chooser = document.getElementById("arm");
  for (const shift of shifts) try {
    shift.cell = makeCell(shift.place, model);
  } catch (error) {
    shift.place.className = "cell absent";
    shift.place.textContent = "This browser cannot draw in 3-D (WebGL is missing). The figures below show the same shift.";
  }
  let timeS = beginS, playing = false, last = 0, lanes = null, cursors = [];
  slider.min = beginS;
  slider.max = endS;
  slider.step = "any";
  const radius = (kg) => Math.min(model.load.most_m, Math.cbrt((3 * kg) / (4 * Math.PI * model.load.kg_per_m3)));
  const day = begin && new Intl.DateTimeFormat("en-GB", { timeZone: begin.zone, weekday: "short", hour: "2-digit", minute: "2-digit", second: "2-digit" });
  const words = ["idle", "working", "faulted"];

  function show(t) {
    timeS = Math.min(endS, Math.max(beginS, t));
    slider.value = timeS;
    const s = Math.round(timeS), text = day ? day.format(begin.ms + 1000 * s) : `${Math.floor(s / 3600)}:${String(Math.floor(s / 60) % 60).padStart(2, "0")}:${String(s % 60).padStart(2, "0")}`;
    clock.textContent = text;
    slider.setAttribute("aria-valuetext", text);
    shifts.forEach(showShift);
    for (const move of cursors) move(timeS);
  }
  function showShift(shift) {
    const { data, cell, modes } = shift, lines = [];
    for (let arm = 0; arm < model.arms.length; arm++) {
      const q = [], temp = [];
      for (let j = 0; j < joints; j++) {
        q.push(valueAt(data.q, arm * joints + j, timeS));
        temp.push(valueAt(data.temp_c, arm * joints + j, timeS));
      }
      const mode = stateAt(data.mode, arm, timeS), hottest = temp.indexOf(Math.max(...temp));
      if (cell) {
        if (!modes || modes[arm] !== mode) cell.setMode(arm, mode);
        cell.setHeat(arm, temp);
        cell.setPose(arm, q, radius(stateAt(data.payload_kg, arm, timeS)));
      }
      lines.push({ arm, mode, hottest: hottest + 1, tempC: temp[hottest] });
    }
    shift.modes = lines.map((line) => line.mode);
    shift.now.textContent = lines.sort((a, b) => b.tempC - a.tempC).slice(0, 8).map(({ arm, mode, hottest, tempC }) =>
      words[mode] === undefined ? `${model.arms[arm].name}: absent` : `${model.arms[arm].name}: ${words[mode]}, joint ${hottest} at ${tempC.toFixed(1)} °C`
      + (tempC >= model.heat.error_c ? " (above the limit)" : tempC >= model.heat.warning_c ? " (warm)" : "")).join("\n");
  }
  function frame(ms) {
    if (playing) {
      show(timeS + (Math.min(0.25, (ms - last) / 1000)) * Number(speed.value));
      if (timeS >= endS) toggle();
    }
    last = ms;
    for (const { cell } of shifts) if (cell) cell.draw();
    requestAnimationFrame(frame);
  }
  function toggle() {
    playing = !playing;
    if (playing && timeS >= endS) show(beginS);
    play.textContent = playing ? "❚❚" : "▶";
    play.setAttribute("aria-label", playing ? "pause" : "play");
  }
  // A vertical line over a whole figure; a click in the figure moves it.
  function addCursor(element) {
    const line = document.createElement("div");
    line.className = "cursor";
    element.append(line);
    element.addEventListener("click", (event) => {
      const layout = element._fullLayout;
      const x = layout.xaxis.p2l(event.clientX - element.getBoundingClientRect().left - layout._size.l);
      if (event.target.closest(".draglayer") && x >= 0) show(x * unitS);
    }, true);
    element.on("plotly_afterplot", () => show(timeS));
    return (t) => {
      const { xaxis, _size } = element._fullLayout, px = xaxis.l2p(t / unitS);
      line.hidden = px < 0 || px > xaxis._length;
      Object.assign(line.style, { transform: `translateX(${_size.l + px}px)`, top: `${_size.t}px`, height: `${_size.h}px` });
    };
  }
  // Looks at one arm, and shows its temperatures in the last lane of a large fleet; -1: the whole cell.
  function choose(arm) {
    chooser.value = arm;
    for (const { cell } of shifts) if (cell) cell.focus(arm);
    if (!lanes || arm < 0) return;
    const lane = lanes.layout.meta;
    const { moments, first_s, step_s, values, scale } = first.temp_c, xs = Array.from({ length: moments }, (_, i) => (first_s + i * step_s) / unitS);
    const ys = Array.from({ length: joints }, (_, j) => xs.map((_, i) => values[(arm * joints + j) * moments + i] * scale));
    Plotly.restyle(lanes, { x: ys.map(() => xs), y: ys }, lane.lane_traces);
    const name = document.createElement("b");
    name.textContent = model.arms[arm].name;
    Plotly.relayout(lanes, { [`annotations[${lane.lane_title}].text`]: name.outerHTML });
  }
  model.arms.forEach((arm, i) => chooser.append(new Option(arm.name, i)));
  chooser.addEventListener("change", () => choose(Number(chooser.value)));
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => show(Number(slider.value)));
  // An element with a moment goes there, by click or Enter.
  function goTo(event) {
    const row = event.target.closest("[data-time]");
    if (!row || (event.type === "keydown" && event.key !== "Enter")) return;
    const arm = model.arms.findIndex((one) => one.name === row.dataset.arm);
    show(Number(row.dataset.time));
    if (arm >= 0) choose(arm);
    shifts[0].place.scrollIntoView({ block: "center" });
  }
  for (const one of document.querySelectorAll("[data-time]")) one.tabIndex = 0;
  document.addEventListener("click", goTo);
  document.addEventListener("keydown", goTo);
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("input, select, button, canvas, a, summary")) return;
    if (event.key === " ") toggle();
    else if (event.key === "ArrowRight") show(timeS + 10);
    else if (event.key === "ArrowLeft") show(timeS - 10);
    else return;
    event.preventDefault();
  });
  // Figures over the time of the shift: a cursor in each, and a zoom of one zooms all.
  function attach(figures) {
    lanes = figures.find((one) => one.layout.meta);
    let zooming = false;
    for (const figure of figures) {
      figure.on("plotly_click", (event) => {
        if (event.points[0].data.type === "heatmap") choose(event.points[0].y);
      });
      figure.on("plotly_relayout", async (change) => {
        if (zooming || !Object.keys(change).some((key) => key.startsWith("xaxis."))) return;
        zooming = true;
        for (const other of figures) if (other !== figure) await Plotly.relayout(other, { "xaxis.range": [...figure.layout.xaxis.range] });
        zooming = false;
      });
    }
    cursors = figures.map(addCursor);
    if (chooser.value >= 0) choose(Number(chooser.value));
    for (const move of cursors) move(timeS);
  }
  show(timeS);
  requestAnimationFrame(frame);
  window.replay = { show, time: () => timeS };
  performance.mark("playable");
  return { attach };
}
