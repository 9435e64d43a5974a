// The driver of the JavaScript client in Node: node web_node.mjs SCENARIO, or --claims.

import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import * as client from "../../../client_web/rse-pf.js";
import { claims, run } from "./web_scenarios.mjs";

const say = (event) => process.stdout.write(`${JSON.stringify(event)}\n`);

async function* orders() {
  for await (const line of createInterface({ input: process.stdin })) yield JSON.parse(line);
}

const word = process.argv[2];
if (word === "--claims") say(claims);
else {
  const { env } = process;
  const module = env.RSE_PF_MODULE ? await import(env.RSE_PF_MODULE) : client;
  const input = env.RSE_PF_INPUT ? JSON.parse(readFileSync(env.RSE_PF_INPUT, "utf8")) : {};
  const messages = input.golden ? JSON.parse(readFileSync(input.golden, "utf8")) : {};
  process.exitCode = await run(word, {
    module, input, messages, say, orders: orders(), url: env.RSE_PF_URL, token: env.RSE_PF_TOKEN,
    codec: env.RSE_PF_CODEC, tokenIn: env.RSE_PF_TOKEN_IN, dataUrl: env.RSE_PF_DATA_URL,
    seconds: Number(env.RSE_PF_SECONDS || 2), map: env.RSE_PF_MAP,
  });
  process.stdin.destroy();
}
