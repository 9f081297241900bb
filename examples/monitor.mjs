// Monitor a fleet through `thermofleet bus gateway`, with Node 18 or newer and no packages.
//
//     node examples/monitor.mjs http://127.0.0.1:8080/v4 [seconds]
//
// Reads the stream of server-sent events and prints a table every second. If the stream ends, it connects again with the
// number of the last message, so that no event is missed. Set THERMOFLEET_TOKEN if the gateway requires a token.

const [base = "http://127.0.0.1:8080/v4", seconds = "0"] = process.argv.slice(2);
const arms = new Map(); // name -> row of the table
const jobs = new Map(); // name -> state
let last = ""; // number of the last message

const headers = () => ({
  Accept: "text/event-stream",
  ...(last && { "Last-Event-ID": last }),
  ...(process.env.THERMOFLEET_TOKEN && { Authorization: `Bearer ${process.env.THERMOFLEET_TOKEN}` }),
});

function arm(name) {
  if (!arms.has(name)) arms.set(name, {});
  return arms.get(name);
}

// Apply one message of the stream: {name, message}, with a message of docs/bus/messages.md.
function apply(topic, { name, message }) {
  if (topic === "state") {
    const hottest = Math.max(...message.temp_c);
    Object.assign(arm(name), {
      mode: message.mode,
      "hottest °C": hottest.toFixed(1),
      joint: message.temp_c.indexOf(hottest) + 1,
      headroom: message.headroom_k.toFixed(1),
      job: message.job ?? "", // optional
    });
  } else if (topic === "difficulty") {
    const scores = message.jobs.map((job, i) => [job, message.difficulty[i]]).filter(([, d]) => d !== null);
    arm(name).difficulty = scores.map(([job, d]) => `${job} ${d.toFixed(2)}`).join(", ");
  } else if (topic === "presence" && message.role === "arm") {
    arm(message.name).token = message.there ? "yes" : "no";
  } else if (topic === "result") {
    jobs.set(message.status.job, message.status.state);
  } else if (topic === "event") {
    console.log(`${message.time_s.toFixed(0)} s  ${name}: ${message.kind} ${message.job ?? ""} ${message.reason ?? ""}`);
  }
}

// Escape control characters and direction marks: names come from others.
function visible(_key, value) {
  if (typeof value !== "string") return value;
  return value.replace(/[\p{C}\p{Zl}\p{Zp}]/gu, (char) => `\\u{${char.codePointAt(0).toString(16)}}`);
}

// Parse a block of the stream: lines are "field: value"; a line that begins with ":" is a keep-alive.
function parse(block) {
  const fields = {};
  for (const line of block.split("\n")) {
    const at = line.indexOf(":");
    if (at > 0) fields[line.slice(0, at)] = line.slice(at + 1).replace(/^ /, "");
  }
  if (fields.id) last = fields.id;
  if (fields.event === "gap") console.log("some events were missed: the connection was lost for too long");
  else if (fields.data) apply(fields.event, JSON.parse(fields.data, visible));
}

async function read(signal) {
  const response = await fetch(`${base}/events`, { headers: headers(), signal });
  if (!response.ok) throw new Error((await response.json()).detail);
  const text = response.body.pipeThrough(new TextDecoderStream());
  let rest = ""; // of the last, incomplete block
  for await (const part of text) {
    const blocks = (rest + part).split("\n\n");
    rest = blocks.pop();
    blocks.forEach(parse);
  }
}

function show() {
  const counts = {};
  for (const state of jobs.values()) counts[state] = (counts[state] ?? 0) + 1;
  console.table(Object.fromEntries([...arms].sort()));
  console.log("jobs in the results received:", counts); // GET /v4/fleet has the counts of all jobs
}

const end = new AbortController();
const pace = setInterval(show, 1000);
if (Number(seconds)) setTimeout(() => end.abort(), 1000 * Number(seconds));
while (!end.signal.aborted) {
  try {
    await read(end.signal);
  } catch (error) {
    if (!end.signal.aborted) console.error(`${error.message}; connecting again`);
  }
  if (!end.signal.aborted) await new Promise((resolve) => setTimeout(resolve, 1000));
}
clearInterval(pace);
show();
