// Requests to the gateway, and its stream of messages, which is opened again whenever it ends.
"use strict";

// Text that shows what it holds: control characters and direction marks as escapes, as fleet.errors.visible does.
function visible(text) {
  return String(text).replace(/[\p{C}\p{Z}]/gu, (char) => char === " " ? char
    : [...Array(char.length).keys()].map((i) => `\\u${char.charCodeAt(i).toString(16).padStart(4, "0")}`).join(""));
}

function makeGateway() {
  let token = sessionStorage.getItem("token") || "", last = "", asking = null;
  const headers = (more) => ({ ...(token && { Authorization: `Bearer ${token}` }), ...more });

  // A token from the person at the page; one question at a time.
  function askToken(sentence) {
    const dialog = document.getElementById("login"), field = document.getElementById("token");
    document.getElementById("login-text").textContent = sentence;
    asking = asking || new Promise((resolve) => {
      dialog.addEventListener("cancel", (event) => event.preventDefault());
      dialog.addEventListener("close", () => {
        token = field.value.trim();
        field.value = "";
        sessionStorage.setItem("token", token);
        asking = null;
        resolve();
      }, { once: true });
      dialog.showModal();
    });
    return asking;
  }

  // The answer as JSON; throws a sentence.
  async function request(path, body) {
    const post = body !== undefined;
    for (;;) {
      let response;
      try {
        response = await fetch(path, {
          method: post ? "POST" : "GET", cache: "no-store", ...(post && { body: JSON.stringify(body) }),
          headers: headers({ Accept: "application/json", ...(post && { "Content-Type": "application/json" }) }),
        });
      } catch {
        throw new Error("The gateway does not answer.");
      }
      if (response.status === 401) {
        const wrong = token ? "The gateway does not know this token. " : "This gateway needs a token. ";
        await askToken(`${wrong}The page keeps it until this tab is closed.`);
        continue;
      }
      const answer = await response.json().catch(() => ({}));
      if (!response.ok) throw Object.assign(new Error(answer.detail || `The gateway answered ${response.status}.`), { status: response.status });
      return answer;
    }
  }

  // One block of the stream: lines are "field: value"; a line that begins with ":" is a keep-alive.
  function parse(block, onMessage) {
    const fields = {};
    for (const line of block.split("\n")) {
      const at = line.indexOf(":");
      if (at > 0) fields[line.slice(0, at)] = line.slice(at + 1).replace(/^ /, "");
    }
    if (fields.id) last = fields.id;
    if (fields.event) onMessage(fields.event, JSON.parse(fields.data));
  }

  // Read until the stream ends; throws if it cannot be had, or was silent for longer than its keep-alive.
  async function read(onOpen, onMessage) {
    const stop = new AbortController();
    let timer = 0;
    const wait = () => {
      clearTimeout(timer);
      timer = setTimeout(() => stop.abort(), 20000);
    };
    wait();
    try {
      const response = await fetch("/v4/events", {
        cache: "no-store", signal: stop.signal, headers: headers({ Accept: "text/event-stream", ...(last && { "Last-Event-ID": last }) }),
      });
      if (response.status === 401) {
        clearTimeout(timer);
        await request("/"); // asks for a token
      }
      if (!response.ok) throw new Error(`The gateway answered ${response.status}.`);
      await onOpen();
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return;
        wait();
        text += value;
        const blocks = text.split("\n\n");
        text = blocks.pop();
        for (const block of blocks) parse(block, onMessage);
      }
    } finally {
      clearTimeout(timer);
    }
  }

  // Follow the stream for ever.
  async function follow({ onOpen, onMessage, onLost }) {
    for (let attempt = 0; ; attempt++) {
      try {
        await read(async () => {
          await onOpen();
          attempt = 0;
        }, onMessage);
        onLost("The gateway has closed the stream");
      } catch (error) {
        onLost(error.name === "AbortError" ? "The gateway is silent" : error instanceof TypeError ? "The gateway does not answer"
          : error.message.replace(/\.$/, ""));
      }
      await new Promise((resolve) => setTimeout(resolve, Math.min(5000, 500 * 2 ** attempt)));
    }
  }
  return { request, follow };
}
