// The live page: the fleet as its messages show it.
"use strict";

const FRESH_S = 3, DRAW_MS = 60, TABLES_MS = 500, POLL_MS = 2000, MOST_JOBS = 300, MOST_ROWS = 60, MOST_NOTES = 300, MOST_AWARDS = 20, MOST_ALARMS = 20;
const MODES = { idle: "○ idle", working: "▶ working", faulted: "✖ faulted" };
const STATES = {
  waiting: "… waiting", awarded: "▶ awarded", finishing: "▶ finishing", finished: "✔ finished", unfinished: "? unfinished",
  given_up: "✖ given up", cancelled: "⊘ cancelled",
};

function startPage() {
  const gateway = makeGateway();
  const fleet = { role: "monitor", cell: null, name: "", paused: {}, speed: null, timeS: null, timeAtMs: 0, left: 0, arms: new Map(), jobs: new Map(), auctioneers: [], counts: {}, refresh: poll, now: fleetTime };
  const actions = makeActions(gateway, fleet);
  const offers = new Map(), awards = [], noted = new Set();
  const counted = { updates: 0, states: 0 };
  let view = null, index = new Map(), heat = null, changed = new Set(), modelText = "", lastDraw = 0, lastTables = 0, looked = "", connected = false, dirty = true;

  const byName = (a, b) => a.name.localeCompare(b.name, "en", { numeric: true });
  const armOf = (name) => {
    if (!fleet.arms.has(name)) fleet.arms.set(name, { name, token: false, state: null, atMs: -Infinity, difficultyMs: null });
    return fleet.arms.get(name);
  };
  const ageOf = (arm) => arm.state ? (performance.now() - arm.atMs) / 1000 : null;
  const isPresent = (arm) => arm.token && arm.state !== null && ageOf(arm) <= FRESH_S;
  function fleetTime() {
    return fleet.timeS === null ? 0 : fleet.timeS + (fleet.speed || 0) * (performance.now() - fleet.timeAtMs) / 1000;
  }

  // Messages

  // A sentence of the journal, the latest first; without a time it is of now.
  function note(key, timeS, what, kind) {
    if (noted.has(key)) return;
    noted.add(key);
    if (noted.size > 4 * MOST_NOTES) noted.delete(noted.values().next().value);
    const atS = timeS ?? fleetTime();
    const row = make("tr", kind ? { class: kind } : {}, ...[clock(atS), `${what.replace(/\.$/, "")}.`].map((text) => make("td", {}, visible(text))));
    row.dataset.timeS = atS;
    const body = element("journal").tBodies[0];
    body.insertBefore(row, [...body.rows].find((other) => Number(other.dataset.timeS) <= atS) || null);
    if (body.rows.length > MOST_NOTES) body.lastElementChild.remove();
  }

  // What an arm reports, as a sentence; "" for what the result of the job says.
  function eventText(arm, { kind, job, joint, value, reason }) {
    const because = reason ? `: ${reason}` : "", during = job ? ` during ${job}` : "";
    switch (kind) {
      case "award": case "finish": return "";
      case "home": return `${arm} is at home${job ? ` after ${job}` : ""}`;
      case "warning": return `${arm} became warm${during}${because}`;
      case "torque_warning": return `The torque of ${arm}, joint ${joint}, is above its warning limit${during}${because}`;
      case "fault": return `${arm} stopped by a fault${during}${because}`;
      case "recover": return `${arm} recovered${because}`;
      case "return": return `${arm} returned ${job}${because}`;
      case "moved": return `A person moved ${arm} home${because}`;
      case "break": return `${arm} has a break${reason ? ` (${reason})` : ""} of ${Math.round(value / 60)} min`;
      case "break_end": return `The break of ${arm} ended`;
      default: return `${arm}: ${kind.replace("_", " ")}${during}${because}`;
    }
  }

  // A change of a job, as a sentence; "" for the begin of its last cycle.
  function resultText({ status: { job, state, arm, reason, accepted_s: acceptedS, finished_s: finishedS, due_s: dueS }, by, time_s: timeS }) {
    const because = reason ? `: ${reason}` : "", person = by ? ` by ${by}` : "";
    const lateS = finishedS != null && dueS != null ? finishedS - dueS : 0;
    switch (state) {
      case "finishing": return "";
      case "waiting": return acceptedS === timeS ? `${job} was submitted${person}` : `${job} waits again${because}`;
      case "awarded": return `${job} was awarded to ${arm}`;
      case "finished": return by ? `${job} is finished, as ${by} stated` : `${arm} finished ${job}${lateS > 0 ? `, ${clock(lateS)} late` : ""}`;
      case "unfinished": return `${job} is unfinished${because}`;
      default: return `${job} was ${state.replace("_", " ")}${person}${because}`;
    }
  }

  function setJob(status, result) {
    const before = fleet.jobs.get(status.job);
    fleet.jobs.set(status.job, status);
    if (fleet.jobs.size > 8 * MOST_JOBS) fleet.jobs.delete(fleet.jobs.keys().next().value);
    if (status.state === "awarded" && status.arm && (!before || before.arm !== status.arm || before.state !== "awarded")) {
      const all = new Map(offers.get(status.job));
      for (const { arm, plan } of (result && result.offers) || [])
        if (plan) all.set(arm, { peak: plan.peak_c, p: plan.p_saturation, d: plan.difficulty });
      if (result && result.peak_c !== undefined) all.set(status.arm, { peak: result.peak_c, p: result.p_saturation, d: result.difficulty });
      if (all.size || result) {
        awards.unshift({ key: `${status.job}/${status.award}/${status.arm}`, job: status.job, arm: status.arm, offers: all });
        awards.splice(MOST_AWARDS);
      }
    }
  }

  function offer(job, arm, score) {
    if (!offers.has(job)) offers.set(job, new Map());
    offers.get(job).set(arm, score);
    if (offers.size > MOST_JOBS) offers.delete(offers.keys().next().value);
  }

  function describe({ action, job, arm, outcome, due_s: due, value }) {
    const whom = arm === undefined || arm === "*" ? "all arms" : arm;
    switch (action) {
      case "pause": case "resume": return `asked to ${action} ${whom}`;
      case "settle": return `settled ${job} as ${outcome}`;
      case "clear": return `freed the space of ${whom}`;
      case "change": return `changed ${job}:${due === undefined ? "" : due === null ? " no due date" : ` due at ${clock(due)}`}${value === undefined ? "" : ` value ${value}`}`;
      default: return `asked to ${action} ${job}`;
    }
  }

  const apply = {
    state(name, state) {
      const arm = armOf(name);
      if (arm.state && arm.state.mode !== state.mode) arm.changed = true;
      arm.state = state;
      arm.atMs = performance.now();
      changed.add(name);
      counted.states++;
    },
    difficulty(name, scores) {
      armOf(name).difficultyMs = performance.now();
      for (const [job, of] of offers) if (!scores.jobs.includes(job)) of.delete(name);
      scores.jobs.forEach((job, i) => offer(job, name, { peak: (scores.peak_c || [])[i], p: scores.p_saturation[i], d: scores.difficulty[i] }));
    },
    bid(name, bid) {
      for (const { job, plans } of bid.estimates) {
        const best = (plans || []).reduce((a, b) => !a || (b.difficulty ?? Infinity) < (a.difficulty ?? Infinity) ? b : a, null);
        if (best) offer(job, name, { peak: best.peak_c, p: best.p_saturation, d: best.difficulty });
      }
    },
    event(name, event) {
      const what = eventText(name, event);
      if (what) note(`event/${name}/${event.number}`, event.time_s, what, ["fault", "contact", "warning"].includes(event.kind) ? event.kind : "");
    },
    result(name, result) {
      const what = resultText(result), before = fleet.jobs.get(result.status.job);
      if (before) fleet.counts[before.state] -= 1; // the counts of the last poll follow the table until the next one
      fleet.counts[result.status.state] = (fleet.counts[result.status.state] || 0) + 1;
      setJob(result.status, result);
      if (what) note(`result/${name}/${result.number}/${result.time_s}`, result.time_s, what);
    },
    operation(name, { time_s: timeS, request, note: why }) {
      note(`operation/${request.request}`, timeS, `${request.by || "Nobody named"} ${describe(request.action)}${why ? ` (${why})` : ""}`, "operation");
    },
    presence(_, { role, name, there }) {
      if (role === "arm") {
        const arm = armOf(name);
        if (arm.token !== there) note(`presence/${name}/${performance.now()}`, null, `${name} ${there ? "joined" : "left"}`);
        arm.token = there;
        changed.add(name);
      } else if (there && connected) setTimeout(() => load().catch(() => {}), POLL_MS); // it needs a moment
    },
    gap: () => note(`gap/${performance.now()}`, null, "The gateway missed some events"),
  };
  function onMessage(topic, data) {
    if (apply[topic]) apply[topic](data.name, data.message);
    dirty = true;
  }

  // Requests

  async function load() {
    fleet.role = (await gateway.request("/")).role;
    await poll();
    let missing = "";
    try {
      fleet.cell = await gateway.request("/v4/cell");
      actions.offer(fleet.cell);
    } catch (error) {
      missing = `The form needs a description of the cell. ${error.message}`;
    }
    element("no-cell").hidden = !missing;
    setText(element("no-cell"), missing);
    try {
      await draw(await gateway.request("/v4/scene"));
    } catch (error) {
      if (!view) setText(element("cell"), `The cell cannot be drawn. ${error.message}`);
    }
  }

  async function draw(model) {
    const text = JSON.stringify(model);
    if (text === modelText) return;
    if (view) location.reload(); // another cell
    modelText = text;
    index = new Map(model.arms.map((arm, i) => [arm.name, i]));
    heat = model.heat;
    element("cell").textContent = "";
    try {
      view = makeCell(element("cell"), { ...model, arms: model.arms.map((arm) => ({ ...arm, name: visible(arm.name) })) });
    } catch {
      setText(element("cell"), "This browser cannot draw in 3-D (WebGL is missing). The tables show the same fleet.");
    }
    setText(element("scale"), `Motors: small and light green below ${heat.marks_c[0]} °C, orange from ${heat.warning_c} °C (warning), dark red and large from ${heat.error_c} °C (fault). A red arm is faulted, a grey one absent.`);
    for (const name of fleet.arms.keys()) changed.add(name);
  }

  async function poll() {
    const snapshot = await gateway.request(`/v4/fleet?jobs=${MOST_JOBS}`);
    const nowMs = performance.now();
    Object.assign(fleet, { name: snapshot.fleet, counts: snapshot.counts, paused: snapshot.paused, speed: snapshot.speed, timeS: snapshot.time_s, timeAtMs: nowMs, auctioneers: snapshot.auctioneers, alarms: snapshot.alarms });
    const total = (field) => snapshot.arms.reduce((sum, one) => sum + one[field], 0), workedS = total("worked_s"), heated = total("heat_n2m2s");
    for (const one of snapshot.arms) {
      const arm = armOf(one.arm);
      Object.assign(arm, { token: one.token, left: one.left, badSensor: one.bad_sensor, possibleC: one.temp_c, idle: one.idle });
      arm.shares = [[one.worked_s, workedS], [one.heat_n2m2s, heated]].map(([part, all]) => all ? `${Math.round(100 * part / all)} %` : "—").join(", ");
      if (one.state_age_s !== null) arm.atMs = Math.max(arm.atMs, nowMs - 1000 * one.state_age_s);
      arm.difficultyMs = one.difficulty_age_s === null ? null : nowMs - 1000 * one.difficulty_age_s;
    }
    for (const name of snapshot.left) {
      fleet.arms.delete(name);
      if (view && index.has(name)) view.setMode(index.get(name), -1);
      present.delete(name);
    }
    fleet.left = snapshot.left.length;
    for (const status of snapshot.jobs) setJob(status);
    fleet.jobs = new Map(snapshot.jobs.map((status) => [status.job, status])); // of those that have ended, the newest first
    for (const { alarm, what, by, time_s: timeS, began_s: beganS, ended_s: endedS } of snapshot.alarms) {
      const began = `alarm/${alarm}/began`, seen = `alarm/${alarm}/seen`, ended = `alarm/${alarm}/ended`;
      note(began, beganS, `Alarm: ${what}`, "fault");
      if (by && (endedS === null || noted.has(ended))) note(seen, timeS, `${by} acknowledged the alarm: ${what}`, "operation");
      if (endedS !== null) note(ended, endedS, `The alarm ended${by ? `, acknowledged by ${by}` : ""}: ${what}`);
      if (endedS !== null && by) noted.add(seen); // its time is not known
    }
    dirty = true;
  }

  // Pictures and tables

  const arms = makeTable(element("arms"), 9), alarms = makeTable(element("alarms"), 3), jobs = makeTable(element("jobs"), 6), settled = makeTable(element("settled"), 5);
  const offered = makeTable(element("offers"), 3), present = new Map();

  const temperatures = (arm) => (arm.badSensor ? arm.possibleC : arm.state.temp_c);

  function drawCell() {
    if (!view || !changed.size) return;
    for (const name of changed) {
      const arm = fleet.arms.get(name), i = index.get(name);
      if (i === undefined || !arm || !arm.state) continue;
      const mode = isPresent(arm) ? Math.max(0, ["idle", "working", "faulted"].indexOf(arm.state.mode)) : -1;
      if (present.get(name) !== mode) view.setMode(i, mode);
      present.set(name, mode);
      if (temperatures(arm).length === 7) view.setHeat(i, temperatures(arm));
      if ((arm.state.q || []).length === 7) view.setPose(i, arm.state.q, 0);
    }
    changed.clear();
    view.draw();
    counted.updates++;
  }

  function fillArm(row, arm) {
    const [name, mode, hot, job, cycles, predicted, shares, messages, requests] = row.cells, { state } = arm, here = isPresent(arm);
    if (!name.firstChild) {
      const button = make("button", { type: "button", class: "plain", title: "Look at this arm" }, visible(arm.name));
      button.addEventListener("click", () => {
        looked = looked === arm.name ? "" : arm.name; // a second click shows the whole cell again
        if (view && index.has(arm.name)) view.focus(looked ? index.get(arm.name) : -1);
        element("cell").scrollIntoView({ block: "nearest" });
      });
      name.append(button);
      hot.append(make("span", { class: "bar", "aria-hidden": "true" }, make("i")), make("span"));
    }
    const pause = ["*", arm.name].find((one) => Object.hasOwn(fleet.paused, one)) || "";
    const word = here ? MODES[state.mode] : arm.left ? "◌ left" : "◌ absent";
    setText(mode, pause ? `${word}, ❚❚ paused` : word);
    setClass(row, here ? state.mode : "absent");
    const temps = state ? temperatures(arm) : [], tempC = Math.max(...temps), of = state && fleet.jobs.get(state.job);
    const [bar, text] = hot.children;
    if (temps.length) {
      const warning = arm.badSensor ? ", bad sensor" : heat ? tempC >= heat.error_c ? " above the limit" : tempC >= heat.warning_c ? " warm" : "" : "";
      setText(text, `${tempC.toFixed(1)} °C, joint ${temps.indexOf(tempC) + 1}${warning}`);
      const share = heat ? (tempC - heat.marks_c[0]) / (heat.error_c - heat.marks_c[0]) : tempC / 80;
      bar.firstChild.style.width = `${Math.round(100 * Math.min(1, Math.max(0, share)))}%`;
      if (view) bar.firstChild.style.background = `#${view.heatColour(tempC).convertLinearToSRGB().getHexString()}`;
    } else setText(text, "—");
    setText(job, (state && state.job) || (here && arm.idle) || "—");
    setText(shares, arm.shares || "—");
    setText(cycles, of && of.repetitions ? `${of.cycles} of ${of.repetitions}` : state && state.job_cycles_left ? `${state.job_cycles_left} left` : "—");
    const finish = of && of.finish_s != null ? `done in ${clock(of.finish_s - fleetTime())}` : "";
    const peak = state && state.job_peak_c != null ? `peak ${state.job_peak_c.toFixed(1)} °C` : "";
    const chance = state && state.job_p_saturation != null ? `P ${state.job_p_saturation.toFixed(2)}` : "";
    setText(predicted, [finish, peak, chance].filter(Boolean).join(", ") || "—");
    const scores = arm.difficultyMs === null ? "—" : age((performance.now() - arm.difficultyMs) / 1000);
    setText(messages, `state ${age(ageOf(arm))}, scores ${scores}`);
    const wanted = [];
    if (actions.may("operator")) {
      if (pause !== "*") wanted.push(pause ? { text: "▶ Resume", label: `Resume ${arm.name}`, act: () => actions.resume(arm.name) }
        : { text: "❚❚ Pause", label: `Pause ${arm.name}`, act: () => actions.pause(arm.name) });
      if (here && state.mode === "faulted") wanted.push({ text: "Reset", label: `Reset ${arm.name}`, act: () => actions.reset(arm.name) });
      if (!arm.token) wanted.push({ text: "Free its space", label: `Free the space of ${arm.name}`, act: () => actions.clear(arm.name) });
    }
    setButtons(requests, wanted);
  }

  function fillJob(row, status) {
    const [job, state, arm, cycles, finish, requests] = row.cells;
    setText(job, status.job);
    setText(state, `${STATES[status.state] || status.state}${status.not_planned ? ", not planned yet" : ""}${status.reason ? `: ${status.reason}` : ""}`);
    setClass(row, status.state);
    setText(arm, status.arm || "—");
    setText(cycles, status.repetitions ? `${status.cycles} of ${status.repetitions}` : String(status.cycles));
    const late = status.due_s != null && (status.finish_s ?? fleetTime()) > status.due_s ? " (late)" : "";
    setText(finish, [status.finish_s == null ? "" : `at ${clock(status.finish_s)}, in ${clock(status.finish_s - fleetTime())}`,
      status.due_s == null ? "" : `due ${clock(status.due_s)}${late}`].filter(Boolean).join("; ") || "—");
    const button = (text, act) => ({ text, label: `${text} ${status.job}`, act });
    setButtons(requests, !actions.may("operator") ? [] : status.state === "unfinished"
      ? [button("Done", () => actions.settle(status.job, "done")), button("Redo", () => actions.settle(status.job, "redo"))]
      : [button("Cancel", () => actions.cancel(status.job)), button("Change", () => actions.change(status.job))]);
  }

  function fillSettled(row, status) {
    [status.job, STATES[status.state] || status.state, status.arm || "—", clock(status.finished_s), status.reason || ""].forEach((text, i) => setText(row.cells[i], text));
  }

  function fillOffer(row, { job, state, winner, scores }) {
    setText(row.cells[0], job);
    setText(row.cells[1], state);
    const listed = [...scores].filter(([, { peak, p, d }]) => (peak ?? p ?? d) != null).sort(([a, x], [b, y]) => (x.peak ?? 1e9) - (y.peak ?? 1e9) || (x.d ?? 1e9) - (y.d ?? 1e9) || (a < b ? -1 : 1));
    const shown = listed.filter(([arm], i) => i < 6 || arm === winner);
    const text = shown.map(([arm, { peak, p, d }]) => `${arm === winner ? "✔ " : ""}${arm} ${figure(peak, 1, " °C")}, P ${figure(p, 2)}, d ${figure(d, 2)}`);
    if (shown.length < listed.length) text.push(`and ${listed.length - shown.length} more`);
    setText(row.cells[2], text.join(";  ") || (winner ? `✔ ${winner}` : "none"));
  }

  const isOpen = (alarm) => alarm.ended_s === null || !alarm.by;

  // Alarms that last and those that nobody has seen, then the last of the others.
  function drawAlarms() {
    const all = [...(fleet.alarms || [])].reverse();
    const listed = [...all.filter(isOpen), ...all.filter((alarm) => !isOpen(alarm))].slice(0, MOST_ALARMS);
    element("alarms").hidden = !listed.length;
    alarms.update(listed.map((alarm) => [alarm.alarm, alarm]), (row, alarm) => {
      const [what, lasts, seen] = row.cells;
      setText(what, alarm.what);
      setText(lasts, alarm.ended_s === null ? `since ${clock(alarm.began_s)}` : `${clock(alarm.began_s)} to ${clock(alarm.ended_s)}`);
      setClass(row, alarm.ended_s === null && !alarm.by ? "fault" : alarm.by ? "" : "warning");
      if (!seen.firstChild) seen.append(make("span"), make("span"));
      const at = alarm.acknowledged ? new Date(alarm.acknowledged).toLocaleString() : "";
      setText(seen.firstChild, alarm.by ? `${alarm.by}, ${at}` : actions.may("operator") ? "" : "nobody");
      setButtons(seen.lastChild, alarm.by || !actions.may("operator") ? [] : [{ text: "Acknowledge", label: `Acknowledge: ${alarm.what}`, act: () => actions.acknowledge(alarm) }]);
    });
  }

  // What needs attention and is no alarm.
  const some = (names) => names.slice(0, 20).join(", ") + (names.length > 20 ? ` and ${names.length - 20} more` : "");
  function alerts() {
    const list = [], all = [...fleet.arms.values()].sort(byName);
    const add = (key, kind, text) => list.push([key, kind, text]);
    if (connected && !all.some((arm) => arm.token) && !fleet.auctioneers.some((each) => each.token)) {
      add("nobody", "fault", "No arm and no auctioneer is present: the router or the fleet may be down. This page waits for them.");
    } else {
      const warm = all.filter((arm) => heat && isPresent(arm) && Math.max(...temperatures(arm)) >= heat.warning_c)
        .map((arm) => `${arm.name} (joint ${temperatures(arm).indexOf(Math.max(...temperatures(arm))) + 1})`);
      if (warm.length) add(`warm/${warm}`, "warning", `Above the warning limit: ${some(warm)}.`);
    }
    for (const [arm, by] of Object.entries(fleet.paused)) add(`paused/${arm}/${by}`, "pause", `${arm === "*" ? "All arms are" : `${arm} is`} paused${by ? ` by ${by}` : ""}.`);
    if (!list.length && !(fleet.alarms || []).some(isOpen)) add("none", "none", connected ? "None." : "Unknown while the gateway does not answer.");
    const words = { fault: "✖ Fault: ", warning: "▲ Warning: ", pause: "❚❚ ", none: "" }, place = element("alert-list");
    const known = new Map([...place.children].map((item) => [item.dataset.key, item]));
    for (const [key, item] of known) if (!list.some(([one]) => one === key)) item.remove();
    for (const [key, kind, text] of list) if (!known.has(key)) place.append(make("li", { class: kind, "data-key": key }, make("b", {}, words[kind]), visible(text)));
  }

  function drawTables() {
    setText(element("fleet"), fleet.name || "Fleet");
    document.title = `${visible(fleet.name)} live`;
    const all = [...fleet.arms.values()].sort(byName), here = all.filter(isPresent).length;
    const speed = fleet.speed && fleet.speed !== 1 ? `, ${Number(fleet.speed.toPrecision(3))} times as fast as real time` : "";
    const auctioneers = fleet.auctioneers.filter((each) => each.token).map((each) => each.auctioneer).join(", ");
    const time = auctioneers || all.some((arm) => arm.token) ? `Fleet time ${clock(fleetTime())}${speed}. ` : "";
    setText(element("summary"), `${time}${here} of ${all.length} arms present${fleet.left ? `, ${fleet.left} left` : ""}. ${auctioneers ? `Auctioneer: ${auctioneers}` : "No auctioneer"}. Your role: ${fleet.role}.`);
    arms.update(all.map((arm) => [arm.name, arm]), fillArm);
    const listed = [...fleet.jobs.values()], rank = { unfinished: 0, finishing: 1, awarded: 2, waiting: 3 };
    const open = listed.filter(({ state }) => state in rank).sort((a, b) => rank[a.state] - rank[b.state]);
    jobs.update(open.slice(0, MOST_ROWS).map((status) => [status.job, status]), fillJob);
    const counts = Object.entries(fleet.counts).filter(([, count]) => count > 0), openCount = counts.reduce((sum, [state, count]) => sum + (state in rank ? count : 0), 0);
    const counted = counts.map(([state, count]) => `${count} ${state.replace("_", " ")}`).join(", ");
    setText(element("counts"), `${counted || "No jobs"}.${openCount > MOST_ROWS ? ` The first ${MOST_ROWS} of ${openCount} open jobs are listed.` : ""}`);
    if (element("settled-part").open) settled.update(listed.filter(({ state }) => !(state in rank)).slice(0, MOST_ROWS).map((status) => [status.job, status]), fillSettled);
    const waiting = open.filter(({ job, state }) => state === "waiting" && (offers.get(job) || new Map()).size).slice(0, MOST_AWARDS);
    offered.update([
      ...waiting.map(({ job }) => [`waiting/${job}`, { job, state: "… waiting", winner: "", scores: offers.get(job) }]),
      ...awards.map((award) => [award.key, { job: award.job, state: `✔ to ${award.arm}`, winner: award.arm, scores: award.offers }]),
    ], fillOffer);
    alerts();
    drawAlarms();
    actions.allow();
  }

  function frame(ms) {
    requestAnimationFrame(frame); // first: an error in a picture does not end all later ones
    if (ms - lastDraw >= DRAW_MS) {
      lastDraw = ms;
      drawCell();
    }
    if (dirty && ms - lastTables >= TABLES_MS && !isPressed()) {
      lastTables = ms;
      drawTables();
    }
    if (view) view.draw();
  }
  function say(text, style) {
    setText(element("link"), text);
    setClass(element("link"), `status ${style}`);
  }
  gateway.follow({
    onMessage,
    async onOpen() {
      connected = true;
      await load();
      say("● Connected", "good");
      document.body.dataset.ready = "live";
    },
    onLost(reason) {
      connected = false;
      dirty = true;
      say(`✖ ${reason}. What is shown may be old. Connecting again …`, "bad");
    },
  });
  setInterval(() => {
    dirty = true; // ages
    for (const arm of fleet.arms.values()) if (isPresent(arm) !== (present.get(arm.name) !== -1)) changed.add(arm.name);
    if (connected) poll().catch(() => {});
  }, POLL_MS);
  requestAnimationFrame(frame);
  window.dashboard = counted;
}

startPage();
