// A PLC's side of the paint inspection station, register map version $map_version. Made from the station's own tables by
// `inspector plc-package`; do not edit it here. One exchange at a time: read the result block, write the control block.
//
// in    topic "tick" (the clock), the answers of the two Modbus nodes, their errors, and what is asked of the station:
//       topic TRIGGER (payload: panel id; none: the next number), CLEAR_FAULT, OFFLINE (true or false),
//       PANEL_START (panel id), PANEL_END, and each command (payload: its argument): $command_names
// out   1 to the reading node, 2 to the writing node, 3 results, each once, 4 alarms, 5 panels that were triggered and
//       not inspected, 6 how commands ended
// A panel is good only in a message of output 3 whose payload.verdict is "PASS", and only that payload.panel_id.
const TICK_S = $tick_s;
const EXCHANGE_S = 1.5; // for one exchange; longer than the Modbus client waits, shorter than HEARTBEAT_S
const HEARTBEAT_S = $heartbeat_s; // for a new heartbeat
const TRIGGER_S = 2.0; // until a trigger is taken
const RESULT_S = 10.0; // from there to its result
const COMMAND_S = 10.0; // for a command
$constants

function numberAt(words, at, type) {
  const [first, second] = LOW_WORD_FIRST ? [words[at + 1], words[at]] : [words[at], words[at + 1]];
  if (type === "u16") return words[at];
  if (type === "i16") return words[at] - (words[at] >= 0x8000 ? 0x10000 : 0);
  const long = first * 0x10000 + second;
  if (type === "u32") return long;
  const bytes = Buffer.alloc(4);
  bytes.writeUInt32BE(long);
  return bytes.readFloatBE();
}

// Values by name, in the units of the table; null where the register says there is no value.
function decoded(words) {
  const values = {};
  for (const [name, at, type, scale, exact] of FIELDS) {
    const number = numberAt(words, at, type);
    const nothing = !exact && (number === NOTHING[type] || Number.isNaN(number));
    values[name] = nothing ? null : scale === 1 ? number : number * scale;
  }
  return values;
}

function encoded(values) {
  const words = new Array(CONTROL_WORDS).fill(0);
  for (const [name, at, type] of CONTROL_FIELDS) {
    const long = [Math.floor(values[name] / 0x10000), values[name] % 0x10000];
    if (LOW_WORD_FIRST) long.reverse();
    if (type === "u32") [words[at], words[at + 1]] = long;
    else words[at] = values[name];
  }
  return words;
}

function names(bits, of) {
  return Object.keys(of).filter((name) => (bits & of[name]) !== 0);
}

function nameOf(code, of) {
  return Object.keys(of).find((name) => of[name] === code) || String(code);
}

const LOW_WORD_FIRST = String(env.get("LOW_WORD_FIRST")) === "true";
const ACCEPT_SIMULATED = String(env.get("ACCEPT_SIMULATED")) === "true";
const UNIT = Number(env.get("STATION_UNIT"));
const s = context.get("station") || {
  ticks: 0, exchange: "", number: 0, began: 0, beat: 0, seen: false, alive: false, error: "", live: null, alarm: null,
  acknowledging: 0, acknowledged: 0, trigger: "", triggered: 0, missedBefore: 0, since: 0,
  command: "", wanted: 0, argument: 0, asked: 0, panel: 0, panelOpen: false, panelEnds: false,
  offline: false, clear: false, written: 0, last: null, status: "",
};
const out = [[], [], [], [], [], []];
const [READ, WRITE, RESULT, ALARM, LOST, ENDED] = [0, 1, 2, 3, 4, 5];
const elapsed = (since) => (s.ticks - since) * TICK_S;

function tell(output, topic, payload) {
  out[output].push({ topic, payload });
}

function exchange(output, kind, payload) {
  s.exchange = kind;
  s.number += 1;
  s.began = s.ticks;
  out[output].push({ topic: kind, exchange: s.number, payload: { unitid: UNIT, ...payload } });
}

function fails(error) {
  s.exchange = "";
  s.alive = false;
  s.error = error;
}

function lost(panelId) {
  tell(LOST, "panel lost", { panel_id: panelId, verdict: "NOT_INSPECTED" });
}

function commandEnds(done, result) {
  tell(ENDED, "command", { command: nameOf(s.wanted, COMMAND), argument: s.argument, done, result });
}

// What is asked of the station
function ask() {
  const number = msg.payload === "" || msg.payload === undefined || msg.payload === null ? 0 : Number(msg.payload);
  const isBit = ["CLEAR_FAULT", "PANEL_END", "OFFLINE"].includes(msg.topic);
  if (!isBit && !(Number.isInteger(number) && number >= 0 && number <= 0xffffffff)) {
    node.error(msg.topic + ": payload must be a whole number from 0 to 4294967295, is " + msg.payload, msg);
  } else if (msg.topic === "TRIGGER") {
    const panelId = number || (s.triggered % 0xffffffff) + 1;
    if (s.trigger) return lost(panelId); // the panel before is still on its way
    Object.assign(s, { trigger: "wanted", triggered: panelId, since: s.ticks });
  } else if (msg.topic === "PANEL_START") {
    Object.assign(s, { panel: number, panelOpen: true, panelEnds: false });
  } else if (msg.topic === "PANEL_END") {
    Object.assign(s, { panelEnds: s.panelOpen || s.panelEnds, panelOpen: false });
  } else if (msg.topic === "CLEAR_FAULT") {
    s.clear = true;
  } else if (msg.topic === "OFFLINE") {
    s.offline = msg.payload === true;
  } else if (Object.keys(COMMAND).includes(msg.topic)) {
    if (s.command) {
      tell(ENDED, "command", { command: msg.topic, argument: number, done: false, result: "BUSY" });
    } else {
      Object.assign(s, { command: "wanted", wanted: COMMAND[msg.topic], argument: number, asked: s.ticks });
    }
  } else {
    node.error("unknown topic " + msg.topic + "; see the head of this function", msg);
  }
}

function beats(r) {
  if (s.seen && r.heartbeat !== s.live.heartbeat) {
    Object.assign(s, { alive: true, error: "", beat: s.ticks });
  }
  s.seen = true;
}

function isFault() {
  const simulated = s.live !== null && (s.live.status & STATUS.SIMULATED) !== 0 && !ACCEPT_SIMULATED;
  if (!s.alive) return s.error || "NOT_YET_ALIVE";
  if ((s.live.status & STATUS.FAULT) !== 0) return "FAULT";
  return simulated ? "SIMULATED" : "";
}

// A result is taken once: by its sequence. It is acknowledged until it is no longer offered.
function takes(r) {
  if (r.sequence_u32 === 0) context.set("last_taken", 0); // the station counts anew
  const lastTaken = context.get("last_taken") || 0;
  const offered = (r.handshake & ANSWER.RESULT_AVAILABLE) !== 0 && (r.handshake & ANSWER.ACK_MISMATCH) === 0;
  if (!offered || (s.acknowledging && r.sequence_u32 !== s.acknowledging)) {
    s.acknowledging = 0;
  } else if (!s.acknowledging) {
    if (r.sequence_u32 !== lastTaken) {
      const gap = lastTaken && r.sequence_u32 > lastTaken ? r.sequence_u32 - lastTaken - 1 : 0;
      resulted(r, gap);
      context.set("last_taken", r.sequence_u32);
    }
    Object.assign(s, { acknowledging: r.sequence_u32, acknowledged: r.sequence });
  }
}

function resulted(r, gap) {
  const valid = !isFault() && (r.status & STATUS.RESULTS_VALID) !== 0;
  const verdict = valid && r.verdict === VERDICT.PASS ? "PASS" : valid && r.verdict === VERDICT.FAIL ? "FAIL" : "NOT_INSPECTED";
  const shown = Math.min(r.defect_count, $block_defects);
  s.last = {
    verdict, sequence: r.sequence_u32, panel_id: r.panel_id, lost_before: gap, fault: nameOf(r.fault_code, FAULT),
    reasons: names(r.reasons | (r.reasons_high << 16), REASON), defect_count: r.defect_count,
    largest_height_um: r.largest_height_um,
    heights_um: Array.from({ length: shown }, (_, i) => r["defect_" + (i + 1) + "_height_um"]), registers: r,
  };
  tell(RESULT, "result", s.last);
  const taken = s.trigger === "waits" || (s.trigger === "high" && (r.handshake & ANSWER.TRIGGER_ACK) !== 0);
  if (taken && r.panel_id === s.triggered) s.trigger = "";
}

// The trigger: wanted, high until it is acknowledged, then its result is waited for
function triggers(r) {
  if (s.trigger === "wanted" && (r.handshake & ANSWER.TRIGGER_READY) !== 0) {
    Object.assign(s, { trigger: "high", missedBefore: r.missed_triggers });
  } else if (s.trigger === "high" && (r.handshake & ANSWER.TRIGGER_ACK) !== 0) {
    // Within a panel the result is the whole panel's, and comes when that ends.
    Object.assign(s, { trigger: s.panelOpen ? "" : "waits", since: s.ticks });
  } else if (s.trigger === "high" && r.missed_triggers !== s.missedBefore) {
    s.trigger = "";
    lost(s.triggered);
  }
}

// The command: EXECUTE is high until its end is told; the next waits until that is forgotten
function commands(r) {
  const ended = (r.handshake & (ANSWER.COMMAND_COMPLETED | ANSWER.COMMAND_FAILED)) !== 0;
  if (s.command === "wanted" && !ended && (r.handshake & ANSWER.COMMAND_EXECUTING) === 0) {
    s.command = "high";
  } else if (s.command === "high" && ended) {
    const done = (r.handshake & ANSWER.COMMAND_COMPLETED) !== 0 && r.command_echo === s.wanted;
    commandEnds(done, nameOf(r.command_result, COMMAND_RESULT));
    s.command = "";
  }
}

function runsOut() {
  if (s.exchange && elapsed(s.began) >= EXCHANGE_S) fails("NO_ANSWER");
  if (elapsed(s.beat) >= HEARTBEAT_S) {
    s.alive = false;
    s.error = s.error || (s.exchange && elapsed(s.began) > EXCHANGE_S / 3 ? "NO_ANSWER" : "HEARTBEAT");
  }
  if (s.trigger && elapsed(s.since) >= (s.trigger === "waits" ? RESULT_S : TRIGGER_S)) {
    s.trigger = "";
    lost(s.triggered);
  }
  if (s.command && elapsed(s.asked) >= COMMAND_S) {
    s.command = "";
    commandEnds(false, "NO_ANSWER");
  }
}

function control() {
  const bits = {
    TRIGGER: s.trigger === "high", RESULTS_ACK: s.acknowledging, BUFFER_RESULTS: true, OFFLINE: s.offline,
    CLEAR_FAULT: s.clear, PANEL_START: s.panelOpen, PANEL_END: s.panelEnds, EXECUTE: s.command === "high",
  };
  s.written = Object.keys(bits).reduce((word, name) => word | (bits[name] ? CONTROL[name] : 0), 0);
  const value = encoded({
    control: s.written, acknowledged_sequence: s.acknowledged,
    control_panel_id: s.panelOpen ? s.panel : s.triggered, command: s.wanted, command_argument: s.argument,
  });
  exchange(WRITE, "write", { fc: $write_function, address: $control_address, quantity: value.length, value });
}

function readDone(words) {
  s.exchange = "";
  if (!Array.isArray(words) || words.length !== $result_words) return fails("NO_ANSWER");
  const r = decoded(words);
  if (r.map_version !== MAP_VERSION) return fails("MAP_VERSION");
  if (r.sequence !== r.sequence_end) return fails("TORN");
  beats(r);
  s.live = r;
  if (s.alive) {
    takes(r);
    triggers(r);
    commands(r);
  }
  control();
}

// Told when it begins, when its cause changes, and when it ends
function alarms() {
  const cause = isFault();
  const fault = cause === "FAULT" ? nameOf(s.live.fault_code, FAULT) : "";
  const told = cause + " " + fault;
  if (cause === "NOT_YET_ALIVE" || told === s.alarm) return cause;
  const was = s.alarm;
  s.alarm = told;
  if (was === null && cause === "") return cause;
  const [meaning, remedy] = FAULT_TEXTS[fault] || ALARM_TEXTS[cause];
  tell(ALARM, "alarm", { alarm: cause !== "", cause: fault || cause, meaning, remedy });
  return cause;
}

function shows(cause) {
  const last = s.last ? ", #" + s.last.sequence + " " + s.last.verdict + ", panel " + s.last.panel_id : "";
  const height = s.last && s.last.defect_count ? ", highest " + s.last.largest_height_um + " um" : "";
  const text = (cause ? s.alarm || cause : nameOf(s.live.state, STATE)).trim() + last + height;
  const good = !cause && s.last && s.last.verdict === "PASS";
  if (text !== s.status) node.status({ fill: cause ? "red" : good ? "green" : "yellow", shape: "dot", text });
  s.status = text;
}

if (msg.topic === "tick") {
  s.ticks += 1;
  runsOut();
  if (!s.exchange) exchange(READ, "read", { fc: $read_function, address: $result_address, quantity: $result_words });
} else if (msg.exchange !== undefined) {
  // What comes after its time, or a second time, belongs to nothing.
  if (s.exchange && msg.exchange === s.number) {
    if (msg.error) fails("NO_ANSWER");
    else if (s.exchange === "read") readDone(msg.payload);
    else {
      s.exchange = "";
      if ((s.written & CONTROL.CLEAR_FAULT) !== 0) s.clear = false;
    }
  }
} else if (!msg.error) {
  ask();
}
shows(alarms());
context.set("station", s);
flow.set("seed_inspector", { alive: s.alive, fault: isFault(), live: s.live, last_result: s.last });
return out;
