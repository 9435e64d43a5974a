// The Events view: a timeline, filters, and a list of events; the events that match the filters can be saved as a file.

import { clock, element } from "./dom.js";

// Groups of events, in the order of the filters, with their titles.
const GROUPS = { trouble: "Trouble", fault: "Faults", scaling: "Scaling and moves", audit: "Audit", other: "Other" };
const KEPT = 2000; // largest number of events in memory
const SHOWN = 400; // largest number of events in the list
const TIMELINE_S = 600; // time that the timeline covers, in seconds

// Create the view in the element *root*; *count* is the element with the number of unseen events.
export function eventsView(root, count) {
  let events = [];
  let unseen = 0;
  let due = false;
  const boxes = Object.fromEntries(Object.keys(GROUPS).map((group) =>
    [group, element("input", { type: "checkbox", checked: true, onchange: draw })]));
  const word = element("input", { type: "search", placeholder: "server, robot, word", "aria-label": "Only events that contain", oninput: draw });
  const body = element("tbody");
  const timeline = element("canvas", { class: "timeline", role: "img", "aria-label": "Events of the last ten minutes" });
  const empty = element("div", { class: "empty" }, "Nothing happened yet.");
  root.append(element("div", { class: "panel" }, element("h2", {}, "The last ten minutes"), timeline),
    element("div", { class: "panel" },
      element("div", { class: "filters" },
        ...Object.entries(GROUPS).map(([group, title]) => element("label", {}, boxes[group], title)), word,
        element("button", { onclick: save }, "Export…")),
      element("div", { class: "scroll" }, element("table", {},
        element("caption", { class: "hidden" }, "Events, newest first"),
        element("thead", {}, element("tr", {}, element("th", { scope: "col" }, "Time"), element("th", { scope: "col" }, "Kind"), element("th", { scope: "col" }, "What happened"))), body)), empty));

  const chosen = () => events.filter((event) => boxes[event.group]?.checked
    && `${event.kind} ${event.text}`.toLowerCase().includes(word.value.toLowerCase()));

  function draw() {
    due = false;
    if (root.hidden) return;
    const rows = chosen().slice(-SHOWN).reverse();
    empty.hidden = rows.length > 0;
    body.replaceChildren(...rows.map((event) => element("tr", {},
      element("td", {}, element("time", { datetime: new Date(event.time_s * 1000).toISOString() }, clock(event.time_s))),
      element("td", {}, element("span", { class: "kind", "data-group": event.group }, event.kind)),
      element("td", {}, event.text))));
    drawTimeline();
  }

  function drawTimeline() {
    const ratio = devicePixelRatio || 1;
    const [width, height] = [timeline.clientWidth, timeline.clientHeight];
    timeline.width = width * ratio;
    timeline.height = height * ratio;
    const pen = timeline.getContext("2d");
    pen.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const names = { trouble: "--bad", fault: "--warn", scaling: "--accent", audit: "--focus", other: "--soft" };
    const end = Date.now() / 1000;
    pen.fillStyle = style.getPropertyValue("--line");
    pen.fillRect(0, height - 15, width, 1);
    pen.fillStyle = style.getPropertyValue("--soft");
    pen.font = "11px system-ui, sans-serif";
    for (let minute = 0; minute <= 10; minute += 2) {
      const x = width * (1 - minute / 10);
      pen.textAlign = minute === 0 ? "right" : minute === 10 ? "left" : "center";
      pen.fillText(minute ? `${minute} min ago` : "now", x, height - 3);
    }
    for (const event of chosen()) {
      const x = width * (1 - (end - event.time_s) / TIMELINE_S);
      if (x < 0) continue;
      pen.fillStyle = style.getPropertyValue(names[event.group]);
      const level = Object.keys(GROUPS).indexOf(event.group);
      pen.fillRect(Math.min(x, width - 4), 2 + level * 7, 4, 6);
    }
  }

  function save() {
    const text = chosen().map((event) => JSON.stringify(event)).join("\n");
    const link = element("a", { href: URL.createObjectURL(new Blob([`${text}\n`], { type: "application/jsonl" })), download: "rse-pf-events.jsonl" });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  return {
    take(event) {
      let at = events.length;  // rows of the audit log arrive a little later than events of the same time
      while (at > 0 && events[at - 1].time_s > event.time_s) at -= 1;
      events.splice(at, 0, event);
      if (events.length > KEPT) events = events.slice(-KEPT);
      if (root.hidden && event.group !== "audit") count.textContent = String(++unseen);
      else if (!root.hidden && !due) { due = true; requestAnimationFrame(draw); }
    },
    reset() { events = []; unseen = 0; count.textContent = ""; },
    shown() { unseen = 0; count.textContent = ""; draw(); },
    themed: drawTimeline,
  };
}
