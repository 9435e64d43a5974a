// The driver of the JavaScript client in Node: node web_node.mjs SCENARIO, or --claims.

import { createPrivateKey, randomUUID, sign } from "node:crypto";
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import * as client from "../../../client_web/rse-pf.js";
import { claims, run } from "./web_scenarios.mjs";

const say = (event) => process.stdout.write(`${JSON.stringify(event)}\n`);

async function* orders() {
  for await (const line of createInterface({ input: process.stdin })) yield JSON.parse(line);
}

const part = (value) => Buffer.from(typeof value === "string" ? value : JSON.stringify(value)).toString("base64url");

/** Return a token of the robot's own key. */
function signed({ kty, crv, x, d, kid, sub, iss, aud }) {
  const iat = Math.floor(Date.now() / 1e3);
  const claims = { iss, aud, sub, iat, exp: iat + 900, jti: randomUUID() };
  const text = `${part({ alg: "EdDSA", typ: "robot+jwt", kid })}.${part(claims)}`;
  const key = createPrivateKey({ key: { kty, crv, x, d }, format: "jwk" });
  return `${text}.${sign(null, Buffer.from(text), key).toString("base64url")}`;
}

const word = process.argv[2];
if (word === "--claims") say([...claims, "returns"]);
else {
  const { env } = process;
  const module = env.RSE_PF_MODULE ? await import(env.RSE_PF_MODULE) : client;
  const input = env.RSE_PF_INPUT ? JSON.parse(readFileSync(env.RSE_PF_INPUT, "utf8")) : {};
  const messages = input.golden ? JSON.parse(readFileSync(input.golden, "utf8")) : {};
  process.exitCode = await run(word, {
    module, input, messages, say, orders: orders(), url: env.RSE_PF_URL,
    token: word === "returns" ? () => signed(input.own_key) : env.RSE_PF_TOKEN,
    codec: env.RSE_PF_CODEC, tokenIn: env.RSE_PF_TOKEN_IN, dataUrl: env.RSE_PF_DATA_URL,
    seconds: Number(env.RSE_PF_SECONDS || 2), map: env.RSE_PF_MAP,
  });
  process.stdin.destroy();
}
