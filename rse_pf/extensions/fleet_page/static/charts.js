// Line charts of a value over time, drawn by uPlot in the colours of the page's theme.

import uPlot from "./vendor/uPlot.esm.js";

const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Return a chart inside the element *parent*: set(times, values) draws it, with times in Unix seconds and null for an
// unknown value; themed() draws it again after a change of the theme.  *top* is the least upper end of the y axis.
export function chart(parent, { title, unit, digits, top }) {
  let plot = null;
  let data = [[], []];
  const make = () => {
    plot?.destroy();
    const axis = { stroke: colour("--soft"), grid: { stroke: colour("--line"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    plot = new uPlot({
      width: Math.max(parent.clientWidth, 240),
      height: 160,
      cursor: { drag: { x: false, y: false } },
      legend: { show: false },
      scales: { y: { range: (u, low, high) => [0, Math.max(top ?? 0, (high ?? 0) * 1.1, 5)] } },
      axes: [{ ...axis, size: 28, values: (u, times) => times.map((t) => new Date(t * 1000).toLocaleTimeString("en-GB")), space: 90 },
        { ...axis, size: 46, values: (u, values) => values.map((v) => v.toFixed(v < 10 && digits ? 1 : 0)) }],
      series: [{}, { stroke: colour("--accent"), width: 2, spanGaps: false, points: { show: false } }],
    }, data, parent);
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", title);
  };
  const observer = new ResizeObserver(() => {
    if (parent.clientWidth && plot) plot.setSize({ width: parent.clientWidth, height: 160 });
  });
  observer.observe(parent);
  return {
    set(times, values) {
      data = [times, values];
      if (!parent.clientWidth) return;
      if (!plot) make();
      else plot.setData(data);
      const last = values[values.length - 1];
      plot.root.setAttribute("aria-label", `${title}: now ${last === null ? "unknown" : `${last} ${unit}`}`);
    },
    themed() { if (plot) make(); },
  };
}
