// The plan of a cell, in metres, y up: bases of arms are dragged, and turned by the tip of their arrow.
"use strict";

function startLayout() {
  const cell = JSON.parse(document.getElementById("layout").textContent);
  const svg = document.getElementById("plan"), changes = document.getElementById("changes");
  const round = (value, digits) => Number(value.toFixed(digits));
  const far = (a, b) => Math.hypot(...a.map((value, i) => value - b[i]));

  function draw(parent, tag, attributes, text) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    if (text) made.textContent = text;
    return parent.appendChild(made);
  }

  const points = [...cell.fixtures.flat(), ...cell.places.map((each) => each.at), ...cell.arms.map((each) => each.base)];
  const [left, right] = [Math.min, Math.max].map((most) => most(...points.map((point) => point[0])));
  const [low, high] = [Math.min, Math.max].map((most) => most(...points.map((point) => point[1])));
  const room = 1, textPx = 11;
  svg.setAttribute("viewBox", [left - room, -high - room, right - left + 2 * room, high - low + 2 * room].join(" "));
  const text = textPx / svg.getScreenCTM().a;
  svg.style.fontSize = `${text}px`;
  for (const corners of cell.fixtures)
    draw(svg, "polygon", { class: "fixture", points: corners.map(([x, y]) => `${x},${-y}`).join(" ") });

  // An arm turned by some degrees about the vertical axis through its base.
  function turned(arm, [x, y]) {
    const angle = (arm.turn * Math.PI) / 180;
    return [x * Math.cos(angle) - y * Math.sin(angle), x * Math.sin(angle) + y * Math.cos(angle)];
  }
  const shoulder = (arm) => {
    const [x, y] = turned(arm, arm.shoulder);
    return [arm.base[0] + x, arm.base[1] + y, arm.base[2] + arm.shoulder[2]];
  };

  for (const arm of cell.arms) {
    Object.assign(arm, { turn: 0, first: [...arm.base] });
    arm.reach = ["down", "reach"].map((name) => draw(svg, "circle", { class: name, stroke: arm.colour, fill: arm.colour }));
  }
  for (const place of cell.places) {
    const [x, y] = [place.at[0], -place.at[1]];
    place.mark = draw(svg, "g", { class: "place", "data-place": place.name });
    const corners = [[-1, 0], [0, -1], [1, 0], [0, 1]].map(([a, b]) => `${x + a * text * 0.5},${y + b * text * 0.5}`);
    place.body = draw(place.mark, "polygon", { points: corners.join(" ") });
    place.label = draw(place.mark, "text", {});
    place.title = draw(place.mark, "title", {});
  }
  for (const arm of cell.arms) {
    arm.mark = draw(svg, "g", { class: "arm", tabindex: 0, "data-arm": arm.name, fill: arm.colour });
    arm.link = draw(arm.mark, "line", { stroke: arm.colour, "stroke-width": text * 0.5, "stroke-linecap": "round" });
    arm.arrow = draw(arm.mark, "line", { class: "arrow", "stroke-width": text * 0.15 });
    arm.body = draw(arm.mark, "rect", { width: 2 * text, height: 2 * text, rx: text * 0.3 });
    arm.tip = draw(arm.mark, "circle", { class: "tip", r: text * 0.45 });
    arm.label = draw(arm.mark, "text", { class: "name" });
    arm.title = draw(arm.mark, "title", {});
    const move = (at) => { arm.base = [round(at[0], 2), round(at[1], 2), arm.base[2]]; };
    drag(arm.body, move);
    drag(arm.tip, ([x, y]) => {
      const angle = Math.atan2(y - arm.base[1], x - arm.base[0]) - Math.atan2(arm.ahead[1], arm.ahead[0]);
      arm.turn = (((round((angle * 180) / Math.PI, 0) + 180) % 360) + 360) % 360 - 180;
    });
    arm.mark.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.01, 0], ArrowRight: [0.01, 0], ArrowDown: [0, -0.01], ArrowUp: [0, 0.01] }[event.key];
      if (!step) return;
      event.preventDefault();
      move([arm.base[0] + step[0], arm.base[1] + step[1]]);
      update();
    });
  }

  function drag(handle, moveTo) {
    handle.addEventListener("pointerdown", (event) => { handle.setPointerCapture(event.pointerId); event.preventDefault(); });
    handle.addEventListener("pointermove", (event) => {
      if (!handle.hasPointerCapture(event.pointerId)) return;
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
      moveTo([at.x, -at.y]);
      update();
    });
  }

  // Whether two boxes overlap, or have less than a gap between them from left to right.
  const gap = text * 0.2, near = 0.9 * gap;
  const overlap = (a, b) =>
    a.x < b.x + b.width + near && b.x < a.x + a.width + near && a.y < b.y + b.height && b.y < a.y + a.height;

  // Each label goes to a side of its mark where it covers neither a mark nor another label; without one it is left out.
  // Those in red come first, then those of arms.
  function placeLabels() {
    const marks = [...cell.arms, ...cell.places];
    const taken = [...marks.map((each) => each.body), ...cell.arms.map((arm) => arm.tip)].map((mark) => mark.getBBox());
    const isRed = ({ mark }) => mark.matches(".unable, .lacks");
    for (const { body, label } of [...marks.filter(isRed), ...marks.filter((each) => !isRed(each))]) {
      const mark = body.getBBox(), { y, width, height } = label.getBBox(), ascent = label.getAttribute("y") - y;
      const middle = [mark.x + (mark.width - width) / 2, mark.y + (mark.height - height) / 2];
      const sides = [
        [middle[0], mark.y + mark.height + gap], [mark.x + mark.width + gap, middle[1]],
        [mark.x - width - gap, middle[1]], [middle[0], mark.y - height - gap],
      ].map(([left, top]) => ({ x: left, y: top, width, height }));
      const free = sides.find((side) => !taken.some((other) => overlap(side, other)));
      label.style.visibility = free ? "visible" : "hidden";
      if (!free) continue;
      label.setAttribute("x", free.x);
      label.setAttribute("y", free.y + ascent);
      taken.push(free);
    }
  }

  const isMoved = (arm) => far(arm.base, arm.first) > 0;

  // Until an arm is moved, the remarks of the command hold; they cover more than reach.
  function update() {
    const checked = !cell.arms.some((arm) => isMoved(arm) || arm.turn);
    for (const arm of cell.arms) {
      const [x, y] = arm.base, [a, b] = shoulder(arm), [c, d] = turned(arm, arm.ahead), set = (mark, values) =>
        Object.entries(values).forEach(([name, value]) => mark.setAttribute(name, value));
      arm.reach.forEach((circle, i) => set(circle, { cx: a, cy: -b, r: arm.radii[i] }));
      set(arm.link, { x1: x, y1: -y, x2: a, y2: -b });
      set(arm.arrow, { x1: x, y1: -y, x2: x + c, y2: -y - d });
      set(arm.body, { x: x - text, y: -y - text });
      set(arm.tip, { cx: x + c, cy: -y - d });
      arm.mark.classList.toggle("unable", checked && arm.remark !== "");
      arm.title.textContent = arm.label.textContent = checked && arm.remark ? `${arm.name}: ${arm.remark}` : arm.name;
    }
    for (const place of cell.places) {
      const farther = cell.arms.map((arm) => far(shoulder(arm), place.at) - cell.reach_m), lacks = Math.min(...farther);
      const near = cell.arms.filter((arm, i) => farther[i] <= 0).map((arm) => arm.name);
      const remark = checked ? place.remark : lacks > 0 ? `lacks ${Math.max(lacks, 0.01).toFixed(2)} m` : "";
      const who = checked ? `${place.able.join(", ") || "no arm"} can work here` : `in reach of ${near.join(", ") || "no arm"}`;
      place.title.textContent = `${place.name}: ${who}`;
      place.mark.classList.toggle("lacks", remark !== "");
      place.label.textContent = remark ? `${place.name}: ${remark}` : place.name;
    }
    placeLabels();
    changes.value = cell.arms.flatMap((arm) => {
      const moved = isMoved(arm), tilt = [arm.tilt[0], arm.tilt[1], round(arm.tilt[2] + arm.turn, 6)];
      if (tilt[2] > 180) tilt[2] = round(tilt[2] - 360, 6);
      if (tilt[2] <= -180) tilt[2] = round(tilt[2] + 360, 6);
      return [
        ...(moved || arm.turn ? [`# ${JSON.stringify(arm.name)}`] : []),
        ...(moved ? [`position_m = [${arm.base.join(", ")}]`] : []), ...(arm.turn ? [`tilt_deg = [${tilt.join(", ")}]`] : []),
      ];
    }).join("\n");
  }
  update();
}
