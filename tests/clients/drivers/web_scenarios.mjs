// The scenarios of the JavaScript client, for Node, a page and a web worker: what runs around them gives
// `say` (one event), `orders` (an async iterator of what is told) and the inputs.

const STREAM_PER_S = 10;
const COUNT_MS = 250;
const PATIENT_MS = 60_000;
const SOON_MS = 1000;
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** Counts what is sent and answered, and how long that took. */
class Tally {
  constructor() {
    this.sent = 0;
    this.answered = 0;
    this.twice = 0;
    this.codes = {};
    this.times = [];
  }

  add(code) {
    this.codes[code] = (this.codes[code] || 0) + 1;
  }

  /** Call a service; returns the answer, or the RsePfError. */
  async call(robot, { service, payload }, options = {}) {
    this.sent++;
    const began = performance.now();
    let ends = 0;
    const end = (code) => {
      this.twice += ends++;
      this.answered++;
      this.times.push(performance.now() - began);
      this.add(code);
    };
    try {
      const answer = await robot.call(service, payload, { deadlineMs: PATIENT_MS, ...options });
      end("ok");
      return answer;
    } catch (error) {
      end(error.code || `${error.name}: ${error.message}`);
      return error;
    }
  }

  figures() {
    const times = [...this.times].sort((a, b) => a - b);
    const at = (share) => (times.length ? times[Math.floor(share * (times.length - 1))] : 0);
    const { sent, answered, twice, codes } = this;
    return { sent, answered, twice, lost: sent - answered, codes, p50_ms: at(0.5), p99_ms: at(0.99) };
  }
}

function check(holds, what) {
  if (!holds) throw new Error(what);
}

const same = (a, b) => JSON.stringify(ordered(a)) === JSON.stringify(ordered(b));

function ordered(value) {
  if (Array.isArray(value)) return value.map(ordered);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.keys(value).sort().map((key) => [key, ordered(value[key])]));
}

const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

async function golden({ module, messages, tally }) {
  for (const [name, { meaning, bytes }] of Object.entries(messages)) {
    for (const [codec, { decode }] of Object.entries(module.codecs)) {
      const data = bytesOf(bytes[`rse-pf.v1.${codec.replace("zlib", "json+zlib")}`]);
      const decoded = await decode(codec === "json" ? new TextDecoder().decode(data) : data);
      check(same(decoded, meaning), `${name} as ${codec}: ${JSON.stringify(decoded)}`);
      tally.sent++;
      tally.answered++;
    }
  }
}

async function pnp({ robot, input, tally }) {
  let worst = 0;
  for (const [row, command] of input.commands.entries()) {
    const expected = input.expected[row];
    const { reply, message } = await tally.call(robot, command);
    check(reply, message);
    expected.T_camera_world.forEach((value, at) => {
      worst = Math.max(worst, Math.abs(reply.T_camera_world[at] - value));
    });
    check(reply.verdict === expected.verdict, `the verdict is ${reply.verdict}`);
  }
  check(worst <= 1e-6, `a pose differs by ${worst}`);
  return { worst };
}

async function typedError({ robot, input, tally }) {
  const unknown = await tally.call(robot, { service: "nothing-here", payload: {} });
  check(unknown.hint, "the failure has no hint");
  const { payload } = input.commands[0];
  const few = { ...payload, points_world: payload.points_world.slice(0, 9), pixels: payload.pixels.slice(0, 6) };
  await tally.call(robot, { service: "pnp", payload: few });
}

const MARK = "in-the-place-of-the-payload";

/** Let the commands whose payload is *MARK* be sent with the bytes that *next* returns. */
function replacing(codecs, next) {
  const codec = codecs.zlib;
  const { encode } = codec;
  codec.encode = (text) => {
    const [head, tail] = text.split(JSON.stringify(MARK));
    if (tail === undefined) return encode(text);
    const encoded = new Blob([head, next(), tail]).stream().pipeThrough(new CompressionStream("deflate"));
    return new Response(encoded).arrayBuffer();
  };
}

/** Each kind, and a valid command behind it. */
async function undecodable({ robot, input, tally, raw }) {
  const wrong = [];
  let slowest = 0;
  const kinds = input.undecodable.json;
  for (const { name, payload, service, trace, stream, codes } of kinds) {
    raw.bytes = bytesOf(payload);
    const began = performance.now();
    const failed = await tally.call(robot, { service, payload: MARK }, { trace, stream });
    const took = performance.now() - began;
    slowest = Math.max(slowest, took);
    const valid = await tally.call(robot, { service: "echo", payload: { value: 1 } });
    const isTyped = codes.includes(failed.code) && failed.hint;
    if (!isTyped || took > SOON_MS || valid.reply?.value !== 1) wrong.push([name, failed.message, took, valid.message]);
  }
  return { kinds: kinds.length, wrong, slowest_s: slowest / 1e3 };
}

async function busy({ robot, input, tally, seconds }) {
  const end = performance.now() + seconds * 1e3;
  const calls = [];
  for (let at = 0; performance.now() < end; at++) {
    calls.push(tally.call(robot, input.commands[at % input.commands.length]));
    await pause(1e3 / 80); // four times the default rate
  }
  await Promise.all(calls);
  check(robot.stats.reconnects === 0, "the connection was closed");
}

async function deadline({ robot, input, tally }) {
  for (let each = 0; each < 20; each++) {
    await tally.call(robot, input.commands[0], { deadlineMs: 1 });
    await pause(30);
  }
}

async function newest({ robot, input, tally }) {
  const calls = Array.from({ length: 12 }, () => tally.call(robot, input.commands[0], { stream: "front" }));
  const answers = await Promise.all(calls);
  return { newest_ok: answers.at(-1).reply !== undefined };
}

async function stream({ robot, input, tally, orders, say }) {
  let goesOn = true;
  const listening = (async () => {
    for await (const order of orders) {
      if (order.do === "stop") break;
      if (order.do === "renew") await robot.renew(order.token);
    }
    goesOn = false;
  })();
  const calls = [];
  const began = performance.now();
  let saidAt = -Infinity;
  while (goesOn && !robot.error) {
    const due = ((performance.now() - began) / 1e3) * STREAM_PER_S;
    if (calls.length < due) calls.push(tally.call(robot, input.commands[calls.length % input.commands.length]));
    if (performance.now() - saidAt >= COUNT_MS) {
      saidAt = performance.now();
      say({ event: "count", answered: tally.answered });
    }
    await pause(20);
  }
  await Promise.all(calls);
  if (!robot.error) await listening;
  check(!robot.error, robot.error && robot.error.message);
  const { reconnects, moves, resent } = robot.stats;
  return { reconnects, moves, resent };
}

async function ended({ robot, tally }) {
  while (!robot.failure) await pause(20);
  tally.add(robot.failure.code);
}

/** Call until told to stop; a call may end with the reason of a refusal, or expire. */
async function returns({ robot, tally, orders, say }) {
  let goesOn = true;
  const listening = orders.next().then(() => (goesOn = false));
  while (goesOn) {
    const answer = await tally.call(robot, { service: "echo", payload: { value: 1 } }, { deadlineMs: 1000 });
    if (answer.reply) say({ event: "count", answered: tally.codes.ok });
    await pause(1000 / STREAM_PER_S);
  }
  await listening;
}

async function updates({ robot, map }) {
  const key = await new Promise((resolve, reject) => robot.subscribe(`live/${map}`, resolve, reject));
  return { key };
}

async function progress({ robot, input, tally }) {
  const cancelling = new AbortController();
  let first = null;
  await tally.call(robot, input.long, {
    signal: cancelling.signal,
    onProgress: (done) => {
      first ??= done;
      cancelling.abort();
    },
  });
  check(first !== null, "no progress");
}

async function data({ robot, tally }) {
  for (const size of [1000, 3_000_000]) {
    const bytes = Uint8Array.from({ length: size }, (_, at) => (at * 31 + (at >> 9)) & 255);
    tally.sent++;
    const digest = await robot.upload(bytes);
    const back = await robot.download(digest);
    check(back.length === size && back.every((byte, at) => byte === bytes[at]), "the bytes differ");
    tally.answered++;
  }
}

const RUNS = {
  golden, pnp, "typed-error": typedError, undecodable, busy, deadline, newest, stream, renew: stream, expired: ended, revoked: ended,
  updates, progress, data,
};

export const claims = Object.keys(RUNS);
RUNS.returns = returns; // claimed by what can sign tokens of the robot's own key

/** Run *scenario*; `say` gets its events, the last one is `done` or `error`.  Returns the exit code. */
export async function run(scenario, { module, url, token, codec, tokenIn, dataUrl, say, ...rest }) {
  if (!RUNS[scenario]) {
    say({ event: "unsupported" });
    return 3;
  }
  const tally = new Tally();
  const raw = {};
  let robot = null;
  try {
    if (scenario !== "golden") {
      const onChange = (what, server) => {
        if (what === "moved" || what === "link-back") say({ event: "moved", server });
        if (what === "link-back") say({ event: "back" });
        if (what === "refused") say({ event: "refused", why: server });
      };
      if (scenario === "undecodable") replacing(module.codecs, () => raw.bytes);
      robot = await module.connect(url, { token, codec, tokenIn, dataUrl, onChange });
      say({ event: "ready" });
    }
    const more = await RUNS[scenario]({ module, robot, tally, say, raw, ...rest });
    say({ event: "done", ...tally.figures(), ...more });
    return 0;
  } catch (error) {
    say({ event: "error", message: `${error.code || error.name}: ${error.message}` });
    return 1;
  } finally {
    if (robot) robot.close();
  }
}
