// The Map view: a live map as it grows, or a version; three.js is loaded when the view is shown first.

import { clock, element, setText } from "./dom.js";
import { ask, get } from "./session.js";

export function mapView(root, changeMap) {
  const choice = element("select", { "aria-label": "Map", onchange: choose });
  const canvas = element("canvas", { tabindex: "0", role: "img", "aria-label": "Map. Arrow keys turn it, plus and minus come nearer and go back." });
  const labels = element("div", { class: "maplabels", "aria-hidden": "true" });
  const note = element("div", { class: "soft", "aria-live": "polite" });
  const robots = element("tbody");
  const log = element("div", {});
  const empty = element("div", { class: "empty" }, "No map is chosen. Robots make live maps with robot.live_map(NAME); versions come with rse-pf map publish.");
  root.append(element("div", { class: "filters" }, choice,
    element("button", { onclick: () => scene?.home() }, "Whole map"), note),
  element("div", { class: "mapgrid" },
    element("div", { class: "mapbox" }, canvas, labels, empty),
    element("div", {},
      element("div", { class: "panel" }, element("h2", {}, "Robots"), element("table", {},
        element("caption", { class: "hidden" }, "Robots of the map"), robots)),
      element("div", { class: "panel" }, element("h2", {}, "Joins and corrections"), log))));

  let scene = null;
  let visible = false;
  let known = { live: [], maps: [] };
  let chosen = "";
  let state = new Map();
  let entries = [];

  async function shown() {
    visible = true;
    await readMaps();
    if (!scene) {
      const { MapScene } = await import("./scene.js");
      scene = new MapScene(canvas, labels);
      if (chosen) await load();
    }
    scene.run(true);
  }

  async function readMaps() {
    try {
      known.maps = await get("/page/maps");
    } catch (error) {
      setText(note, error.message);
    }
    fill();
  }

  function fill() {
    const options = [["", "Choose a map"], ...known.live.map((name) => [`live:${name}`, `${name} (live)`])];
    for (const { map, versions } of known.maps) {
      for (const version of versions.slice(0, 20)) options.push([`version:${map}:${version.id}`, `${map}, version ${version.number}`]);
    }
    const told = JSON.stringify(options);
    if (choice.dataset.told === told) return;
    choice.dataset.told = told;
    choice.replaceChildren(...options.map(([value, title]) => element("option", { value }, title)));
    if (!options.some(([value]) => value === chosen) || !chosen) {
      const first = options[1]?.[0] ?? "";
      if (first && !chosen) { choice.value = first; choose(); return; }
    }
    choice.value = chosen;
  }

  async function choose() {
    chosen = choice.value;
    state = new Map();
    entries = [];
    log.replaceChildren();
    robots.replaceChildren();
    changeMap(chosen.startsWith("live:") ? chosen.slice(5) : "");
    await load();
  }

  async function load() {
    empty.hidden = chosen !== "";
    if (!scene || !chosen) return;
    scene.clear();
    const [kind, map, version] = chosen.split(":");
    const has = known.maps.find((each) => each.map === map);
    if (kind === "live" && !has) { setText(note, "The cloud comes with the first version: rse-pf map publish."); return; }
    setText(note, "loading");
    const began = performance.now();
    const answer = await ask(`/page/cloud?${new URLSearchParams({ map, version: version ?? "" })}`);
    if (!answer.ok) { setText(note, (await answer.json()).message); return; }
    const told = scene.cloud(await answer.arrayBuffer(), kind === "version");
    const all = told.all_points > told.points ? ` of ${told.all_points.toLocaleString("en")}` : "";
    setText(note, `${told.points.toLocaleString("en")}${all} points in ${((performance.now() - began) / 1000).toFixed(1)} s`);
    if (kind === "version") {
      robots.replaceChildren(...Object.entries(told.robots).map(([name, path]) => row(name, `${path.length} keyframes`)));
    }
  }

  const row = (name, text) => element("tr", {}, element("th", { scope: "row" },
    coloured(name), ` ${name}`), element("td", { class: "number" }, text));

  function coloured(name) {
    const dot = element("span", { class: "dot", "aria-hidden": "true" });
    if (scene) dot.style.background = scene.colour(name);
    return dot;
  }

  function take(key, value) {
    const before = state.get(key);
    state.set(key, value);
    if (value.kind === "alignment") {
      const moved = before && before.segment === value.segment && before.T_map_odom && value.T_map_odom ? distance(before.T_map_odom, value.T_map_odom) : null;
      if (value.aligned && !before?.aligned) tell(`${value.robot} joined the map`);
      else if (!value.aligned && before?.aligned) tell(`${value.robot} left the map: ${value.reason}`);
      else if (moved > 0.001) tell(`${value.robot} was moved by ${(moved * 100).toFixed(1)} cm${value.cause ? `, by a keyframe of ${value.cause.robot}` : ""}`);
    }
    if (value.kind === "map") setText(note, `${value.keyframes} keyframes, ${value.state}${value.owner ? `, owner ${value.owner}` : ""}`);
    scene?.update(state);
    if (visible) draw();
  }

  function draw() {
    const rows = [...state].filter(([, value]) => value.kind === "alignment").map(([, value]) => {
      const spread = value.covariance ? `± ${(100 * Math.sqrt(Math.max(value.covariance[0], value.covariance[6], value.covariance[11]))).toFixed(1)} cm` : "";
      return row(value.robot, value.aligned ? `in the map ${spread}` : `outside: ${value.reason || "not joined yet"}`);
    });
    robots.replaceChildren(...rows);
  }

  function tell(text) {
    entries = [{ text, time: Date.now() / 1000 }, ...entries].slice(0, 12);
    log.replaceChildren(...entries.map((each) => element("div", {}, element("time", { class: "soft" }, clock(each.time)), ` ${each.text}`)));
  }

  return {
    take,
    takeMaps(names) { known.live = names; if (visible) fill(); },
    shown() { shown().catch((error) => setText(note, error.message)); },
    hidden() { visible = false; scene?.run(false); },
    themed() { scene?.themed(); },
    reset() { state = new Map(); },
  };
}

function distance(a, b) {
  return Math.hypot(a[3] - b[3], a[7] - b[7], a[11] - b[11]);
}
