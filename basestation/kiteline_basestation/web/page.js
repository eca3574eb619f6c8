// Connects to the base, writes its numbers into the page and hands the map to the drawing.
import { MapView, agentColour } from "/draw.js";

const HISTORY = 120; // samples of the byte rate: a minute at two a second
const $ = (id) => document.getElementById(id);
const view = new MapView($("canvas"), $("where"), $("empty"));
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
    state("lost", "base does not answer");
    setTimeout(connect, retry_ms);
    retry_ms = Math.min(retry_ms * 2, 5000);
  };
}

// A page in the background asks for nothing.
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) connect();
  else if (socket) socket.close();
});
setInterval(() => {
  if (socket && last_ms && performance.now() - last_ms > 4000) state("quiet", "base is silent");
}, 1000);

function state(name, text) {
  $("link").dataset.state = name;
  $("link").textContent = text;
}

function show(status) {
  state("live", `running for ${duration(status.up_s)}`);
  $("t-keyframes").textContent = number.format(status.keyframes);
  $("t-points").textContent = number.format(status.points);
  $("t-loops").textContent = number.format(status.loops);
  $("t-merges").textContent = number.format(status.merges);
  $("t-grid").textContent = `${number.format(Math.round(status.grid_m2))} m²`;
  const up = status.agents.reduce((sum, a) => sum + (a.rate_up ?? 0), 0);
  $("t-up").textContent = `${bytes(up)}/s`;
  const many = status.agents.length;
  document.title = many ? `kiteline base · ${many} agent${many > 1 ? "s" : ""}` : "kiteline base";
  for (const agent of status.agents) fill(card(agent.agent), agent);
  view.agents(status.agents);
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
  link.textContent = a.link === "live" ? "live" : a.link === "never" ? "not heard yet" : `${a.link === "lost" ? "no word" : "silent"} for ${duration(a.silent_s)}`;

  const quality = node.querySelector(".quality");
  quality.dataset.level = a.quality < 0 ? "failed" : a.quality < 40 ? "low" : "good";
  quality.querySelector(".bar").setAttribute("aria-valuenow", Math.max(a.quality, 0));
  quality.querySelector(".bar i").style.width = `${Math.max(a.quality, 0)}%`;
  quality.querySelector("output").textContent = a.quality < 0 ? "failed" : a.quality === 0 ? "–" : `${a.quality} %`;

  const pose = [...node.querySelectorAll(".pose dd")];
  const values = a.position ? a.position.map((v) => v.toFixed(2)) : ["–", "–", "–"];
  values.push(a.heading_deg === null ? "–" : `${Math.round(a.heading_deg)}°`);
  pose.forEach((dd, i) => { dd.textContent = values[i]; });

  const counts = [a.keyframes, a.points, a.submaps];
  node.querySelectorAll(".counts dd").forEach((dd, i) => { dd.textContent = number.format(counts[i]); });

  const traffic = node.querySelectorAll(".traffic dd");
  traffic[0].textContent = a.rate_up === null ? bytes(a.bytes_up) : `${bytes(a.rate_up)}/s`;
  traffic[1].textContent = a.rate_down === null ? bytes(a.bytes_down) : `${bytes(a.rate_down)}/s`;
  node.querySelector(".traffic").title = `in all ${bytes(a.bytes_up)} up, ${bytes(a.bytes_down)} down`;
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
