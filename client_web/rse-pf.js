/**
 * RSE-PF for browsers, web workers and Node: one robot, connected to the backend servers of a platform.
 *
 * The rules are those of docs/protocol.md; comments name its sections.  The module has no dependencies, stores
 * nothing, and writes nothing but exceptions of callbacks to the console.  Internal times are seconds of a monotonic
 * clock.  Names that begin with `_` are internal, and the minifier may shorten them.
 */

// Number of attempts of `connect` before it rejects.
const FIRST_ATTEMPTS = 4;
// Time limit of an attempt to connect after an unanswered attempt: Chromium then delays a WebSocket by up to 5 s.
const LONG_ATTEMPT_MS = 11e3;
// Time between two pings.
const PING_S = 2;
// Longest wait for a pong.
const PONG_S = 3;
// Default deadline of a command, and time for which a cancelled command counts as unanswered.
const ANSWER_S = 5;
// Longest duration of a call of the token function.
const TOKEN_MS = 3e4;
// Largest deadline of a command: an hour.
const MAX_DEADLINE_MS = 3.6e6;
// Largest message of a server after decompression, and largest JSON text of a command.
const MAX_INFLATED_BYTES = 1 << 20;
// Number of unsent bytes in the socket above which commands wait, so that newer frames can replace them.
const MAX_BUFFERED_BYTES = 1 << 16;
// Largest object that is stored by one PUT request; larger objects are uploaded in parts.
const MAX_PUT_BYTES = 1 << 18;
// Largest part of an upload.
const MAX_PART_BYTES = 1 << 20;
// Number of undecodable messages of a connection after which it is closed.
const MAX_BAD_MESSAGES = 10;
// Largest budget of commands that are sent again after `busy`; each new command adds 0.1 to the budget.
const MAX_RETRIES = 5;
// Longest pause of a stream after one `busy` answer.
const MAX_PAUSE_S = 60;
// Share of the server's rate limit that is used: a network may deliver messages closer together than they were sent.
const RATE_SHARE = 0.9;
// Longest remaining time of a refusal for whose end calls and the first connect wait.
const NEAR_S = 2;
// Smallest change of the difference of wall clock and monotonic clock that counts as a set clock.
const CLOCK_SET_S = 0.5;

const { min, max, random, round } = Math;
const { from } = Array;
const { parse } = JSON;
const now = () => performance.now() / 1e3;
const unixTime = () => Date.now() / 1e3;
const clockOffset = () => unixTime() - now();
const pause = (s) => new Promise((done) => setTimeout(done, s * 1e3));
const nothing = () => {};
const bytesOf = (data) => new Uint8Array(data);
const sizeOf = (data) => data.byteLength ?? data.length;

/** Return a function that settles a promise; *late* is called if the promise is not settled within *ms*. */
const ending = (resolve, reject, ms, late) => {
  const timeout = late && setTimeout(late, ms);
  return (failed, value) => {
    clearTimeout(timeout);
    failed ? reject(failed) : resolve(value);
  };
};

// Codes of errors.
const CONNECT = "connect";
const UNSUPPORTED = "unsupported";
const USAGE = "usage";
// Messages of errors.
const NO_ANSWER = "no answer";
const TOO_LARGE = "message too large";

/** An error with a stable code of docs/protocol.md, section 5. */
export class RsePfError extends Error {
  constructor(code, message, hint = "", { retry_after_ms: retryAfterMs = null, server = "", trace = "" } = {}) {
    super(message);
    Object.assign(this, { name: "RsePfError", code, hint, retryAfterMs, server, trace });
  }
}

const makeError = (...words) => new RsePfError(...words);
const errorOf = (failure) => makeError(failure.code, failure.message, failure.hint, failure);
const unreadable = (message) => makeError("protocol", message, "no RSE-PF server?");
const cancelled = () => makeError("cancelled", "cancelled by the program");
const unauthorized = (message = "no valid token", hint = "use a fresh token") =>
  makeError("unauthorized", message, hint);

// --- codecs (section 1) ----------------------------------------------------------------------------------

/** Return the output of a compression stream for *bytes*; throws if the output is longer than *limit* bytes. */
const transform = async ({ writable, readable }, bytes, limit) => {
  const writer = writable.getWriter();
  const reader = readable.getReader();
  let whole = bytesOf();
  const read = async () => {
    for (let step; !(step = await reader.read()).done; ) {
      const joined = bytesOf(whole.length + step.value.length);
      joined.set(whole);
      joined.set(step.value, whole.length);
      whole = joined;
      if (whole.length > limit) throw unreadable(TOO_LARGE);
    }
  };
  // A stream that refuses its input gives its reader no error: the writer has to be awaited, too.
  await Promise.all([read(), writer.write(bytes), writer.close()]);
  return whole;
};

/** Begin *work* now, and call *then* with its result once *before* has settled; rejects with the error of either. */
const inOrder = (before, work, then) =>
  Promise.allSettled([(async () => work())(), before]).then(([{ value, reason }]) => {
    if (reason) throw reason;
    then(value);
  });

/** The codecs by name: `encode` makes a WebSocket message of JSON text, and `decode` parses such a message. */
export const codecs = {
  json: { encode: (text) => text, decode: parse },
  zlib: {
    encode: (text) => transform(new CompressionStream("deflate"), new TextEncoder().encode(text)),
    decode: async (data) =>
      parse(
        new TextDecoder("utf-8", { fatal: true }).decode(
          await transform(new DecompressionStream("deflate"), bytesOf(data), MAX_INFLATED_BYTES),
        ),
      ),
  },
};

/** Bytes are base64, arrays of numbers are lists (section 2), and every number is finite. */
const plain = (_, value) => {
  if (typeof value == "number" && !isFinite(value)) throw TypeError(value);
  return value instanceof Uint8Array
    ? btoa(from(value, (byte) => String.fromCharCode(byte)).join(""))
    : ArrayBuffer.isView(value) ? from(value) : value;
};

/** Return *value* as JSON; throws a typed error if it has none: BigInt, NaN, a cycle. */
const textOf = (value) => {
  try {
    return JSON.stringify(value, plain) ?? "null";
  } catch (failed) {
    throw makeError(USAGE, "no JSON: " + failed.message, "send finite numbers");
  }
};

const rounded = (values, scale) => from(values, (value) => round(value * scale) / scale);

const sha256 = async (bytes) => {
  if (!crypto.subtle) {
    throw makeError(UNSUPPORTED, "no sha256 here", "use https or localhost");
  }
  return from(bytesOf(await crypto.subtle.digest("SHA-256", bytes)), (byte) => byte.toString(16).padStart(2, "0")).join("");
};

// --- a connection ----------------------------------------------------------------------------------------

/** Return whether the claims of a token say that it has expired; false if the claims cannot be read. */
const isExpired = (token) => {
  try {
    return parse(atob(token.split(".")[1].replace(/[-_]/g, (sign) => (sign < "_" ? "+" : "/")))).exp < unixTime();
  } catch {}
};

const trimmed = (token) => `${token || ""}`.trim();
const bearer = (token) => (token ? { Authorization: "Bearer " + token } : {});

const BROKEN = ["protocol", "defect of this client"];
/** Close codes that refuse the robot for long (section 6): code, message and hint of the error. */
const REFUSALS = {
  1002: BROKEN,
  1007: BROKEN,
  1008: BROKEN,
  1009: ["too-large", TOO_LARGE],
  4400: BROKEN,
  4406: [UNSUPPORTED, "other protocol version", "update rse-pf.js"],
  4409: ["conflict", "another one replaced it", "one token per robot"],
};

/** Error codes of Node for an attempt that reached no server; a browser reports only whether it is online. */
const UNREACHABLE = /^E(NET|HOST|AI_|NOTF|TIMED)|^Timeout/;
const isOnline = () => navigator.onLine;

/** Mark an error as the refusal of a server: the robot connects again in 20 to 40 s, or once its tokens are valid. */
const refused = (failed, validInS = Infinity) => {
  failed._validInS = validInS;
  return failed;
};

/** Return whether an error is a refusal that is not known to end within `NEAR_S`. */
const lasts = (failed) => failed._validInS > NEAR_S;

/** Connect a robot: resolves at the first Welcome, rejects with an RsePfError; see rse-pf.d.ts. */
export const connect = async (url, options = {}) => {
  const httpUrl = url.replace(/^ws/, "http");
  const {
    codec = "zlib", tokenIn = "protocol", sdk = "rse-pf-js/0.3.0", onChange = nothing, connectTimeoutMs = 4000,
    stallTimeoutMs = 1000, dataUrl = httpUrl, WebSocket = globalThis.WebSocket,
  } = options;
  const { encode, decode } = codecs[codec] || {};
  if (!encode) throw makeError(USAGE, `no codec named ${codec}`, `choose ${Object.keys(codecs)}`);
  if (!WebSocket) throw makeError(UNSUPPORTED, "no WebSocket", "use Node 22 or newer");
  const stallS = stallTimeoutMs / 1e3;
  const links = new Set();
  const pending = new Map();
  const subscriptions = new Map();
  const printed = new Set();
  const lanes = { __proto__: null };
  const counts = {
    sent: 0, answered: 0, failed: 0, resent: 0, reconnects: 0, moves: 0, bytesOut: 0, bytesIn: 0, heldBack: { busy: 0, "own-limit": 0 },
    callbackErrors: 0,
  };
  let { token } = options;
  let current = null;
  let lastId = 0;
  let timer;
  let timerAt = Infinity;
  let attempt = 0;
  let failingAt = Infinity;
  let trouble = {};
  let refusal = null;
  let adoptedAt = -Infinity;
  let notBefore = 0;
  let isKeeping = false;
  let lateUntil = 0;
  let share = RATE_SHARE;
  let retries = MAX_RETRIES;
  let renewal = nothing;
  let error = null;

  /** Call a function of the program; count and report its exception or rejection, and reject with it. */
  const guarded = async (call, ...words) => {
    try {
      return await call(...words);
    } catch (failed) {
      counts.callbackErrors++;
      // Print one exception of each line of code that throws.
      const what = `${/.*:\d+:\d+/.exec(failed?.stack) ?? failed}`;
      if (printed.size < printed.add(what).size) console.error("rse-pf callback:", failed);
      throw failed;
    }
  };

  /** Call a function of the program in a later microtask, so that its exception cannot disturb the session. */
  const later = async (...words) => {
    await 0;
    guarded(...words).catch(nothing);
  };

  // --- connect, reconnect, move --------------------------------------------------------------------------

  const isSource = typeof token === "function";
  /** Call the token function of the program; rejects if it takes longer than TOKEN_MS. */
  const askToken = () => {
    let timeout;
    const late = (_, reject) => (timeout = setTimeout(reject, TOKEN_MS, new DOMException("no token", "TimeoutError")));
    return Promise.race([token(), new Promise(late)]).finally(() => clearTimeout(timeout));
  };
  const freshToken = async () => {
    try {
      return trimmed(isSource ? await guarded(askToken) : token);
    } catch (failed) {
      throw makeError(CONNECT, "no token: " + failed?.name, "fix the token function");
    }
  };

  /** Open a WebSocket; resolves at its Welcome. */
  const dial = async () => {
    const used = await freshToken();
    if (error) throw error;
    const protocol = "rse-pf.v1." + codec.replace("zlib", "json+zlib");
    const time = now();
    const link = {
      _token: used, _left: Infinity, _filledAt: time, _heardAt: time, _checkedAt: time,
      _pingedAt: -Infinity, _renewAt: Infinity, _bad: 0,
    };
    let socket;
    try {
      socket = new WebSocket(
        url,
        !used ? protocol
        : tokenIn === "header" ? { protocols: protocol, headers: bearer(used) }
        : [protocol, "rse-pf.token." + used],
      );
    } catch (failed) {
      // The message of the exception may contain the token.
      throw refused(makeError(USAGE, "no WebSocket: " + failed.name, "wss: from https pages"));
    }
    link._socket = socket;
    links.add(link);
    socket.binaryType = "arraybuffer";
    return new Promise((resolve, reject) => {
      link._end = ending(resolve, reject, isOnline() && trouble._isUnanswered ? LONG_ATTEMPT_MS : connectTimeoutMs, () => {
        lateUntil = now() + 60;
        const failed = unreadable("no Welcome");
        failed._isUnanswered = !socket.readyState;
        lose(link, failed);
      });
      socket.onopen = () =>
        socket.protocol === protocol
          ? say(link, "hello", { sdk, capabilities: ["progress", "updates"] })
          : lose(link, refused(unreadable("it does not speak " + protocol)));
      socket.onmessage = (event) => receiveData(link, event.data);
      // Node 22 has no close event for a handshake that failed; elsewhere it follows.
      socket.onerror = () => {
        if (link._welcome) return;
        socket.onclose = nothing;
        closed(link, 1006);
      };
      socket.onclose = (event) => closed(link, event.code);
    });
  };

  const closed = async (link, code) => {
    if (!links.has(link)) return;
    const isStatic = trimmed(token) === link._token;
    const isOpening = !link._welcome;
    const isRevoked = code === 4403;
    if (code === 4429) {
      share = max(0.1, share / 2);
      notBefore = now() + 5;
    }
    const refusalOfCode = REFUSALS[code];
    let failed = makeError(...(refusalOfCode || [CONNECT, "closed with " + code, "up? token valid? origin allowed?"]));
    // A connection of an abandoned attempt may still replace the one that was opened after it: no refusal.
    const isOwn = code === 4409 && (current?._moveUntil || now() < lateUntil);
    if (refusalOfCode && (link === current || !current) && !isOwn) refused(failed);
    else if (isRevoked || code === 4401 || (isOpening && isExpired(link._token))) {
      failed = unauthorized();
      // Times in tokens are whole seconds: a fresh token has to be issued in a later second than the cut-off.
      if (isStatic || isRevoked) refused(failed, isStatic ? Infinity : 1);
    } else if (isOpening) failed = await reasonOf(link, failed, isStatic);
    lose(link, failed);
  };

  /** Return why a handshake failed, by an HTTP request, in Node and in pages of the platform's origin; else *failed*. */
  const reasonOf = async (link, failed, isStatic) => {
    const { host } = new URL(httpUrl);
    // Not for each attempt: a firewall would count twice as many requests.
    if ((attempt % 4 === 1 || refusal) && (globalThis.location?.host ?? host) === host) {
      try {
        const answer = await fetch(httpUrl, { headers: bearer(link._token), signal: AbortSignal.timeout(1e3) });
        const { platform, message, hint, valid_from_s: validFromS } = await answer.json();
        if (answer.status === 401 && platform === "rse-pf") {
          // A fixed token stays revoked; so does a new one if the clock that signs it is behind the cut-off.
          const validInS = validFromS - unixTime();
          return refused(unauthorized(message, hint), !isStatic && validInS > -NEAR_S ? validInS : Infinity);
        }
      } catch (problem) {
        failed._isUnanswered = UNREACHABLE.test(problem.cause?.code || problem.name);
      }
    }
    return failed;
  };

  /** Return the pause before the next attempt (section 1); *spent* is the duration of the last attempt, in seconds. */
  const pauseAfter = (spent) => {
    const jitter = random();
    const { _validInS: validInS, _isUnanswered: isUnanswered } = trouble;
    if (validInS != null) return min(20 + 20 * jitter, max(0, validInS) + jitter / 2);
    if (isUnanswered) return 1 + jitter / 4 - spent;
    // Without a network no server needs to be spared, but Chromium delays attempts after failures.
    const longest = min(40, (now() - failingAt) / (isOnline() === false ? 1 : 3));
    return longest > 1 ? (longest * (1 + jitter)) / 2 - spent : jitter * min(1, 0.1 * 2 ** attempt);
  };

  /** Keep one connection: reconnect ever more rarely (section 1), and make before break (section 4, "Moving"). */
  const keep = async () => {
    if (isKeeping) return;
    isKeeping = true;
    if (current || now() - adoptedAt > 10) {
      attempt = 0;
      failingAt = Infinity;
    }
    let began = now();
    while (!error && (!current || current._moveUntil)) {
      const before = trouble;
      const until = max(notBefore, now() + pauseAfter(now() - began));
      const offset = clockOffset();
      const wasOnline = isOnline();
      // The pause ends early if the clock of this machine is set, which may make tokens valid, if the program gives
      // another token, or if the network is back or gone.
      while (now() < until && !error && trouble === before && isOnline() === wasOnline && (clockOffset() - offset) ** 2 < CLOCK_SET_S ** 2) {
        await pause(0.1);
      }
      if (error) break;
      if (isOnline() !== wasOnline) failingAt = Infinity;
      attempt++;
      began = now();
      if (began > current?._moveUntil) current._moveUntil = 0;
      else {
        try {
          const link = await dial();
          const isBetter = !current || (current._moveUntil && link._welcome.server !== current._welcome.server);
          isBetter ? adopt(link) : lose(link);
        } catch (failed) {
          if (adoptedAt < 0 && (lasts(failed) || attempt >= FIRST_ATTEMPTS)) end(failed);
          note(failed);
          // A server that was not reached needs no longer pauses.
          if (failed._isUnanswered) {
            failingAt = Infinity;
            if (adoptedAt >= 0) attempt--;
          } else failingAt = min(failingAt, now());
        }
      }
    }
    isKeeping = false;
  };

  /** Record why there is no connection. A refusal that lasts ends all calls, and the robot continues to reconnect. */
  const note = (failed) => {
    trouble = failed;
    if (current || error || !lasts(failed)) return;
    const isNews = refusal?.code !== failed.code || refusal.hint !== failed.hint;
    refusal = failed;
    settleAll(pending, failed);
    if (isNews) later(onChange, "refused", failed.message);
  };

  const adopt = (link) => {
    if (!links.has(link)) return;
    const before = current;
    const isFirst = adoptedAt < 0;
    current = link;
    adoptedAt = now();
    trouble = {};
    refusal = null;
    if (before) {
      before._isLeaving = true;
      counts.moves++;
      // A job continues on any server, so its command need not keep the old connection open.
      pending.forEach((each) => {
        if (each._isLong && !each._isCancelled) each._link = null;
      });
    } else if (!isFirst) counts.reconnects++;
    for (const name in lanes) lanes[name]._busyUntil = 0;
    subscriptions.forEach(ask);
    renewal(); // this connection was opened with a token that is valid
    tick();
    if (!isFirst) later(onChange, before ? "moved" : "link-back", link._welcome.server);
  };

  /** Return the commands that have no answer on *link*. */
  const sentOn = (link) => [...pending.values()].filter((each) => each._link === link);

  /** Close and remove a connection; *failed* is the reason, if any. Its commands wait for the next connection. */
  const lose = (link, failed) => {
    if (!links.delete(link)) return;
    link._socket.close(1000);
    sentOn(link).forEach((each) => {
      each._link = null;
      if (each._isCancelled && !each._isLong) pending.delete(each._id);
    });
    link._end(failed);
    if (link !== current) return;
    current = null;
    if (error) return;
    later(onChange, "link-lost", failed.message);
    note(failed);
    keep();
  };

  const end = (failed) => {
    if (error) return;
    error = failed;
    clearTimeout(timer);
    renewal(failed);
    settleAll(pending, failed);
    subscriptions.forEach((each) => later(each._onEnd, failed));
    links.forEach((link) => lose(link, failed));
  };

  // --- messages ------------------------------------------------------------------------------------------

  const say = (link, type, fields) => send(link, textOf({ type, ...fields }));

  /** Send a message in the order of calls. A message of a *command* that is too large ends the command instead. */
  const send = (link, text, command) => {
    link._left--;
    const write = (data) => {
      const size = sizeOf(data);
      if (command && (size > link._limits.max_message_bytes || text.length > MAX_INFLATED_BYTES)) {
        settle(command, makeError("too-large", `${size} bytes are too many`, "upload it, name its digest"));
      } else if (links.has(link)) {
        counts.bytesOut += size;
        link._socket.send(data);
      }
    };
    const stop = (failed) => lose(link, makeError(UNSUPPORTED, failed.message, "use another codec"));
    link._outgoing = inOrder(link._outgoing, () => encode(text), write).catch(stop);
  };

  const receiveData = (link, data) => {
    link._heardAt = now();
    counts.bytesIn += sizeOf(data);
    link._incoming = inOrder(link._incoming, () => decode(data), (message) => receive(link, message)).catch((problem) => {
      const failed = unreadable("cannot read it: " + problem);
      const isDamaged = problem?.name; // an Error; an unknown type of message is thrown as text
      // The message may have been the answer to any of these commands, and a repeated answer would be as unreadable.
      if (isDamaged) settleAll(sentOn(link), failed);
      if ((isDamaged && !link._welcome) || ++link._bad > MAX_BAD_MESSAGES) lose(link, failed);
    });
  };

  const receive = (link, message) => {
    if (!links.has(link)) return;
    const time = now();
    const { type, id } = message;
    const each = pending.get(id);
    const subscription = subscriptions.get(id);
    const isHere = link === current;
    const isOfLink = each?._link === link;
    const handlers = {
      __proto__: null,
      welcome() {
        link._welcome = message;
        link._limits = message.limits;
        expiresIn(link, message.token_s);
        link._end(null, link);
      },
      pong() {
        link._unansweredAt = null;
      },
      move() {
        if (!isHere) return;
        link._moveUntil = time + message.within_ms / 1e3;
        keep();
      },
      renewed() {
        expiresIn(link, message.token_s);
        renewal();
      },
      update() {
        if (isHere && subscription) later(subscription._onUpdate, message.key || "", message.payload ?? null, message.seq);
      },
      progress() {
        if (!isOfLink) return;
        const { _isLong: wasLong, _onProgress: onProgress } = each;
        each._isLong = true;
        if (each._isCancelled) {
          if (!wasLong) withdraw(each);
        } else {
          if (each._isDefault) each._until = Infinity;
          if (onProgress) later(onProgress, min(1, max(0, message.done)), message.what || "");
        }
      },
      failure() {
        const failed = errorOf(message);
        const { code } = message;
        const isBusy = code === "busy";
        const after = time + (message.retry_after_ms || 0) / 1e3;
        if (id == null) {
          // The failure is about a message or the session, not about one command.
          if (isBusy) {
            link._left = 0;
            link._filledAt = after;
          }
          renewal(failed);
          if (!link._welcome) lose(link, code === UNSUPPORTED ? refused(failed) : failed);
        } else if (subscription && isHere) {
          subscriptions.delete(id);
          later(subscription._onEnd, failed);
        } else if (isOfLink) {
          const { _lane: lane } = each;
          const isLost = code === "worker-lost" && each._losses++ < 2;
          if (isBusy && after > time) {
            lane._busyUntil = min(after, time + MAX_PAUSE_S);
            lane._busy = message;
          }
          // Another server or a later time may help (section 5).
          if (!each._isCancelled && (isLost || (isBusy && after < each._until && retries >= 1))) {
            if (isBusy) retries--;
            each._link = null;
          } else settle(each, failed);
        }
      },
      result() {
        if (!each) return;
        const { _lane: lane, _seq: seq } = each;
        if (time >= each._until) settle(each, expired(each, time));
        else if (!isReplaced(each, lane._delivered)) {
          if (!each._isCancelled) lane._delivered = max(seq, lane._delivered);
          settle(each, null, {
            id, reply: message.reply ?? null, object: message.object || "", server: message.server || "",
            queueMs: message.queue_ms || 0, computeMs: message.compute_ms || 0,
            roundTripMs: (time - each._from) * 1e3,
          });
        }
      },
    };
    const handle = handlers[type];
    if (!handle) throw type;
    handle();
    flush();
  };

  const cancel = (each) => {
    if (each._isCancelled || each._isSettled) return;
    if (each._isLong) withdraw(each); // the answer of the server says whether the job had already ended
    else giveUp(each, cancelled());
    schedule();
  };

  /** End a command for its caller; it counts towards `max_in_flight` until the server answers it. */
  const giveUp = (each, failed) => {
    settle(each, failed);
    if (!each._link) return;
    pending.set(each._id, each);
    withdraw(each);
  };

  /** Mark a command as cancelled; ask its server to cancel it if the server has reported progress. */
  const withdraw = (each) => {
    each._isCancelled = true;
    each._until = now() + ANSWER_S;
    if (each._isLong && each._link) say(each._link, "cancel", { id: each._id });
  };

  /** End a command whose number in its stream is below *newest* as `stale`; return whether it was. */
  const isReplaced = (each, newest) =>
    !each._keep && each._seq < newest && !settle(each, makeError("stale", "a newer command came"));

  const expired = (each, time) => makeError("expired", `no answer within ${round((time - each._from) * 1e3)} ms`);

  const settle = (each, failed, result) => {
    pending.delete(each._id);
    if (each._isSettled) return;
    each._isSettled = true;
    counts[failed ? "failed" : "answered"]++;
    each._signal?.removeEventListener("abort", each._cancel);
    each._end(failed, result);
  };

  const settleAll = (commands, failed) => commands.forEach((each) => settle(each, failed));

  const ask = ({ _id: id, _topic: topic }) => current && say(current, "subscribe", { id, topic });

  const expiresIn = (link, seconds) => {
    if (seconds == null) return;
    link._expiresAt = now() + seconds;
    link._renewAt = now() + 0.8 * seconds;
  };

  /** Return how many commands may be sent now (section 4, "Rate"), or minus the seconds until the next one may. */
  const allowance = (time) => {
    const { _limits: limits } = current;
    // A command that is not yet given to the socket can still be replaced by a newer one.
    if (current._socket.bufferedAmount > MAX_BUFFERED_BYTES) return -0.02;
    const rate = limits.max_commands_per_s * share;
    if (!rate) return Infinity;
    const fresh = max(0, time - current._filledAt);
    const left = (current._left = min(max(1, limits.command_burst * share), current._left + fresh * rate));
    current._filledAt += fresh;
    return left < 1 ? time - current._filledAt - (1 - left) / rate : left | 0;
  };

  // --- time ----------------------------------------------------------------------------------------------

  /** Send the waiting commands, oldest first, as far as the server's limits allow. */
  const flush = () => {
    const time = now();
    if (current) {
      let room = min(allowance(time), max(1, current._limits.max_in_flight) - sentOn(current).length);
      pending.forEach((each) => {
        const { _sent: newest, _busyUntil: busyUntil, _busy: busy } = each._lane;
        if (each._link || isReplaced(each, newest)) return;
        const heldS = busyUntil - time;
        const isBusy = heldS > 0;
        // A command whose deadline is before the end of the pause ends at once, with the busy answer of the server.
        if (isBusy && busyUntil >= each._until) {
          return settle(each, errorOf({ ...busy, trace: each._trace, retry_after_ms: heldS * 1e3 }));
        }
        const why = isBusy ? "busy" : room-- > 0 ? 0 : "own-limit";
        if (why) return (each._isHeld ||= ++counts.heldBack[why]);
        if (each._at) counts.resent++;
        each._link = current;
        each._at = time;
        send(current, `${each._head},"deadline_ms":${max(0, min(MAX_DEADLINE_MS, (each._until - time) * 1e3))},"payload":${each._payload}}`, each);
        if (each._isCancelled) withdraw(each);
      });
    }
    links.forEach((link) => link._isLeaving && sentOn(link).every((each) => each._isCancelled) && lose(link));
    schedule();
  };

  const tick = () => {
    timerAt = Infinity;
    const time = now();
    pending.forEach((each) => {
      if (time < each._until) return;
      if (each._isCancelled) settle(each, cancelled());
      else giveUp(each, expired(each, time));
    });
    links.forEach((link) => check(link, time));
    flush();
  };

  /** Send a ping if one is due, and close a connection that counts as lost (section 4, "A lost connection"). */
  const check = (link, time) => {
    if (!link._welcome) return;
    // This program was blocked or suspended: the server may have sent messages meanwhile.
    if (time - link._checkedAt >= stallS) {
      link._heardAt = time;
      link._unansweredAt &&= time;
    }
    link._checkedAt = time;
    const first = min(...sentOn(link).map((each) => (each._isLong ? Infinity : each._at)));
    const isSilent = time - max(link._heardAt, first) >= stallS;
    if (isSilent || time - (link._unansweredAt ?? time) >= PONG_S) {
      return lose(link, makeError(CONNECT, NO_ANSWER));
    }
    if (time - link._pingedAt >= (first < time ? min(PING_S, stallS / 3) : PING_S)) {
      link._unansweredAt ??= time;
      link._pingedAt = time;
      say(link, "ping", { sent_s: time });
    }
    if (time >= link._renewAt && isSource) {
      link._renewAt = time + max(1.5, (link._expiresAt - time) / 2);
      // Without a token in time the server closes the connection, and the next attempt asks again.
      freshToken().then((fresh) => links.has(link) && say(link, "renew", { token: fresh }), nothing);
    }
  };

  /** Set the timer for the next deadline, ping or end of a pause. */
  const schedule = () => {
    const time = now();
    const room = current ? allowance(time) : 1;
    const readyAt = room < 1 ? time - room : Infinity;
    let due = time + stallS / 3;
    pending.forEach((each) => {
      const at = each._lane._busyUntil;
      due = min(due, each._until, each._link ? Infinity : at > time ? at : readyAt);
    });
    if (error || due >= timerAt) return;
    clearTimeout(timer);
    timerAt = due;
    timer = setTimeout(tick, max(1, (due - time) * 1e3));
  };

  // --- data (docs/data.md) -------------------------------------------------------------------------------

  /** Send a request to the data service; repeat it after a lost connection and after 408, 429, 500, 502, 503 and 504. */
  const http = async (method, path, body, signal, more) => {
    const address = new URL("/data/v1/" + path, dataUrl);
    for (let tries = 0; ; tries++) {
      const headers = { ...bearer(await freshToken()), ...more };
      const response = await fetch(address, { method, body, headers, signal }).catch((problem) => problem);
      if (response?.ok) return response;
      if (signal?.aborted) throw cancelled();
      const { status, name } = response;
      const failed = status
        ? errorOf({ code: "store", message: "HTTP " + status, ...(await response.json().catch(nothing)) })
        : makeError(CONNECT, "no data service: " + name, "see serving.allowed_origins");
      if (tries > 4 || (status && !/408|429|50[0234]/.test(status))) throw failed;
      await pause(random() * 0.2 * 2 ** tries);
    }
  };

  // --- public interface ----------------------------------------------------------------------------------

  const robot = {
    get server() {
      return current?._welcome.server || "";
    },
    get robot() {
      return current?._welcome.robot || "";
    },
    get error() {
      return error;
    },
    get failure() {
      return refusal;
    },
    get stats() {
      return { ...counts, heldBack: { ...counts.heldBack }, unanswered: pending.size };
    },

    call: (service, payload = null, options = {}) =>
      new Promise((resolve, reject) => {
        const { deadlineMs, stream, keep: isKept, trace, onProgress, signal } = options;
        if (error || refusal || signal?.aborted) throw error || refusal || cancelled();
        if (!((deadlineMs ?? 1) > 0) || deadlineMs > MAX_DEADLINE_MS) {
          throw makeError(USAGE, `deadlineMs is within 0..${MAX_DEADLINE_MS}, not ${deadlineMs}`);
        }
        const time = now();
        const id = ++lastId;
        // A command without a stream has one of its own.
        const fresh = { _sent: 0, _delivered: 0 };
        const lane = stream ? (lanes[stream] ||= fresh) : fresh;
        const seq = lane._sent + 1;
        const each = {
          _id: id, _lane: lane, _seq: seq, _keep: isKept, _onProgress: onProgress, _signal: signal, _trace: trace,
          // The payload is encoded now, so that the caller may change its arrays afterwards.
          _head: textOf({ type: "command", id, service, stream, seq, keep: isKept, trace }).slice(0, -1),
          _payload: textOf(payload),
          _from: time, _until: time + (deadlineMs ? deadlineMs / 1e3 : onProgress ? Infinity : ANSWER_S),
          _isDefault: !deadlineMs, _at: 0, _losses: 0,
          _end: ending(resolve, reject), _cancel: () => cancel(each),
        };
        signal?.addEventListener("abort", each._cancel);
        lane._sent = seq;
        retries = min(MAX_RETRIES, retries + 0.1);
        counts.sent++;
        pending.set(id, each);
        flush();
      }),

    solvePnp: ({ camera, pointsWorld, pixels, options: pnp, depthsM, depthNoise }, more) =>
      robot.call(
        "pnp",
        {
          camera, points_world: rounded(pointsWorld, 1e4), pixels: rounded(pixels, 1e2), options: pnp,
          depths_m: depthsM && rounded(depthsM, 1e3), depth_noise: depthNoise,
        },
        { stream: "pose", ...more },
      ),

    subscribe: (topic, onUpdate, onEnd = nothing) => {
      if (error) throw error;
      const id = ++lastId;
      const each = { _id: id, _topic: `${topic}`, _onUpdate: onUpdate, _onEnd: onEnd };
      subscriptions.set(id, each);
      ask(each);
      return () => {
        if (subscriptions.delete(id) && current) say(current, "unsubscribe", { id });
      };
    },

    renew: (fresh) =>
      new Promise((resolve, reject) => {
        if (!isSource) token = fresh;
        if (error) throw error;
        renewal(cancelled());
        trouble = {};
        if (!current) return resolve();
        renewal = ending(resolve, reject, ANSWER_S * 1e3, () => reject(makeError("expired", NO_ANSWER)));
        say(current, "renew", { token: fresh });
      }),

    upload: async (data, { onProgress = nothing, signal } = {}) => {
      const bytes = bytesOf(data); // a copy, since the caller may change the original
      const size = bytes.length;
      const digest = await sha256(bytes);
      const path = "uploads/" + digest;
      if (size <= MAX_PUT_BYTES) await http("PUT", "objects/" + digest, bytes, signal);
      else {
        let state;
        while ((state ??= await (await http("PUT", path, textOf({ size }), signal)).json()).offset < size) {
          const { offset } = state;
          later(onProgress, offset, size);
          const part = bytes.subarray(offset, offset + min(state.part_bytes, MAX_PART_BYTES));
          try {
            state = await (await http("PATCH", path, part, signal, { "Upload-Offset": offset })).json();
          } catch (failed) {
            // The answer to this part was lost, or another program uploads the same object.
            if (!/conflict|not-found/.test(failed.code)) throw failed;
            state = null;
          }
        }
      }
      later(onProgress, size, size);
      return digest;
    },

    download: async (digest, { signal } = {}) => {
      const bytes = bytesOf(await (await http("GET", "objects/" + digest, null, signal)).arrayBuffer());
      if ((await sha256(bytes)) !== digest) throw makeError("store", "its digest differs", "try again");
      return bytes;
    },

    close: () => end(makeError("disconnected", "closed")),
  };

  await keep();
  if (error) throw error;
  return robot;
};
