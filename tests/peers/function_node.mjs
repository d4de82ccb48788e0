// Carries out the code of a Node-RED function node: a message a line in, what it sends and shows a line out.
// usage: node function_node.mjs CODE-FILE ENVIRONMENT-AS-JSON
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";

const settings = JSON.parse(process.argv[3]);
const carryOut = new Function("msg", "node", "context", "flow", "env", readFileSync(process.argv[2], "utf8"));
const store = () => {
  const kept = new Map();
  return { get: (key) => kept.get(key), set: (key, value) => kept.set(key, value) };
};
const [context, flow] = [store(), store()];

for await (const line of createInterface({ input: process.stdin })) {
  const said = { errors: [], status: null };
  const node = { status: (shown) => (said.status = shown.text), error: (text) => said.errors.push(text) };
  const msg = JSON.parse(line);
  if (msg.topic === "restart") context.set("station", undefined);
  else said.out = carryOut(msg, node, context, flow, { get: (name) => settings[name] });
  console.log(JSON.stringify({ ...said, shown: flow.get("seed_inspector") }));
}
