// Prints what Node-RED's debug sidebar shows, a message a line: {"name": of the debug node, "payload": ...}
// Warnings of other nodes are shown there too, and left out.
// usage: node node_red_debug.mjs PORT FOLDER-WITH-NODE-MODULES
import { createRequire } from "node:module";

const WebSocket = createRequire(process.argv[3] + "/")("ws");
const socket = new WebSocket("ws://127.0.0.1:" + process.argv[2] + "/comms");
socket.on("open", () => console.log(JSON.stringify({ name: "open" })));
socket.on("message", (text) => {
  for (const { topic, data } of JSON.parse(text)) {
    if (topic === "debug" && data.format === "Object") console.log(JSON.stringify({ name: data.name, payload: JSON.parse(data.msg) }));
  }
});
