// The Map view; what draws it is loaded when it is shown first.

import { element } from "./dom.js";

export function mapView(root, changeMap) {
  root.append(element("div", { class: "panel empty" }, "No map is chosen."));
  return { take() {}, changeMap };
}
