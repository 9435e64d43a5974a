// The entry point of the page: it opens the session, reads the stream, and passes each message to the views.

import { byId, confirmed, element, setText, toast } from "./dom.js";
import { eventsView } from "./events.js";
import { fleetView } from "./fleet.js";
import { mapView } from "./map.js";
import { posesView } from "./poses.js";
import { becomeOperator, follow, forget, isOperator, openSession } from "./session.js";

const VIEWS = ["fleet", "map", "poses", "events"];
const isShown = (name) => !byId(`tab-${name}`).hidden;
const TOPICS = ["fleet", "history", "robots", "event", "audit", "pose", "link", "maps"];
const views = {
  fleet: fleetView(byId("view-fleet")),
  map: mapView(byId("view-map"), changeMap),
  poses: posesView(byId("view-poses"), byId("poses-count")),
  events: eventsView(byId("view-events"), byId("events-count")),
};
let liveMap = "";
let aborted = new AbortController();
let lastMessageMs = 0; // time of the last message of the stream, by performance.now(); 0 before the first one

function show(name) {
  for (const each of VIEWS) {
    byId(`view-${each}`).hidden = each !== name;
    const tab = byId(`tab-${each}`);
    tab.setAttribute("aria-selected", String(each === name));
    tab.tabIndex = each === name ? 0 : -1;
  }
  views[name].shown?.();
  for (const each of VIEWS) if (each !== name) views[each].hidden?.();
  sessionStorage.setItem("rse-pf view", name);
}

for (const name of VIEWS) byId(`tab-${name}`).addEventListener("click", () => show(name));
document.querySelector("nav").addEventListener("keydown", (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const shown = VIEWS.filter(isShown);
  const at = shown.findIndex((name) => byId(`tab-${name}`) === document.activeElement);
  const next = shown[(at + step + shown.length) % shown.length];
  show(next);
  byId(`tab-${next}`).focus();
});
document.addEventListener("keydown", (event) => {
  const typing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) || byId("dialog").open;
  if (typing || event.ctrlKey || event.altKey || event.metaKey) return;
  const name = VIEWS["1234".indexOf(event.key)];
  if (name && "1234".includes(event.key) && isShown(name)) show(name);
  if (event.key === "t") switchTheme();
});

function useTheme(name) {
  document.documentElement.dataset.theme = name;
  setText(byId("theme"), name === "dark" ? "Light" : "Dark");
  for (const view of Object.values(views)) view.themed?.();
}

function switchTheme() {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("rse-pf theme", next);
  useTheme(next);
}

byId("theme").addEventListener("click", switchTheme);
byId("operate").addEventListener("click", async () => {
  const key = await confirmed({
    title: "Operate this platform",
    text: "Print a key with: rse-pf fleet --operate. It works once, and for this page only.",
    button: "Use the key",
    input: { type: "password", autocomplete: "off", "aria-label": "Operator's key" },
  });
  if (!key) return;
  try {
    await becomeOperator(key.replace(/^.*#key=/, ""));
    operatorChanged();
  } catch (error) {
    toast(error.message);
  }
});

function operatorChanged() {
  byId("operate").hidden = isOperator();
  views.fleet.operatorChanged();
}

// Show the state of the connection to the platform.
function linked(on, text) {
  byId("link").dataset.state = on ? "on" : "off";
  setText(byId("link"), text);
}

// Pass a message of the stream to the views that show its topic.
function take({ topic, key, value }) {
  lastMessageMs = performance.now();
  if (topic === "fleet") {
    setText(byId("platform"), value.platform);
    document.title = `${value.platform}: ${value.robots ?? "?"} robots`;
    if (value.cloud) onlyCloud();
    byId("link").dataset.delayMs = String(Math.round(Date.now() - 1000 * value.time_s + 1000 * (value.sample_age_s ?? 0)));
    views.fleet.take(value);
  } else if (topic === "history") views.fleet.takeHistory(value);
  else if (topic === "robots") views.fleet.takeRobots(value);
  else if (topic === "event") { views.events.take(value); views.fleet.takeEvent(value); }
  else if (topic === "audit") views.events.take(value);
  else if (topic === "pose") views.poses.take(value);
  else if (topic === "link") linked(value.connected, value.connected ? "live" : value.text ?? "the control plane does not answer");
  else if (topic === "maps") views.map.takeMaps(value);
  else if (topic.startsWith("live/")) views.map.take(key, value);
}

// Hide the views and the button that the page of a deployment on AWS does not have: maps and poses stay on the servers,
// and the page cannot operate them.
function onlyCloud() {
  if (!isShown("map")) return;
  for (const name of ["map", "poses"]) byId(`tab-${name}`).hidden = true;
  byId("operate").hidden = true;
  if (!byId("view-map").hidden || !byId("view-poses").hidden) show("fleet");
}

// Subscribe to the live map *name*, none if it is empty: the stream is requested again with other topics.
function changeMap(name) {
  liveMap = name;
  aborted.abort();
}

async function run() {
  useTheme(localStorage.getItem("rse-pf theme")
    ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
  show(sessionStorage.getItem("rse-pf view") ?? "fleet");
  if (!(await openSession())) return needsKey();
  operatorChanged();
  for (;;) {
    aborted = new AbortController();
    let ended = { status: 0 };
    try {
      const topics = liveMap ? [...TOPICS, `live/${liveMap}`] : TOPICS;
      ended = await follow(topics, take, () => Object.values(views).forEach((view) => view.reset?.()), aborted.signal);
    } catch (error) {
      if (error.name === "AbortError") continue;
    }
    if (ended.status === 401) return needsKey();
    linked(false, ended.status === 503 ? ended.body.message : "the page's server does not answer");
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

// Show that the page has no valid session, instead of the views.
function needsKey() {
  forget();
  linked(false, "no session");
  for (const name of VIEWS) byId(`view-${name}`).hidden = true;
  byId("view-key").hidden = false;
  byId("view-key").replaceChildren(element("div", { class: "panel empty" },
    element("h3", {}, "This page needs a key"),
    element("p", {}, "Print a new address with ", element("code", {}, "rse-pf fleet"),
      " on the machine of the platform. A key works once.")));
}

setInterval(() => {
  if (lastMessageMs && performance.now() - lastMessageMs > 12000) linked(false, "no message for 12 s");
}, 1000);
run();
