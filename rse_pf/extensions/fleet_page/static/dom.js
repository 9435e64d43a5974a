// Small helpers: elements whose texts are always text, numbers and times for people.

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

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function number(value, digits = 0) {
  return value === null || value === undefined ? "–" : Number(value).toFixed(digits);
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  for (const [size, unit] of [[86400, "d"], [3600, "h"], [60, "min"]]) {
    if (seconds >= size) return `${(seconds / size).toFixed(1)} ${unit}`;
  }
  return `${Math.round(seconds)} s`;
}

export function clock(timeS) {
  return new Date(timeS * 1000).toLocaleTimeString("en-GB");
}

const MARKS = {
  healthy: "●", runs: "●", starting: "◔", draining: "▽", unhealthy: "▲", gone: "✕", weak: "▲", failed: "✕",
};

export function state(text) {
  return element("span", { class: "state", "data-state": text }, `${MARKS[text] ?? "○"} ${text}`);
}

export function toast(text) {
  const box = byId("toast");
  box.textContent = text;
  box.toggleAttribute("data-on", true);
  clearTimeout(toast.timer);
  toast.timer = setTimeout(() => box.toggleAttribute("data-on", false), 6000);
}

export function confirmed({ title, text, button, input }) {
  // Resolves to the text of the input (or true) when the button is pressed, to null otherwise.
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
