// The driver of roslib as it is, over the rosbridge endpoint: node roslib_driver.mjs SCENARIO.
//
// roslib does not connect again by itself; that, and what had no answer then, is done here.
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { Ros, Service, Topic } from "roslib";

const CLAIMS = ["pnp", "typed-error", "busy", "deadline", "stream", "renew", "expired", "revoked", "not-finite"];
const PER_S = 10;
const MAX_UNANSWERED = 6;
const TYPED_ENDS = { 4401: "unauthorized", 4403: "revoked" };
const scenario = process.argv[2];
const say = (event) => process.stdout.write(JSON.stringify(event) + "\n");
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

class Run {
  given = JSON.parse(readFileSync(process.env.RSE_PF_INPUT, "utf8"));
  url = process.env.RSE_PF_URL.replace(/\/ws$/, "/rosbridge");
  token = process.env.RSE_PF_TOKEN;
  sent = 0;
  slot = 0;
  twice = 0;
  connections = 0;
  isOpen = false;
  over = "";
  waiting = new Set();
  times = [];
  codes = {};

  async connect() {
    for (let attempt = 0; !this.isOpen && !this.over; attempt += 1) {
      await new Promise((resolve) => {
        this.ros = new Ros();
        this.ros.on("error", () => resolve());
        this.ros.on("close", (event) => {
          this.isOpen = false;
          this.over ||= TYPED_ENDS[event?.code] ?? "";
          resolve();
        });
        this.ros.on("connection", () => {
          this.ros.authenticate(this.token, "", "", "", 0, "", 0);
          this.isOpen = true;
          resolve();
        });
        this.ros.connect(this.url).catch(() => resolve());
      });
      if (!this.isOpen) await sleep(Math.random() * Math.min(1000, 100 * 2 ** attempt));
    }
    this.connections += 1;
    this.ros.on("close", () => this.over || this.connect());
    if (this.connections > 1 && this.isOpen) {
      say({ event: "moved", server: "" });
      for (const call of this.waiting) this.send(call);
    }
  }

  // Sends a refused call once more; all sends keep this distance from now on.
  again(call, retryMs) {
    const number = call.number;
    this.slot = Math.max(performance.now(), this.slot) + retryMs;
    setTimeout(() => call.number === number && this.send(call), this.slot - performance.now());
  }

  get maySend() {
    return this.waiting.size < MAX_UNANSWERED && performance.now() >= this.slot;
  }

  send(call) {
    if (!this.isOpen) return;
    this.sent += 1;
    call.number = this.sent;
    const { ros } = this, { number } = call;
    const service = new Service({ ros, name: `/${call.service}`, serviceType: `rse_pf/${call.service}` });
    const ended = (reply, code) => {
      this.waiting.delete(call);
      this.twice += call.answered.has(number) ? 1 : 0;
      call.answered.add(number);
      if (call.answered.size > 1) return; // it was sent again after a reconnect, and answered before
      this.codes[code] = (this.codes[code] ?? 0) + 1;
      this.times.push(performance.now() - call.began);
      call.resolve({ reply, code });
    };
    service.callService(
      call.payload,
      (reply) => ended(reply, "ok"),
      (error) => {
        const code = error?.code ?? String(error);
        if (["busy", "unauthorized", "worker-lost"].includes(code)) {
          this.again(call, Math.max(50, error.retry_after_ms ?? 0));
        } else {
          ended(error, code);
        }
      },
      call.timeout_s,
    );
  }

  begin(service, payload, timeout_s) {
    const call = { service, payload, timeout_s, answered: new Set(), began: performance.now() };
    call.answer = new Promise((resolve) => {
      call.resolve = resolve;
    });
    this.waiting.add(call);
    this.send(call);
    return call;
  }

  command(number) {
    const found = this.given.commands[number % this.given.commands.length];
    return [found.service, found.payload];
  }

  async settle(ms) {
    for (const end = performance.now() + ms; this.waiting.size && performance.now() < end; ) await sleep(20);
  }

  done(offered, more = {}) {
    const times = this.times.sort((a, b) => a - b);
    say({
      event: "done", sent: offered, answered: times.length, twice: this.twice, lost: this.waiting.size,
      codes: this.codes, p50_ms: times[times.length >> 1] ?? 0,
      p99_ms: times[Math.floor(0.99 * (times.length - 1))] ?? 0, resent: this.sent - offered,
      connections: this.connections, ...more,
    });
  }
}

async function pnp(run) {
  let worst = 0;
  for (const [number, expected] of run.given.expected.entries()) {
    const { reply, code } = await run.begin(...run.command(number)).answer;
    if (code !== "ok" || reply.verdict !== expected.verdict) throw new Error(`${code} ${reply.verdict}`);
    reply.T_camera_world.forEach((each, i) => {
      worst = Math.max(worst, Math.abs(each - expected.T_camera_world[i]));
    });
  }
  if (!(worst <= 1e-6)) throw new Error(`${worst} off`);
  run.done(run.given.expected.length, { worst });
}

async function typedError(run) {
  const { reply } = await run.begin("nothing-here", {}).answer;
  if (!reply.hint) throw new Error("no hint");
  const [service, payload] = run.command(0);
  const few = { points_world: payload.points_world.slice(0, 9), pixels: payload.pixels.slice(0, 6) };
  await run.begin(service, { ...payload, ...few }).answer;
  run.done(2);
}

async function busy(run) {
  let offered = 0;
  for (const end = performance.now() + 1e3 * Number(process.env.RSE_PF_SECONDS); performance.now() < end; ) {
    if (run.maySend) {
      run.begin(...run.command(offered));
      offered += 1;
    }
    await sleep(1000 / 80);
  }
  await run.settle(20_000);
  run.done(offered);
}

async function deadline(run) {
  for (let number = 0; number < 20; number += 1) {
    run.begin(...run.command(number), 1e-5); // any wait in the server is longer
    if (number % 6 === 5) await sleep(360); // in bursts: the server counts from the arrival
  }
  await run.settle(10_000);
  run.done(20);
}

async function stream(run) {
  let isStopped = false;
  createInterface({ input: process.stdin }).on("line", (line) => {
    const order = JSON.parse(line);
    if (order.do === "stop") {
      isStopped = true;
    } else {
      run.token = order.token;
      run.ros.authenticate(run.token, "", "", "", 0, "", 0);
    }
  });
  let offered = 0;
  let said = 0;
  while (!isStopped) {
    if (run.isOpen && run.maySend) {
      run.begin(...run.command(offered));
      offered += 1;
    }
    if (performance.now() - said >= 250) {
      said = performance.now();
      say({ event: "count", answered: run.times.length });
    }
    await sleep(1000 / PER_S);
  }
  await run.settle(20_000);
  run.done(offered);
}

async function ended(run) {
  while (!run.over) await sleep(20);
  run.codes[run.over] = 1;
  run.done(0);
}

async function notFinite(run) {
  const messages = [];
  for (const [name, messageType] of [["/scan", "sensor_msgs/LaserScan"], ["/fix", "sensor_msgs/NavSatFix"]]) {
    new Topic({ ros: run.ros, name, messageType }).subscribe((message) => messages.push(message));
  }
  await run.begin("echo", { value: 1 }).answer; // the subscriptions are made
  say({ event: "ready" });
  while (messages.length < 2) await sleep(20);
  const found = JSON.stringify(messages);
  if (found !== '[{"ranges":[1,null,null,null]},{"latitude":null}]') throw new Error(found);
  run.done(1);
}

const SCENARIOS = {
  pnp, "typed-error": typedError, busy, deadline, stream, renew: stream, expired: ended, revoked: ended,
  "not-finite": notFinite,
};

if (scenario === "--claims") {
  console.log(JSON.stringify(CLAIMS));
} else if (!(scenario in SCENARIOS)) {
  say({ event: "unsupported" });
  process.exitCode = 3;
} else {
  try {
    const run = new Run();
    await run.connect();
    if (scenario !== "not-finite") say({ event: "ready" }); // which is ready when it has subscribed
    await SCENARIOS[scenario](run);
    process.exit(0);
  } catch (error) {
    say({ event: "error", message: String(error) });
    process.exit(1);
  }
}
