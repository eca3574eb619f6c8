// Connects to the base, shows its numbers and passes the map to the canvas. Which numbers: see numbers.py.
import { MapCanvas, agentColour } from "/map_canvas.js";

const HISTORY = 120; // samples of the byte rate: a minute at two a second
const $ = (id) => document.getElementById(id);
const view = new MapCanvas($("canvas"), $("where"), $("empty"));
const cards = new Map(); // agent -> {node, rates}
const number = new Intl.NumberFormat("en");
let socket = null;
let retry_ms = 500;
let last_ms = 0;

function connect() {
  if (socket || document.hidden) return;
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { retry_ms = 500; view.clear(); };
  socket.onmessage = (event) => {
    last_ms = performance.now();
    if (typeof event.data === "string") show(JSON.parse(event.data));
    else view.receive(event.data);
  };
  socket.onclose = () => {
    socket = null;
    if (document.hidden) return;
    state("lost", "no connection to the base");
    setTimeout(connect, retry_ms);
    retry_ms = Math.min(retry_ms * 2, 5000);
  };
}

// A page in the background is disconnected, so that it costs the base nothing.
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) connect();
  else if (socket) socket.close();
});
setInterval(() => {
  if (socket && last_ms && performance.now() - last_ms > 4000) state("quiet", "no data from the base");
}, 1000);

function state(name, text) {
  $("link").dataset.state = name;
  $("link").textContent = text;
}

function show(status) {
  state("live", `running for ${duration(status.up_s)}`);
  const up = status.agents.reduce((sum, a) => sum + (a.rate_up ?? 0), 0);
  showNumbers($("totals"), [...status.totals, { label: "Up", value: bytes(up), unit: "/s" }]);
  const many = status.agents.length;
  document.title = many ? `kiteline base · ${many} agent${many > 1 ? "s" : ""}` : "kiteline base";
  for (const agent of status.agents) fill(card(agent.agent), agent);
  view.agents(status.agents);
}

// One <div><dt>label</dt><dd>value</dd></div> for each number.
function showNumbers(list, numbers) {
  for (const { label, value, unit } of numbers) {
    let dd = list.querySelector(`[data-label="${label}"]`);
    if (!dd) {
      const dt = document.createElement("dt");
      dd = document.createElement("dd");
      dt.textContent = dd.dataset.label = label;
      const div = document.createElement("div");
      div.append(dt, dd);
      list.append(div);
    }
    const text = typeof value === "number" ? number.format(value) : value;
    dd.textContent = unit && unit[0] !== "/" ? `${text} ${unit}` : `${text}${unit}`;
  }
}

function card(agent) {
  let found = cards.get(agent);
  if (!found) {
    const node = $("card").content.firstElementChild.cloneNode(true);
    document.querySelector("aside .none")?.remove();
    node.querySelector(".name").textContent = `Agent ${agent}`;
    node.querySelector(".swatch").style.background = agentColour(agent);
    node.addEventListener("click", () => view.follow(agent));
    found = { node, rates: [] };
    cards.set(agent, found);
    const after = [...cards.keys()].filter((other) => other > agent).sort((a, b) => a - b)[0];
    $("agents").insertBefore(node, after === undefined ? null : cards.get(after).node);
  }
  return found;
}

function fill({ node, rates }, a) {
  const link = node.querySelector(".link");
  link.dataset.state = a.link;
  link.textContent = a.link === "live" ? "live" : a.link === "never" ? "no packet yet" : `no ${a.link === "lost" ? "link" : "packet"} for ${duration(a.silent_s)}`;

  const quality = node.querySelector(".quality");
  const failed = a.quality !== null && a.quality < 0, percent = Math.max(a.quality ?? 0, 0);
  quality.dataset.level = failed ? "failed" : a.link === "lost" ? "old" : percent < 40 ? "low" : "good";
  quality.querySelector(".bar").setAttribute("aria-valuenow", percent);
  quality.querySelector(".bar i").style.width = `${percent}%`;
  quality.querySelector("output").textContent = failed ? "failed" : a.quality === null ? "–" : `${percent} %`;

  const pose = [...node.querySelectorAll(".pose dd")];
  const values = a.position ? a.position.map((v) => v.toFixed(2)) : ["–", "–", "–"];
  values.push(a.heading_deg === null ? "–" : `${Math.round(a.heading_deg)}°`);
  pose.forEach((dd, i) => { dd.textContent = values[i]; });

  showNumbers(node.querySelector(".counts"), a.counts);

  const traffic = node.querySelectorAll(".traffic dd");
  traffic[0].textContent = a.rate_up === null ? bytes(a.bytes_up) : `${bytes(a.rate_up)}/s`;
  traffic[1].textContent = a.rate_down === null ? bytes(a.bytes_down) : `${bytes(a.rate_down)}/s`;
  node.querySelector(".traffic").title = `total: ${bytes(a.bytes_up)} up, ${bytes(a.bytes_down)} down`;
  if (a.rate_up !== null) rates.push(a.rate_up);
  if (rates.length > HISTORY) rates.shift();
  const top = Math.max(1, ...rates);
  const points = rates.map((rate, i) => `${(120 * (HISTORY - rates.length + i + 1)) / HISTORY},${(25 - (23 * rate) / top).toFixed(1)}`);
  if (points.length > 1) {
    node.querySelector(".curve").setAttribute("d", `M${points.join("L")}`);
    node.querySelector(".area").setAttribute("d", `M${points[0].split(",")[0]},26L${points.join("L")}L120,26Z`);
  }
}

function bytes(n) {
  if (n < 1000) return `${n} B`;
  if (n < 1e6) return `${(n / 1e3).toFixed(n < 1e4 ? 1 : 0)} kB`;
  return `${(n / 1e6).toFixed(1)} MB`;
}

function duration(s) {
  if (s < 60) return `${Math.floor(s)} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${Math.floor(s % 60)} s`;
  return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

for (const box of document.querySelectorAll("[data-layer]")) {
  box.addEventListener("change", () => view.layer(box.dataset.layer, box.checked));
}
$("fit").addEventListener("click", () => view.fit());
connect();
