// Robots of the web client for sdk_overload.py: node sdk_robots.mjs URL ROBOTS FRAMES_PER_S SECONDS COMMAND prints
// their statistics; COMMAND is a JSON file with service and payload.

import { readFileSync } from "node:fs";
import { connect } from "../../client_web/rse-pf.js";

const [url, robots, perS, seconds] = [process.argv[2], ...process.argv.slice(3, 6).map(Number)];
const { service, payload } = JSON.parse(readFileSync(process.argv[6], "utf8"));
const clients = await Promise.all(Array.from({ length: robots }, () => connect(url, { token: "t" })));
const began = performance.now();
const turns = seconds * perS;
for (let turn = 0; turn < turns; turn++) {
  for (const [k, client] of clients.entries()) {
    const due = ((turn + k / robots) / perS) * 1e3;
    const left = due - (performance.now() - began);
    if (left > 0) await new Promise((done) => setTimeout(done, left));
    client.call(service, payload, { stream: "camera", deadlineMs: 250 }).catch(() => {});
  }
}
const counts = clients.map(({ stats }) => ({ held_back: stats.heldBack, reconnects: stats.reconnects }));
console.log(JSON.stringify(counts));
process.exit(0);
