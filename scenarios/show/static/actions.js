// What a person may request: each with a confirmation, and the answer shown.
"use strict";

const ROLES = ["monitor", "submitter", "operator"];

function makeActions(gateway, fleet) {
  const may = (role) => ROLES.indexOf(fleet.role) >= ROLES.indexOf(role);
  const by = element("by");
  by.value = sessionStorage.getItem("by") || "";

  let hide = 0;
  function answer(text, failed) {
    const place = element("answer");
    clearTimeout(hide);
    const end = () => {
      if (isPressed()) hide = setTimeout(end, 500);
      else place.hidden = true;
    };
    if (!failed) hide = setTimeout(end, 20000);
    place.hidden = false;
    setClass(place, failed ? "status bad" : "status good");
    setText(place, `${failed ? "✖" : "✔"} ${text}`);
  }

  // Resolves to whether the person agrees; `fields` are inputs by label.
  function confirm(title, text, button, fields) {
    const dialog = element("confirm");
    setText(element("confirm-title"), title);
    setText(element("confirm-text"), text);
    setText(element("go"), button);
    element("confirm-fields").replaceChildren(...(fields || []).map(([label, input]) => make("label", {}, label, input)));
    dialog.returnValue = "no";
    dialog.showModal();
    (fields ? fields[0][1] : element("go")).focus();
    return new Promise((resolve) => dialog.addEventListener("close", () => {
      sessionStorage.setItem("by", by.value);
      resolve(dialog.returnValue === "yes");
    }, { once: true }));
  }

  async function send(path, body, describe) {
    answer("Sent; waiting for the answer …");
    try {
      const reply = await gateway.request(path, { ...body, by: by.value });
      const [text, failed] = describe(reply);
      answer(text, failed);
      fleet.refresh();
      return !failed;
    } catch (error) {
      answer(error.message, true);
      return false;
    }
  }

  function control(action) {
    const request = [...crypto.getRandomValues(new Uint8Array(8))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    return send("/v4/control", { request, action }, (reply) => {
      const arms = Object.keys(reply.paused || {}).map((arm) => arm === "*" ? "all arms" : arm).join(", ");
      const job = reply.job ? `${reply.job.state.replace("_", " ")}, ${reply.job.cycles} of ${reply.job.repetitions} cycles.` : "settled.";
      const what = action.job ? `${action.job}: ${job}` : `Paused: ${arms || "none"}.`;
      return [`${what}${reply.changed ? "" : " Nothing changed."} ${reply.note || ""}`];
    });
  }

  async function cancel(job) {
    const text = "An arm at work ends the cycle in progress and goes home. A job in its last cycle is finished.";
    if (await confirm(`Cancel ${job}?`, text, "Cancel the job")) control({ action: "cancel", job });
  }
  async function settle(job, outcome) {
    const text = outcome === "done" ? "Say that its last cycle was done: look at the cell first."
      : "Say that its last cycle was not done, and have it done again: look at the cell first.";
    if (await confirm(`Settle ${job} as ${outcome}?`, text, outcome === "done" ? "It is done" : "Do it again")) control({ action: "settle", job, outcome });
  }
  async function change(job) {
    const due = make("input", { type: "number", step: "any", min: "0", id: "new-due" }), none = make("input", { type: "checkbox" });
    const value = make("input", { type: "number", step: "any", min: "0", id: "new-value" });
    const text = "What is left empty stays as it is.";
    if (!(await confirm(`Change ${job}`, text, "Change", [["Due, s from now", due], ["No due date", none], ["Value", value]]))) return;
    const action = { action: "change", job };
    if (none.checked) action.due_s = null;
    else if (due.value) action.due_s = fleet.now() + Number(due.value);
    if (value.value) action.value = Number(value.value);
    if (Object.keys(action).length === 2) answer("Nothing was given to change.", true);
    else control(action);
  }
  async function pause(arm) {
    const text = "An arm at work ends the cycle in progress and goes home; its job goes to another arm. A job in its last cycle is finished.";
    if (await confirm(arm === "*" ? "Pause all arms?" : `Pause ${arm}?`, text, "Pause")) control({ action: "pause", arm });
  }
  async function resume(arm) {
    const text = arm === "*" ? "All pauses end, and arms get jobs again." : "The arm gets jobs again.";
    if (await confirm(arm === "*" ? "Resume all arms?" : `Resume ${arm}?`, text, "Resume")) control({ action: "resume", arm });
  }
  async function reset(arm) {
    const text = "Its fault is cleared now. The arm ends its cycle and goes home by itself: nobody may be in its way. An arm that is too hot refuses.";
    if (await confirm(`Reset ${arm}?`, text, "Reset")) {
      send("/v4/reset", { arm }, (reply) => [`${arm}: ${reply.changed ? "its fault is cleared." : "it has no fault."}`]);
    }
  }
  async function acknowledge({ alarm, what }) {
    if (await confirm("Acknowledge this alarm?", what, "I have seen it")) send("/v4/alarms", { alarm }, (reply) => [`${reply.by} has seen it.`]);
  }
  async function clear(arm) {
    const text = "Only if you have seen that this arm is at home or removed, and switched off: other arms will use its space.";
    if (await confirm(`Free the space of ${arm}?`, text, "Free the space")) {
      send("/v4/clear", { arm }, () => [`${arm}: its space is free until the arm reports its space again.`]);
    }
  }

  // The form: what jobs/cell offers.
  const works = [], numbers = ["repetitions", "payload_kg", "dwell_s", "force_n", "value"];
  function offer(cell) {
    const options = (select, entries) => {
      const chosen = select.value;
      select.replaceChildren(...entries.map(([value, text]) => make("option", { value }, visible(text))));
      if (entries.some(([value]) => value === chosen)) select.value = chosen;
    };
    options(element("kind"), cell.kinds.map(({ kind }) => [kind, kind]));
    for (const id of ["from", "to"]) options(element(id), cell.places.map(({ name }) => [name, name]));
    for (const id of numbers) if (cell.limits[id]) Object.assign(element(id), { min: cell.limits[id].low, max: cell.limits[id].high });
    const planned = new Map();
    for (const arm of cell.arms) for (const work of arm.works) {
      const { kind, places, payload_kg, dwell_s, force_n } = work;
      const text = `${kind} ${places.join(" → ")}, ${payload_kg} kg, dwell ${dwell_s} s${force_n ? `, ${force_n} N` : ""}`;
      planned.set(text, work);
    }
    works.splice(0, works.length, ...planned.values());
    options(element("work"), [["", "choose, or fill in below"], ...[...planned.keys()].map((text, i) => [String(i), text])]);
    kindChosen();
  }
  function kindChosen() {
    const kind = fleet.cell && fleet.cell.kinds.find((one) => one.kind === element("kind").value);
    if (!kind) return;
    const two = kind.places === 2;
    element("to-label").hidden = !two;
    setText(element("from-label"), two ? "From" : "Place");
    setText(element("meaning"), kind.meaning);
    if (two && element("to").value === element("from").value) {
      const other = fleet.cell.places.find(({ name }) => name !== element("from").value);
      if (other) element("to").value = other.name;
    }
  }
  function workChosen() {
    const work = works[Number(element("work").value)];
    if (!work || element("work").value === "") return;
    element("kind").value = work.kind;
    kindChosen();
    element("from").value = work.places[0];
    if (work.places[1]) element("to").value = work.places[1];
    for (const id of ["payload_kg", "dwell_s", "force_n"]) element(id).value = work[id];
  }
  function newName() {
    element("name").value = `page-${Date.now().toString(36)}`;
  }
  function spec() {
    const number = (id) => Number(element(id).value), two = !element("to-label").hidden;
    const job = { name: element("name").value, kind: element("kind").value, places: [element("from").value, ...(two ? [element("to").value] : [])] };
    for (const id of numbers) job[id] = number(id);
    if (element("release").value) job.release_s = fleet.now() + number("release");
    if (element("due").value) job.due_s = fleet.now() + number("due");
    const after = element("after").value.split(",").map((name) => name.trim()).filter(Boolean);
    if (after.length) job.after = after;
    if (element("expires").checked) job.expires = true;
    return job;
  }
  async function submit(event) {
    event.preventDefault();
    if (!may("submitter")) return;
    const job = spec(), text = `${job.kind} ${job.places.join(" → ")}, ${job.payload_kg} kg, ${job.repetitions} cycle(s).`;
    if (!(await confirm(`Submit ${job.name}?`, text, "Submit"))) return;
    const accepted = await send("/v4/jobs", { jobs: [job] }, (reply) => {
      const { job: name, accepted, reason } = reply.jobs[0];
      return [`${name}: ${accepted ? "accepted." : "not accepted."} ${reason || ""}`, !accepted];
    });
    if (accepted) newName();
  }
  async function ask() {
    if (!element("submit").reportValidity()) return;
    const place = element("quotes");
    place.textContent = "Asking every arm …";
    try {
      const { quotes, refused } = await gateway.request("/v4/ask", { jobs: [spec()] });
      const rows = quotes.map((quote) => ({ arm: quote.arm, estimate: quote.estimates[0] })).sort((a, b) => a.arm < b.arm ? -1 : 1);
      const lines = rows.flatMap(({ arm, estimate: { plans, reason } }) => (plans || []).length ? plans.map((plan) => [arm,
        figure(plan.peak_c, 1, " °C"), figure(plan.p_saturation, 2), figure(plan.difficulty, 2), plan.finish_in_s == null ? "—" : clock(plan.finish_in_s)])
        : [[arm, reason || "cannot do it"]]);
      const head = ["Arm", "Predicted peak", "P", "d", "Finished in"];
      place.replaceChildren(lines.length ? make("table", { class: "numbers" }, make("caption", {}, "Quotes, for this job alone; nothing is submitted."),
        make("thead", {}, make("tr", {}, ...head.map((text) => make("th", { scope: "col" }, text)))),
        make("tbody", {}, ...lines.map((line) => make("tr", {}, ...line.map((text) => make("td", line.length === 2 && text === line[1] ? { colspan: 4, class: "words" } : {}, visible(text))))))) : "No arm has quoted.",
        ...refused.filter(Boolean).map((reason) => make("p", {}, visible(reason))));
    } catch (error) {
      place.textContent = visible(error.message);
    }
  }
  element("work").addEventListener("change", workChosen);
  element("kind").addEventListener("change", kindChosen);
  element("submit").addEventListener("submit", submit);
  element("ask").addEventListener("click", ask);
  element("pause-all").addEventListener("click", () => pause("*"));
  element("resume-all").addEventListener("click", () => resume("*"));
  newName();

  // Allow what the role allows.
  function allow() {
    for (const button of document.querySelectorAll("[data-role]")) {
      button.disabled = !may(button.dataset.role) || (button.dataset.role === "submitter" && !fleet.cell);
      button.title = may(button.dataset.role) ? "" : `This needs the role ${button.dataset.role} (this page has ${fleet.role}).`;
    }
  }
  return { may, allow, offer, cancel, settle, change, pause, resume, reset, clear, acknowledge };
}
