"use strict";
// Asks for the state again and again and shows it. What is not known to be true now is not shown: without an answer for
// a while, or from a station that stands still, there is no verdict.
const POLL_MS = 500, ANSWER_MS = 2000, OLD_MS = 3000;
const at = (id) => document.getElementById(id);
const texts = document.body.dataset;
let token = "", needsPassword = false, answeredAt = 0, historyKey = "", asking = null, refusedText = "";

function put(id, text) {
  const node = at(id);
  if (node.textContent !== text) node.textContent = text;
}

function element(tag, text, name) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  if (name) made.className = name;
  return made;
}

function sign(name) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const use = document.createElementNS("http://www.w3.org/2000/svg", "use");
  use.setAttribute("href", "#sign-" + name);
  made.append(use);
  return made;
}

function showVerdict(verdict) {
  at("verdict").dataset.name = verdict.name;
  at("sign").setAttribute("href", "#sign-" + verdict.name);
  put("word", verdict.word);
  put("age", verdict.age || "");
  put("panel", verdict.panel || "");
  at("lines").replaceChildren(...verdict.lines.map((line) => element("li", line)));
}

function showLink(kind, text) {
  at("link").dataset.kind = kind;
  put("link-text", text);
  document.body.classList.toggle("blind", kind !== "up");
}

function showRows(id, rows) {
  at(id).replaceChildren(...rows.flatMap((row) =>
    [element("dt", row.label), element("dd", row.value, row.good === false ? "bad" : "")]));
}

function showFault(fault) {
  at("fault").hidden = !fault;
  if (!fault) return;
  put("fault-code", fault.code + " " + fault.name);
  put("fault-meaning", fault.meaning);
  put("fault-remedy", fault.remedy);
}

function showMap(state) {
  const map = at("map"), wanted = state.map ? "/map.svg?" + encodeURIComponent(state.map) : "";
  if (map.dataset.shows !== wanted) {
    map.dataset.shows = wanted;
    const next = new Image();
    next.addEventListener("load", () => { if (map.dataset.shows === wanted) { map.src = next.src; map.hidden = false; } });
    next.addEventListener("error", () => { if (map.dataset.shows === wanted) { map.hidden = true; map.dataset.shows = ""; } });
    if (wanted) next.src = wanted;
    else map.hidden = true;
  }
  at("seeds").replaceChildren(...(state.seeds || []).map((seed) => {
    const row = element("li");
    row.append(element("b", seed.height), element("span", [seed.place, seed.flags].filter(Boolean).join("  ")));
    return row;
  }));
}

function showStatistics(statistics) {
  const alarm = at("alarm");
  alarm.className = statistics.alarm ? "raised" : statistics.valid ? "" : "quiet";
  alarm.lastElementChild.textContent = statistics.text;
  put("advice", statistics.advice);
  showRows("statistics", statistics.rows);
}

function showHistory(history) {
  const key = history.length ? history[0].sequence + " " + history[0].at_s : "";
  if (key === historyKey) return;
  historyKey = key;
  at("history").replaceChildren(...history.map((seen) => {
    const row = element("tr"), verdict = element("td", undefined, "v-" + seen.verdict);
    verdict.append(sign(seen.verdict), seen.word, element("small", [seen.reasons, seen.panel, seen.gap].filter(Boolean).join(" · ")));
    const time = new Date(seen.at_s * 1000).toLocaleTimeString(document.documentElement.lang, { hour12: false });
    row.append(element("td", seen.sequence), element("td", time), verdict, element("td", seen.seeds),
      element("td", seen.largest));
    return row;
  }));
}

function showOutcome(command) {
  const line = at("outcome");
  if (refusedText) {
    line.dataset.outcome = "bad";
    put("outcome", refusedText);
  } else {
    const outcome = command ? command.outcome : "";
    line.dataset.outcome = outcome === "running" || outcome === "done" ? outcome : outcome && "bad";
    put("outcome", command ? [command.text, command.why].filter(Boolean).join(". ") : "");
  }
}

function show(state) {
  token = state.token;
  needsPassword = state.commands.password;
  showVerdict(state.verdict);
  showLink(state.link.kind, state.link.text);
  showFault(state.fault);
  const notes = at("notes");
  notes.hidden = !state.notes.length;
  notes.replaceChildren(...state.notes.map((note) => element("li", note)));
  showHistory(state.history);
  showOutcome(state.command);
  at("buttons").hidden = !state.commands.allowed;
  const ready = state.link.kind === "up" && !(state.command && state.command.outcome === "running");
  for (const button of at("buttons").children) button.disabled = !ready;
  if (state.link.kind !== "up") return;
  put("state", state.state.name);
  put("state-text", state.state.text);
  put("recipe", state.recipe);
  showRows("station", state.station);
  showMap(state);
  showStatistics(state.statistics);
}

function showNothing() {
  showVerdict({ name: "NO_STATION", word: texts.word, lines: [texts.remedy] });
  showLink("page", texts.down);
  showFault(null);
  at("notes").hidden = true;
  for (const button of at("buttons").children) button.disabled = true;
}

async function answer(path, options) {
  const given = await fetch(path, { cache: "no-store", signal: AbortSignal.timeout(ANSWER_MS), ...options });
  return [given.status, await given.json()];
}

async function poll() {
  if (Date.now() - answeredAt > OLD_MS && answeredAt) showNothing();
  try {
    const [status, state] = await answer("/api/state");
    if (status !== 200) throw new Error("status " + status);
    show(state);
    answeredAt = Date.now();
  } catch {
    if (Date.now() - answeredAt > OLD_MS) showNothing();
  }
  setTimeout(poll, POLL_MS);
}

function choice(recipe) {
  const made = element("button");
  made.type = "button";
  made.setAttribute("role", "radio");
  made.setAttribute("aria-checked", "false");
  made.append(element("b", recipe.id), element("span", recipe.name), element("em", recipe.used ? texts.used : ""));
  made.addEventListener("click", () => {
    for (const other of at("choices").children) other.setAttribute("aria-checked", String(other === made));
    asking.argument = recipe.id;
    at("dialog-confirm").disabled = false;
  });
  return made;
}

async function open(command, name, argument) {
  asking = { command, argument };
  const words = at("text-" + name).dataset;
  put("dialog-title", words.title);
  put("dialog-note", words.note);
  put("dialog-stale", "");
  put("dialog-refused", "");
  at("choices").replaceChildren();
  at("password").value = "";
  at("password-row").hidden = !needsPassword;
  at("dialog-confirm").disabled = argument === null;
  at("dialog").showModal();
  if (command !== "CHANGE_RECIPE") return;
  try {
    const [, known] = await answer("/api/recipes");
    put("dialog-stale", known.stale);
    at("choices").replaceChildren(...known.recipes.map(choice));
  } catch {
    put("dialog-refused", texts.down);
  }
}

async function confirm() {
  at("dialog-confirm").disabled = true;
  put("dialog-refused", "");
  try {
    const body = JSON.stringify({ ...asking, password: at("password").value });
    const headers = { "Content-Type": "application/json", "X-Page-Token": token };
    const [status, told] = await answer("/api/command", { method: "POST", headers, body });
    refusedText = "";
    if (status === 202) at("dialog").close();
    else put("dialog-refused", told.text);
  } catch {
    refusedText = texts.unreachable;
    at("dialog").close();
  }
  at("password").value = "";
  at("dialog-confirm").disabled = false;
}

at("button-recipe").addEventListener("click", () => open("CHANGE_RECIPE", "recipe", null));
at("button-clear").addEventListener("click", () => open("CLEAR_FAULT", "clear", 0));
at("button-reset").addEventListener("click", () => open("RESET_STATISTICS", "reset", 0));
at("dialog-cancel").addEventListener("click", () => at("dialog").close());
at("dialog-confirm").addEventListener("click", confirm);
at("password").addEventListener("keydown", (key) => { if (key.key === "Enter") at("dialog-confirm").click(); });
document.addEventListener("visibilitychange", () => { if (Date.now() - answeredAt > OLD_MS && answeredAt) showNothing(); });
poll();
