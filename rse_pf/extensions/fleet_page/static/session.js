// The session of this page: opened by the one-time key behind "#", kept for this origin only, sent in a header.

const NAME = "rse-pf session";
let role = sessionStorage.getItem(`${NAME} role`) ?? "view";

export const isOperator = () => role === "operate";
export const hasSession = () => sessionStorage.getItem(NAME) !== null;

export async function openSession() {
  const key = new URLSearchParams(location.hash.slice(1)).get("key");
  if (!key) return hasSession();
  history.replaceState(null, "", location.pathname);
  const answer = await fetch("/session", { method: "POST", body: JSON.stringify({ key }) });
  if (!answer.ok) return hasSession();
  const told = await answer.json();
  sessionStorage.setItem(NAME, told.session);
  keepRole(told.role);
  return true;
}

export function forget() {
  sessionStorage.removeItem(NAME);
}

function keepRole(told) {
  role = told;
  sessionStorage.setItem(`${NAME} role`, told);
}

export async function ask(path, options = {}) {
  const headers = { Authorization: `Bearer ${sessionStorage.getItem(NAME)}` };
  return fetch(path, { ...options, headers, cache: "no-store" });
}

async function told(answer) {
  const value = await answer.json();
  if (!answer.ok) throw new Error(value.hint ? `${value.message} (${value.hint})` : value.message);
  return value;
}

export async function post(path, value) {
  return told(await ask(path, { method: "POST", body: JSON.stringify(value) }));
}

export async function get(path) {
  return told(await ask(path));
}

export async function becomeOperator(key) {
  keepRole((await post("/operator", { key })).role);
}

// Calls take(message) for each event of the stream until it ends; returns the status of the answer.
export async function follow(topics, take, opened, signal) {
  const answer = await ask(`/stream?topics=${encodeURIComponent(topics.join(","))}`, { signal });
  if (!answer.ok) return { status: answer.status, told: await answer.json() };
  opened();
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return { status: 200 };
    const parts = (rest + value).split("\n\n");
    rest = parts.pop();
    for (const part of parts) {
      if (part.startsWith("data: ")) take(JSON.parse(part.slice(6)));
    }
  }
}
