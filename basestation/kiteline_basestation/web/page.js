// Connects to the base, shows its numbers and passes the map to the canvas. Which numbers: see numbers.py.
import { MapCanvas, agentColour, onColours } from "/map_canvas.js";

const HISTORY = 120; // samples of the byte rate: a minute at two a second
const $ = (id) => document.getElementById(id);
const view = new MapCanvas($("canvas"), $("where"), $("empty"));
const cards = new Map(); // agent -> {node, rates}
const number = new Intl.NumberFormat("en");
let socket = null;
let retry_ms = 500;
let last_ms = 0; // time of the last message; 0 none yet
let up_s = 0; // how long the base runs

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
    stale("lost", "no connection to the base");
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
  const silent_ms = performance.now() - last_ms;
  if (socket && last_ms && silent_ms > 4000) stale("quiet", "no data from the base");
  else if (!socket && last_ms) since(silent_ms / 1000);
}, 1000);

// What is written does not change while it is the same: a screen reader would say it again.
function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function state(name, text) {
  $("link").dataset.state = name;
  write($("state"), text);
}

// What the page shows is old.
function stale(name, text) {
  state(name, text);
  document.body.classList.add("stale");
  view.setStale(true);
  if (last_ms) since((performance.now() - last_ms) / 1000);
}

function since(silent_s) { write($("since"), `· data ${duration(silent_s)} old`); }

function show(status) {
  state("live", "connected");
  write($("since"), `· base up ${duration(status.up_s)}`);
  document.body.classList.remove("stale");
  if (status.up_s < up_s) for (const agent of [...cards.keys()]) remove(agent); // another start: nothing goes on
  up_s = status.up_s;
  const up = status.agents.reduce((sum, a) => sum + (a.rate_up ?? 0), 0);
  showNumbers($("totals"), [...status.totals, { label: "Data up", value: bytes(up), unit: "/s" }]);
  const many = status.agents.length;
  document.title = many ? `kiteline base · ${many} agent${many > 1 ? "s" : ""}` : "kiteline base";
  for (const agent of [...cards.keys()]) if (!status.agents.some((a) => a.agent === agent)) remove(agent);
  $("none").hidden = many > 0;
  for (const agent of status.agents) fill(card(agent.agent), agent);
  showTroubles(status.troubles);
  $("storeys").hidden = status.other_storeys === 0;
  write($("storeys"), `grid: the main one of ${status.other_storeys + 1} storeys`);
  view.own_unit = status.unit === "own";
  view.agents(status.agents);
}

function showTroubles(troubles) {
  $("troubles").hidden = troubles.length === 0;
  if (troubles.join("\n") === [...$("troubles").children].map((p) => p.textContent).join("\n")) return;
  $("troubles").replaceChildren(...troubles.map((trouble) => {
    const p = document.createElement("p");
    p.textContent = trouble;
    return p;
  }));
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
    write(dd, unit && unit[0] !== "/" ? `${text} ${unit}` : `${text}${unit}`);
  }
}

function card(agent) {
  let found = cards.get(agent);
  if (!found) {
    const node = $("card").content.firstElementChild.cloneNode(true);
    const name = node.querySelector(".name");
    name.textContent = `Agent ${agent}`;
    name.title = `Keep agent ${agent} in the middle of the map`;
    node.addEventListener("click", () => view.follow(agent));
    found = { node, rates: [] };
    cards.set(agent, found);
    const after = [...cards.keys()].filter((other) => other > agent).sort((a, b) => a - b)[0];
    $("agents").insertBefore(node, after === undefined ? null : cards.get(after).node);
    colour(agent);
  }
  return found;
}

function remove(agent) {
  if (view.following === agent) view.fit();
  cards.get(agent).node.remove();
  cards.delete(agent);
}

function colour(agent) { cards.get(agent).node.querySelector(".swatch").style.background = agentColour(agent); }

function fill({ node, rates }, a) {
  const link = node.querySelector(".link");
  link.dataset.state = a.link;
  write(link, a.link === "live" ? "live" : a.link === "never" ? "no packet yet" : `no ${a.link === "lost" ? "link" : "packet"} for ${duration(a.silent_s)}`);

  const quality = node.querySelector(".quality");
  const failed = a.quality !== null && a.quality < 0, percent = Math.max(a.quality ?? 0, 0);
  quality.dataset.level = failed ? "failed" : a.link === "lost" ? "old" : percent < 40 ? "low" : "good";
  const text = failed ? "no pose" : a.quality === null ? "–" : `${percent} %`;
  quality.querySelector(".bar").setAttribute("aria-valuenow", percent);
  quality.querySelector(".bar").setAttribute("aria-valuetext", a.quality === null ? "unknown" : text);
  quality.querySelector(".bar i").style.width = `${percent}%`;
  write(quality.querySelector(".value"), text);

  const own = a.unit === "own";
  [...node.querySelectorAll(".pose dt")].slice(0, 3).forEach((dt, i) => write(dt, own ? "xyz"[i] : `${"xyz"[i]}, m`));
  const values = a.position ? a.position.map((v) => v.toFixed(2)) : ["–", "–", "–"];
  values.push(a.heading_deg === null ? "–" : `${Math.round(a.heading_deg)}°`);
  [...node.querySelectorAll(".pose dd")].forEach((dd, i) => write(dd, values[i]));
  const mapped = a.counts.some(({ label, value }) => label === "Keyframes" && value > 0);
  const notes = [];
  if (failed && a.position) notes.push("Tracking failed: the position is a guess.");
  if (mapped && !a.position) notes.push("Not placed: its map has not matched the one that is shown.");
  if (mapped && own) notes.push("Own unit of length: one camera that knows no scale.");
  write(node.querySelector(".note"), notes.join(" "));
  node.querySelector(".note").hidden = notes.length === 0;

  showNumbers(node.querySelector(".counts"), a.counts);

  const traffic = node.querySelectorAll(".traffic dd");
  write(traffic[0], a.rate_up === null ? bytes(a.bytes_up) : `${bytes(a.rate_up)}/s`);
  write(traffic[1], a.rate_down === null ? bytes(a.bytes_down) : `${bytes(a.rate_down)}/s`);
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
view.onFollow = (followed) => {
  for (const [agent, { node }] of cards) node.querySelector(".name").setAttribute("aria-pressed", agent === followed);
};
onColours(() => { for (const agent of cards.keys()) colour(agent); });
connect();
