// The Poses view: a list of weak and failed commands; a click on a command opens the replay of that command.

import { byId, clock, element, number, state } from "./dom.js";
import { get } from "./session.js";

const KEPT = 500; // largest number of commands in memory
const SHOWN = 200; // largest number of commands in the list

// Create the view in the element *root*; *count* is the element with the number of unseen commands.
export function posesView(root, count) {
  let rows = [];
  let unseen = 0;
  let due = false;
  const word = element("input", { type: "search", placeholder: "robot, reason", "aria-label": "Only commands that contain", oninput: draw });
  const body = element("tbody");
  const empty = element("div", { class: "empty" }, "No command was weak or failed since this page was opened.");
  root.append(element("div", { class: "panel" },
    element("div", { class: "filters" }, element("h2", {}, "Weak and failed commands"), word,
      element("span", { class: "soft" }, "Choose one to see why (needs rse-pf local --record).")),
    element("div", { class: "scroll" }, element("table", {},
      element("caption", { class: "hidden" }, "Weak and failed commands, newest first"),
      element("thead", {}, element("tr", {}, ...["Time", "Result", "Robot", "Service", "Server"].map((each) => element("th", { scope: "col" }, each)),
        element("th", { scope: "col", class: "number" }, "Computed, ms"), element("th", { scope: "col" }, "Reason"))), body)), empty));

  function draw() {
    due = false;
    if (root.hidden) return;
    const needle = word.value.toLowerCase();
    const shown = rows.filter((row) => `${row.robot} ${row.code} ${row.reason ?? ""}`.toLowerCase().includes(needle)).slice(-SHOWN).reverse();
    empty.hidden = shown.length > 0;
    body.replaceChildren(...shown.map((row) => element("tr", {
      class: "opens", tabindex: "0", role: "button", "aria-label": `open the replay of a command of ${row.robot}`,
      onclick: () => open(row), onkeydown: (event) => { if (event.key === "Enter") open(row); },
    },
    element("td", {}, element("time", {}, clock(row.time_s))),
    element("td", {}, state(row.verdict === "weak" ? "weak" : "failed")),
    element("td", {}, row.robot ?? "–"), element("td", {}, row.service ?? "–"), element("td", {}, row.server ?? "–"),
    element("td", { class: "number" }, number(row.compute_ms, 2)),
    element("td", {}, row.verdict === "weak" ? (row.reason ?? "weak") : row.code))));
  }

  async function open(row) {
    const dialog = byId("dialog");
    const place = element("div", { "aria-live": "polite" }, element("p", {}, "Solving the same bytes again…"));
    dialog.replaceChildren(element("h3", { id: "dialog-title" }, `Why was this command ${row.verdict === "weak" ? "weak" : "refused"}?`), place,
      element("div", { class: "end" }, element("button", { onclick: () => dialog.close(), autofocus: true }, "Close")));
    dialog.showModal();
    try {
      const replay = await get(`/page/replay?${new URLSearchParams({ trace: row.trace ?? "", id: String(row.id ?? ""), time_s: String(row.time_s), bytes: String(row.bytes_in ?? 0) })}`);
      place.replaceChildren(...replayElements(replay));
    } catch (error) {
      place.replaceChildren(element("p", {}, error.message));
    }
  }

  function replayElements(replay) {
    const parts = [element("p", { id: "replay-equal" }, replay.equal === null ? "The answer was not recorded." : replay.equal
      ? "Solved again: the answer is the same, byte for byte." : "Solved again: the answer differs from the one that was sent.")];
    if (replay.picture) parts.push(element("p", {}, element("img", { src: replay.picture, alt: "matches: inliers and outliers" })),
      element("p", { class: "soft" }, "Blue dots are inliers, orange crosses are outliers; a line leads to the pixel at which the pose projects the point."));
    for (const line of replay.lines ?? []) parts.push(element("div", { class: "soft" }, line));
    if (replay.command) parts.push(element("p", { class: "soft" }, "On the command line: ", element("code", {}, `rse-pf replay ${replay.path} --command ${replay.command}`)));
    return parts;
  }

  return {
    take(row) {
      rows.push(row);
      if (rows.length > KEPT) rows = rows.slice(-KEPT);
      if (root.hidden) count.textContent = String(++unseen);
      else if (!due) { due = true; requestAnimationFrame(draw); }
    },
    reset() { rows = []; unseen = 0; count.textContent = ""; },
    shown() { unseen = 0; count.textContent = ""; draw(); },
  };
}
