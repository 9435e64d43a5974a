// Helpers for the document: elements whose strings are never parsed as HTML, and numbers and times as text.

// Return a new element.  An attribute "onEVENT" is a listener; null, undefined and false leave an attribute out.
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export const byId = (id) => document.getElementById(id);

// Set the text of *node* only if it differs, so that screen readers are not notified without a change.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// Return *value* with *digits* decimals as text; a dash for an unknown value.
export function number(value, digits = 0) {
  return value === null || value === undefined ? "–" : Number(value).toFixed(digits);
}

// Return a duration as text in its largest fitting unit; a dash for an unknown one.
export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  for (const [size, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (seconds >= size) return `${(seconds / size).toFixed(1)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

// Return the local time of day of *timeS*, Unix seconds.
export function clock(timeS) {
  return new Date(timeS * 1000).toLocaleTimeString("en-GB");
}

// Symbols of states, so that states do not differ by colour only.
const MARKS = {
  healthy: "●", runs: "●", starting: "◔", draining: "▽", unhealthy: "▲", gone: "✕", weak: "▲", failed: "✕",
};

// Return an element with the state *text* and its symbol.
export function state(text) {
  return element("span", { class: "state", "data-state": text }, `${MARKS[text] ?? "○"} ${text}`);
}

// Show *text* at the corner of the page for 6 s.
export function toast(text) {
  const box = byId("toast");
  box.textContent = text;
  box.toggleAttribute("data-on", true);
  clearTimeout(toast.timer);
  toast.timer = setTimeout(() => box.toggleAttribute("data-on", false), 6000);
}

// Show a dialog with the button *button*, and with an input field if *input* holds its attributes.  The promise
// resolves to the text of the field (true without a field) when the button is pressed, and to null on cancel.
export function confirmed({ title, text, button, input }) {
  const dialog = byId("dialog");
  return new Promise((resolve) => {
    const field = input ? element("input", { ...input, id: "dialog-input" }) : null;
    const done = (value) => { dialog.close(); resolve(value); };
    const form = element("form", {
      method: "dialog",
      onsubmit: (event) => { event.preventDefault(); done(field ? field.value.trim() : true); },
    },
    element("h3", { id: "dialog-title" }, title),
    element("p", {}, text),
    field && element("p", {}, element("label", { for: "dialog-input" }, `${input["aria-label"]} `), field),
    element("div", { class: "end" },
      element("button", { type: "button", onclick: () => done(null) }, "Cancel"),
      element("button", { class: "danger", id: "dialog-do" }, button)));
    dialog.replaceChildren(form);
    dialog.oncancel = () => resolve(null);
    dialog.showModal();
    (field ?? form.querySelector("#dialog-do")).focus();
  });
}
