// The Map view: a live map as it grows, or a stored version.  three.js is loaded when the view is first shown, or
// shortly after another view was.

import { byId, clock, element, setText } from "./dom.js";
import { ask, get } from "./session.js";

const PREPARE_MS = 300; // delay after the stream began before three.js and the list of maps are loaded
const GROW_MS = 5000; // time between two checks for a new version of a live map
const STATE_MS = 1500; // alignments within this time after the stream began are the present state, not new events

// Create the view in the element *root*; changeMap(name) subscribes to a live map, "" to none.
export function mapView(root, changeMap) {
  const choice = element("select", { "aria-label": "Map", onchange: choose });
  const canvas = element("canvas", { tabindex: "0", role: "img", "aria-label": "Map. Arrow keys rotate it, plus and minus zoom." });
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

  let readCloud = null;
  let preparing = null;
  let isLoaded = false;
  let scene = null;
  let visible = false;
  let known = { live: [], maps: [] };
  let chosen = "";
  let state = new Map();
  let entries = [];
  let openedAt = 0;
  let due = false;
  let newest = ""; // version of the live map whose cloud is shown
  setInterval(() => { grow().catch((error) => setText(note, error.message)); }, GROW_MS);

  const newestOf = (map) => known.maps.find((each) => each.map === map)?.versions[0]?.id ?? "";

  // Load the new cloud of the live map that is shown, if a new version of it was published.
  async function grow() {
    if (!visible || document.hidden || !chosen.startsWith("live:")) return;
    await readMaps();
    if (chosen.startsWith("live:") && newestOf(chosen.slice(5)) !== newest) await load(true);
  }

  async function shown() {
    visible = true;
    await Promise.all([readMaps(), prepared()]);
    scene.run(visible);
    if (chosen && !isLoaded) await load();
  }

  // Load the modules of this view, once; return a promise that resolves when the scene can draw.
  function prepared() {
    preparing ??= Promise.all([import("./scene.js"), import("./cloud.js")]).then(([{ MapScene }, cloud]) => {
      ({ readCloud } = cloud);
      scene = new MapScene(canvas, labels);
      scene.warmUp();
    });
    return preparing;
  }

  async function prepare() {
    if (preparing || byId("tab-map").hidden) return;
    await Promise.all([prepared(), get("/page/maps")]); // this request also lets the server pack the first map
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
      for (const version of versions.slice(0, 20)) options.push([`version:${map}:${version.id}`, `${map}, version ${version.number}${version.points ? "" : ", no points"}`]);
    }
    const text = JSON.stringify(options);
    if (choice.dataset.options === text) return;
    choice.dataset.options = text;
    choice.replaceChildren(...options.map(([value, title]) => element("option", { value }, title)));
    if (!options.some(([value]) => value === chosen) || !chosen) {
      const first = options[1]?.[0] ?? "";
      if (first && !chosen) { choice.value = first; choose(); return; }
    }
    choice.value = chosen;
  }

  async function choose() {
    chosen = choice.value;
    isLoaded = false;
    state = new Map();
    entries = [];
    log.replaceChildren();
    robots.replaceChildren();
    changeMap(chosen.startsWith("live:") ? chosen.slice(5) : "");
    await load().catch((error) => setText(note, error.message));
  }

  async function load(isGrown = false) {
    empty.hidden = chosen !== "";
    if (!scene || !chosen) return;
    isLoaded = true;
    if (!isGrown) scene.clear();
    const [kind, map, version] = chosen.split(":");
    const has = known.maps.find((each) => each.map === map);
    if (kind === "live" && !has) { setText(note, "The cloud comes with the first version: rse-pf map publish."); return; }
    setText(note, "loading");
    const began = performance.now();
    const seconds = () => ((performance.now() - began) / 1000).toFixed(1);
    const wanted = chosen;
    const answer = await ask(`/page/cloud?${new URLSearchParams({ map, version: version ?? "" })}`);
    if (!answer.ok) { setText(note, (await answer.json()).message); return; }
    let sample = null;
    const header = await readCloud(answer, () => chosen === wanted, (head) => {
      scene.begin(head, kind === "version");
      if (kind === "live") scene.update(state);
      sample = scene.drawn(Math.min(head.points, head.block)).then(() => {
        performance.mark("map-sample");
        if (note.dataset.points !== "all") setText(note, `a sample in ${seconds()} s, loading`);
      });
      note.dataset.points = "some";
      if (kind === "version") {
        robots.replaceChildren(...Object.entries(head.robots).map(([name, path]) => row(name, `${path.length} keyframes`)));
      }
    }, (bytes, count) => scene.more(bytes, count));
    if (!header) return;
    await sample;
    await scene.drawn(header.points);
    if (chosen !== wanted) return;
    performance.mark("map-whole");
    note.dataset.points = "all";
    newest = newestOf(map);
    if (!header.points) {
      const count = Object.values(header.robots).reduce((sum, path) => sum + path.length, 0);
      setText(note, `This version has no points: ${count} keyframes of ${Object.keys(header.robots).length} robots.`);
      return;
    }
    const all = header.all_points > header.points ? ` of ${header.all_points.toLocaleString("en")}` : "";
    setText(note, `${header.points.toLocaleString("en")}${all} points in ${seconds()} s`);
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
      const isNews = before !== undefined || performance.now() - openedAt > STATE_MS;
      if (value.aligned && !before?.aligned) { if (isNews) addEntry(`${value.robot} joined the map`); }
      else if (!value.aligned && before?.aligned) addEntry(`${value.robot} left the map: ${value.reason}`);
      else if (moved > 0.001) addCorrection(value.robot, value.cause?.robot, moved);
    }
    if (value.kind === "map") setText(note, `${value.keyframes} keyframes, ${value.state}${value.owner ? `, served by ${value.owner}` : ""}${scene?.hasCloud ? "" : "; squares of 1 m"}`);
    if (!due) { due = true; requestAnimationFrame(drawState); }
  }

  function drawState() {
    due = false;
    scene?.update(state);
    if (visible) draw();
  }

  function draw() {
    const rows = [...state].filter(([, value]) => value.kind === "alignment").map(([, value]) => {
      const spread = value.covariance ? `± ${(100 * Math.sqrt(Math.max(value.covariance[0], value.covariance[6], value.covariance[11]))).toFixed(1)}\u00a0cm` : "";
      return row(value.robot, value.aligned ? `in the map ${spread}` : `outside: ${value.reason || "not joined yet"}`);
    });
    for (const [, value] of state) {
      if (value.kind === "history" && !state.has(`alignment/${value.robot}`)) rows.push(row(value.robot, "has left"));
    }
    robots.replaceChildren(...rows);
  }

  // Add a correction of *robot*, caused by a keyframe of the robot *cause*, that moved it by *moved* metres.  All
  // corrections of the same robots within a minute share one entry, so that entries about joins remain visible.
  function addCorrection(robot, cause, moved) {
    const same = entries.find((each) => each.robot === robot && each.cause === cause && Date.now() / 1000 - each.time < 60);
    const [count, most] = [(same?.count ?? 0) + 1, Math.max(same?.most ?? 0, moved)];
    entries = entries.filter((each) => each !== same);
    const times = count === 1 ? "was moved by" : `was moved ${count} times, by at most`;
    const by = cause ? `, by ${count === 1 ? "a keyframe" : "keyframes"} of ${cause === robot ? "its own" : cause}` : "";
    addEntry(`${robot} ${times} ${(most * 100).toFixed(1)}\u00a0cm${by}`, { robot, cause, count, most });
  }

  // Show *text* as the newest of at most 12 entries under "Joins and corrections".
  function addEntry(text, more = {}) {
    entries = [{ text, time: Date.now() / 1000, ...more }, ...entries].slice(0, 12);
    log.replaceChildren(...entries.map((each) => element("div", {}, element("time", { class: "soft" }, clock(each.time)), ` ${each.text}`)));
  }

  return {
    take,
    takeMaps(names) { known.live = names; if (visible) fill(); },
    shown() { shown().catch((error) => setText(note, error.message)); },
    hidden() { visible = false; scene?.run(false); },
    themed() { scene?.themed(); },
    reset() {
      state = new Map();
      openedAt = performance.now();
      setTimeout(() => { prepare().catch((error) => setText(note, error.message)); }, PREPARE_MS);
    },
  };
}

// Return the distance between the positions of two poses, each 16 numbers of a 4x4 matrix, in metres.
function distance(a, b) {
  return Math.hypot(a[3] - b[3], a[7] - b[7], a[11] - b[11]);
}
