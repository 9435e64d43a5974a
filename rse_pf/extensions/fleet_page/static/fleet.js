// The Fleet view: the six boxes of the paper's Fig. 2, the servers, the robots on each server, and charts.

import { chart } from "./charts.js";
import { clock, confirmed, duration, element, number, setText, state, toast } from "./dom.js";
import { isOperator, post } from "./session.js";

const MAX_DOTS = 500; // largest number of robots that are drawn as dots
const MAX_LISTED = 200; // largest number of robots in the table

// Create the view in the element *root*; its methods take the values of the topics of the stream.
export function fleetView(root) {
  const box = (title) => {
    const big = element("div", { class: "big" }, "–");
    const small = element("div", { class: "soft" });
    return { panel: element("div", { class: "panel" }, element("h2", {}, title), big, small), big, small };
  };
  const boxes = {
    robots: box("Robots"), firewall: box("Firewall"), balancer: box("Load balancer"),
    servers: box("Backend servers"), monitor: box("Monitor"), modifier: box("Scale modifier"),
  };
  const waiting = element("div", {});
  const waitingPanel = element("div", { class: "panel waiting", "aria-live": "polite" },
    element("h2", {}, "When servers are added or removed next"), waiting);
  const charts = {};
  const chartPanels = [
    ["cpu", "CPU of the servers, %", { unit: "%", top: 100 }],
    ["requests", "Commands a second", { unit: "commands" }],
    ["p99", "Time to answer, 99 % within, ms", { unit: "ms", digits: 1 }],
  ].map(([name, title, options]) => {
    const place = element("div", { class: "chart" });
    charts[name] = chart(place, { title, ...options });
    return element("div", { class: "panel" }, element("h2", {}, title), place);
  });
  const rows = element("tbody");
  const rollButton = element("button", { class: "danger", id: "do-roll", onclick: () => operate("roll") }, "Roll all…");
  const rollBox = element("span", { class: "buttons", hidden: true }, rollButton);
  const actionsHead = element("th", { hidden: true }, "Operate");
  const serverPanel = element("div", { class: "panel" },
    element("div", { class: "filters" }, element("h2", {}, "Servers"), rollBox),
    element("div", { class: "scroll" }, element("table", {},
      element("caption", { class: "hidden" }, "Backend servers"),
      element("thead", {}, element("tr", {},
        element("th", { scope: "col" }, "Server"), element("th", { scope: "col" }, "Health"),
        element("th", { scope: "col" }, "CPU"), element("th", { scope: "col", class: "number" }, "Robots"),
        element("th", { scope: "col", class: "number" }, "Commands/s"),
        element("th", { scope: "col", class: "number" }, "Queue"), element("th", { scope: "col", class: "number" }, "Wait, ms"),
        element("th", { scope: "col", class: "number" }, "Age"), actionsHead)), rows)));
  const racks = element("div", { class: "racks" });
  const racksNote = element("p", { class: "soft" });
  const recent = element("div", {});
  const robotRows = element("tbody");
  const robotsNote = element("p", { class: "soft" });
  const head = (title, kind = null) => element("th", { scope: "col", class: kind }, title);
  const robotsPanel = element("div", { class: "panel" }, element("h2", {}, "Robots"),
    element("div", { class: "scroll tall" }, element("table", { id: "robots" },
      element("caption", { class: "hidden" }, "Connected robots"),
      element("thead", {}, element("tr", {}, head("Tenant"), head("Robot"), head("Server"), head("Connected for", "number"),
        head("Commands", "number"), head("Last answer"))), robotRows)), robotsNote);
  const racksPanel = element("div", { class: "panel" }, element("h2", {}, "Robots on their servers"), racks, racksNote);
  const unknown = element("ul", { class: "soft" });
  const cloudPanels = element("div", { class: "grid wide", hidden: true },
    element("div", { class: "panel" }, element("h2", {}, "Data that AWS does not provide"), unknown));
  root.append(
    element("div", { class: "grid" }, ...Object.values(boxes).map((each) => each.panel)),
    waitingPanel,
    serverPanel,
    robotsPanel,
    cloudPanels,
    element("div", { class: "grid wide" }, ...chartPanels),
    element("div", { class: "grid wide" }, racksPanel,
      element("div", { class: "panel" }, element("h2", {}, "Latest events"), recent)));

  const lines = new Map();
  const dots = new Map();
  let history = null;
  let latest = [];

  function take(fleet) {
    const rate = fleet.requests;
    setText(boxes.robots.big, number(fleet.robots));
    setText(boxes.robots.small, fleet.cloud ? `${number(rate, 1)} commands a second in the last minute` : `${number(rate)} commands in the last second`);
    setText(boxes.firewall.big, fleet.tls ? "TLS, tokens" : fleet.cloud ? fleet.protocols.join(", ") || "not known" : "this machine only");
    setText(boxes.firewall.small, fleet.url || "nobody can connect yet");
    setText(boxes.balancer.big, fleet.balancer ? "runs" : fleet.cloud ? fleet.balancer_state : "is down");
    setText(boxes.balancer.small, `${megabytes(fleet.bytes_in)} in, ${megabytes(fleet.bytes_out)} out a second`);
    const healthy = fleet.servers.filter((server) => server.state === "healthy").length;
    setText(boxes.servers.big, `${healthy} of ${fleet.servers.length}`);
    setText(boxes.servers.small, fleet.cloud ? `healthy; the group wants ${fleet.wanted_servers}` : `healthy; data servers: ${fleet.data_servers.map((each) => `${each.name} ${each.state}`).join(", ") || "none"}`);
    setText(boxes.monitor.big, fleet.cpu_percent === null ? "–" : `${number(fleet.cpu_percent)} % CPU`);
    const p = fleet.percentiles ?? {};
    setText(boxes.monitor.small, p.count
      ? `last ${Math.round(p.covered_s)} s: p50 ${p.p50_ms}, p95 ${p.p95_ms}, p99 ${p.p99_ms} ms of ${p.count} commands`
      : fleet.cloud ? "no answer times were published"
        : p.covered_s ? `no command in the last ${p.covered_s < 59 ? `${Math.round(p.covered_s)} s` : "minute"}` : "answer times are being read");
    setText(boxes.modifier.big, `${fleet.min_servers ?? "–"} to ${fleet.max_servers ?? "–"}`);
    setText(boxes.modifier.small, `servers; busy above ${number(fleet.busy_percent)} % CPU, measured every ${number(fleet.period_s)} s${fleet.last_action ? `; last: ${fleet.last_action}` : ""}`);
    const sentences = fleet.waiting.map((text) => `${text[0].toUpperCase()}${text.slice(1)}.`);
    if (waiting.dataset.text !== sentences.join("\n")) {
      waiting.dataset.text = sentences.join("\n");
      waiting.replaceChildren(...sentences.map((text) => element("p", {}, text)));
    }
    takeServers(fleet.servers);
    cloudPanels.hidden = !fleet.cloud;
    racksPanel.hidden = robotsPanel.hidden = Boolean(fleet.cloud);
    if (fleet.cloud) takeCloud(fleet);
  }

  function takeCloud(fleet) {
    const text = JSON.stringify(fleet.unknown);
    if (unknown.dataset.text === text) return;
    unknown.dataset.text = text;
    unknown.replaceChildren(...fleet.unknown.map((each) => element("li", {}, `${each[0].toUpperCase()}${each.slice(1)}.`)));
  }

  function takeServers(servers) {
    const names = new Set(servers.map((server) => server.name));
    for (const [name, line] of lines) if (!names.has(name)) { line.row.remove(); lines.delete(name); }
    for (const server of servers) {
      let line = lines.get(server.name);
      if (!line) {
        line = newLine(server.name);
        lines.set(server.name, line);
        rows.append(line.row);
      }
      if (line.health.dataset.state !== server.state) {
        line.health.dataset.state = server.state;
        line.health.replaceChildren(state(server.state));
      }
      line.health.title = server.note ?? "";
      const cpu = server.cpu_percent;
      line.fill.style.width = `${Math.min(cpu ?? 0, 100)}%`;
      line.bar.dataset.level = cpu >= 70 ? "high" : "normal";
      setText(line.cpu, cpu === null || cpu === undefined ? "–" : `${number(cpu)} %${server.warming ? " (warms up)" : ""}`);
      setText(line.robots, number(server.robots));
      setText(line.requests, number(server.requests));
      setText(line.queue, number(server.queue));
      setText(line.wait, number(server.queue_ms, 1));
      setText(line.age, duration(server.age_s));
    }
    for (const name of racks.dataset.names ? JSON.parse(racks.dataset.names) : []) {
      if (!names.has(name)) rackOf(name)?.closest(".rack").remove();
    }
    for (const name of names) if (!rackOf(name)) racks.append(newRack(name));
    racks.dataset.names = JSON.stringify([...names]);
  }

  function newLine(name) {
    const fill = element("i");
    const line = {
      health: element("td"), fill, bar: element("span", { class: "bar", "aria-hidden": "true" }, fill), cpu: element("span"),
      robots: element("td", { class: "number" }), requests: element("td", { class: "number" }),
      queue: element("td", { class: "number" }), wait: element("td", { class: "number" }), age: element("td", { class: "number" }),
    };
    line.actions = element("td", { hidden: !isOperator() }, element("div", { class: "buttons" },
      ...["drain", "move", "pause", "resume", "kill"].map((action) => element("button", {
        class: action === "kill" ? "danger" : null, "data-action": action, "data-server": name,
        "aria-label": `${action} ${name}`, onclick: () => operate(action, name),
      }, action === "resume" ? "Resume" : `${action[0].toUpperCase()}${action.slice(1)}…`))));
    line.row = element("tr", { "data-server": name }, element("th", { scope: "row" }, name), line.health,
      element("td", {}, line.bar, line.cpu), line.robots, line.requests, line.queue, line.wait, line.age, line.actions);
    return line;
  }

  const rackOf = (name) => [...racks.children].find((each) => each.dataset.server === name)?.querySelector(".dots");

  function newRack(name) {
    return element("div", { class: "rack", "data-server": name },
      element("h2", {}, name), element("div", { class: "dots", role: "img", "aria-label": `robots of ${name}` }));
  }

  function takeRobots(robots) {
    const present = new Set();
    const counts = {};
    for (const [robot, server, , , , last] of robots.slice(0, MAX_DOTS)) {
      present.add(robot);
      counts[server] = (counts[server] ?? 0) + 1;
      let dot = dots.get(robot);
      if (!dot) { dot = element("span", { class: "dot" }); dots.set(robot, dot); }
      dot.title = `${robot}: last answer ${last}`;
      dot.dataset.last = last === "ok" || last === "-" ? "ok" : "bad";
      const rack = rackOf(server);
      if (rack && dot.parentElement !== rack) {
        if (dot.parentElement) {
          dot.dataset.moved = "";
          setTimeout(() => delete dot.dataset.moved, 5000);
        }
        rack.append(dot);
      }
    }
    for (const [robot, dot] of dots) if (!present.has(robot)) { dot.remove(); dots.delete(robot); }
    for (const each of racks.children) {
      each.querySelector(".dots").setAttribute("aria-label", `${counts[each.dataset.server] ?? 0} robots on ${each.dataset.server}`);
    }
    const listed = robots.slice(0, MAX_LISTED);
    robotRows.replaceChildren(...listed.map(([, server, , connected, commands, last, tenant, name]) => element("tr", {},
      element("td", {}, tenant), element("th", { scope: "row" }, name), element("td", {}, server),
      element("td", { class: "number" }, duration(connected)), element("td", { class: "number" }, number(commands)),
      element("td", {}, last))));
    setText(robotsNote, robots.length > MAX_LISTED ? `${MAX_LISTED} of ${robots.length} robots are listed` : robots.length ? "" : "No robot is connected.");
    setText(racksNote, robots.length > MAX_DOTS ? `${MAX_DOTS} of ${robots.length} robots are drawn`
      : robots.length ? "One dot is one robot; an outline says that it has just moved, a square that its last command failed." : "No robot is connected.");
  }

  function takeEvent(event) {
    latest = [event, ...latest].slice(0, 8);
    recent.replaceChildren(...latest.map((each) => element("div", {},
      element("time", { class: "soft" }, clock(each.time_s)), ` ${each.text}`)));
  }

  function takeHistory(columns) {
    history = columns;
    const [times, cpu, requests, , p99] = columns;
    charts.cpu.set(times, cpu);
    charts.requests.set(times, requests);
    charts.p99.set(times, p99);
  }

  async function operate(action, server) {
    const texts = {
      kill: [`Kill ${server}?`, "Its processes end at once, as in a crash. Its robots connect to other servers, and it is replaced."],
      pause: [`Pause ${server}?`, "Its processes stop, as in a hang. It is replaced when its health checks fail."],
      drain: [`Drain ${server}?`, "Its robots move to other servers, then it ends."],
      move: [`Move robots of ${server}?`, "They connect to other servers, if the load balancer sends them there."],
      roll: ["Replace every server?", "One after the other: a new server serves before an old one is drained."],
    };
    let chosen = true;
    if (texts[action]) {
      chosen = await confirmed({
        title: texts[action][0], text: texts[action][1], button: action[0].toUpperCase() + action.slice(1),
        input: action === "move" ? { type: "number", min: "1", value: "10", "aria-label": "Robots" } : null,
      });
      if (!chosen) return;
    }
    toast(`${action}${server ? ` ${server}` : ""}: asked`);
    try {
      await post("/act", { action, ...(server ? { server } : {}), ...(action === "move" ? { robots: chosen } : {}) });
      toast(`${action}${server ? ` ${server}` : ""}: done`);
    } catch (error) {
      toast(error.message);
    }
  }

  return {
    take, takeRobots, takeEvent, takeHistory,
    reset() { latest = []; recent.replaceChildren(); },
    shown() { if (history) takeHistory(history); },
    themed() { for (const each of Object.values(charts)) each.themed(); },
    operatorChanged() {
      actionsHead.hidden = rollBox.hidden = !isOperator();
      for (const line of lines.values()) line.actions.hidden = !isOperator();
    },
  };
}

function megabytes(bytes) {
  if (bytes === null || bytes === undefined) return "–";
  return bytes < 1e6 ? `${number(bytes / 1e3)} kB` : `${number(bytes / 1e6, 1)} MB`;
}
