// The session of this page.  It is opened with the one-time key after "#" in the address, stored for this origin only,
// and sent in a header.

const NAME = "rse-pf session";
let role = sessionStorage.getItem(`${NAME} role`) ?? "view";

export const isOperator = () => role === "operate";
export const hasSession = () => sessionStorage.getItem(NAME) !== null;

// Open a session with the key in the address; return whether the page has a session, also one from before.
export async function openSession() {
  const key = new URLSearchParams(location.hash.slice(1)).get("key");
  if (!key) return hasSession();
  history.replaceState(null, "", location.pathname);
  const answer = await fetch("/session", { method: "POST", body: JSON.stringify({ key }) });
  if (!answer.ok) return hasSession();
  const opened = await answer.json();
  sessionStorage.setItem(NAME, opened.session);
  keepRole(opened.role);
  return true;
}

export function forget() {
  sessionStorage.removeItem(NAME);
}

function keepRole(newRole) {
  role = newRole;
  sessionStorage.setItem(`${NAME} role`, newRole);
}

// Send a request with the session in its header; return the response.
export async function ask(path, options = {}) {
  const headers = { Authorization: `Bearer ${sessionStorage.getItem(NAME)}` };
  return fetch(path, { ...options, headers, cache: "no-store" });
}

// Return the JSON body of *answer*; throw its message and hint as an error if its status is one.
async function jsonOf(answer) {
  const value = await answer.json();
  if (!answer.ok) throw new Error(value.hint ? `${value.message} (${value.hint})` : value.message);
  return value;
}

export async function post(path, value) {
  return jsonOf(await ask(path, { method: "POST", body: JSON.stringify(value) }));
}

export async function get(path) {
  return jsonOf(await ask(path));
}

export async function becomeOperator(key) {
  keepRole((await post("/operator", { key })).role);
}

// Request the stream of *topics*: call opened() once, then take(message) for each message until the stream ends.
// Return the HTTP status, and the body if it is an error.
export async function follow(topics, take, opened, signal) {
  const answer = await ask(`/stream?topics=${encodeURIComponent(topics.join(","))}`, { signal });
  if (!answer.ok) return { status: answer.status, body: await answer.json() };
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
