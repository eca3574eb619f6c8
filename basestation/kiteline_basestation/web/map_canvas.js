// The map from above on a canvas: grid tiles, landmarks, paths and agents, with pan and zoom. Metres in w, y up.

const TILE = 64; // cells along a side of a tile
const POINTS = 1, TILES = 2, PATH = 3; // kinds of binary messages, see messages.py
const INTERRUPTED = -32768; // a path has no line here
// Of agents; the first four differ for colour-blind readers, too.
const LIGHT = ["#2a78d6", "#c2417c", "#b5730a", "#0f8b8d", "#6a4fc9", "#7d5a3c", "#4a7a12", "#8b2fa8"];
const DARK = ["#5a9cec", "#e46fa4", "#e0a33c", "#3fbfc0", "#9a86ee", "#c09a78", "#8dc04c", "#c77be0"];
const dark = matchMedia("(prefers-color-scheme: dark)");

export const onColours = (changed) => dark.addEventListener("change", changed);
export const agentColour = (agent) => (dark.matches ? DARK : LIGHT)[agent % LIGHT.length];
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

export class MapCanvas {
  // cursor: element that shows the position under the pointer. empty: element shown while there is no map.
  constructor(canvas, cursor, empty) {
    Object.assign(this, { canvas, cursor, empty });
    this.context = canvas.getContext("2d");
    this.layers = { grid: true, points: true, paths: true };
    this.scale = 40; // px per m
    this.centre = [0, 0]; // m
    this.fitted = true; // the whole map is shown, until the user moves it
    this.following = null;
    this.onFollow = () => {}; // is told the agent that is kept in the middle, null none
    this.stale = false;
    this.own_unit = false; // lengths are no metres
    this.clear();
    new ResizeObserver(() => this.redraw()).observe(canvas);
    onColours(() => { this.tiles.forEach((tile) => { tile.image = null; }); this.paintTiles(); this.redraw(); });
    this.addListeners();
  }

  clear() {
    this.tiles = new Map(); // "column,row" -> {column, row, cells, image}
    this.cell_m = 0.1;
    this.points = null;
    this.paths = new Map();
    this.poses = [];
    this.mapped = false;
    this.stale = false;
    this.redraw();
  }

  // What is shown is old: agents are drawn grey.
  setStale(stale) { this.stale = stale; this.redraw(); }

  receive(buffer) {
    const header = new DataView(buffer);
    const kind = header.getUint8(0), agent = header.getUint8(1), n = header.getUint32(4, true), scale = header.getFloat32(8, true);
    if (kind === POINTS) {
      this.points = { n, scale, xyz: new Int16Array(buffer, 16, 3 * n), labels: new Uint8Array(buffer, 16 + 6 * n, n) };
    } else if (kind === PATH) {
      this.paths.set(agent, { n, scale, xyz: new Int16Array(buffer, 16, 3 * n) });
    } else if (kind === TILES) {
      this.cell_m = scale;
      const places = new Int32Array(buffer, 16, 2 * n);
      for (let i = 0; i < n; i++) {
        const [column, row] = [places[2 * i], places[2 * i + 1]];
        const cells = new Int8Array(buffer, 16 + 8 * n + i * TILE * TILE, TILE * TILE).slice(); // else one tile keeps the message
        const tile = { column, row, cells, image: null };
        if (cells.some((c) => c >= 0)) this.tiles.set(`${column},${row}`, tile);
        else this.tiles.delete(`${column},${row}`);
      }
      this.paintTiles();
    }
    this.redraw();
  }

  agents(list) {
    this.poses = list.filter((a) => a.position);
    for (const agent of this.paths.keys()) if (!list.some((a) => a.agent === agent)) this.paths.delete(agent);
    this.mapped = list.some((a) => a.counts.some(({ label, value }) => label === "Keyframes" && value > 0));
    this.stale = false;
    this.redraw();
  }
  layer(name, on) { this.layers[name] = on; this.redraw(); }
  fit() { this.fitted = true; this.keepInMiddle(null); this.redraw(); }
  follow(agent) { this.keepInMiddle(this.following === agent ? null : agent); this.fitted = false; this.redraw(); }
  keepInMiddle(agent) { this.following = agent; this.onFollow(agent); }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  paintTiles() {
    const free = rgb(css("--free")), solid = rgb(css("--solid"));
    for (const tile of this.tiles.values()) {
      if (tile.image) continue;
      const image = new ImageData(TILE, TILE);
      for (let y = 0; y < TILE; y++) for (let x = 0; x < TILE; x++) {
        const state = tile.cells[(TILE - 1 - y) * TILE + x]; // an image's first row is the top
        if (state < 0) continue;
        const colour = state > 0 ? solid : free;
        const at = 4 * (y * TILE + x);
        for (let k = 0; k < 3; k++) image.data[at + k] = colour[k];
        image.data[at + 3] = 255;
      }
      tile.image = new OffscreenCanvas(TILE, TILE);
      tile.image.getContext("2d").putImageData(image, 0, 0);
    }
  }

  bounds() {
    let box = [Infinity, Infinity, -Infinity, -Infinity];
    const add = (x, y) => { box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)]; };
    for (const { column, row, cells } of this.tiles.values()) {
      for (let i = 0; i < cells.length; i += 3) if (cells[i] >= 0) {
        add((column * TILE + (i % TILE)) * this.cell_m, (row * TILE + Math.floor(i / TILE)) * this.cell_m);
      }
    }
    for (const { n, scale, xyz } of this.paths.values()) for (let i = 0; i < n; i++) if (xyz[3 * i] !== INTERRUPTED) add(xyz[3 * i] * scale, xyz[3 * i + 1] * scale);
    for (const a of this.poses) add(a.position[0], a.position[1]);
    if (!isFinite(box[0]) && this.points) {
      const { n, scale, xyz } = this.points;
      for (let i = 0; i < n; i++) add(xyz[3 * i] * scale, xyz[3 * i + 1] * scale);
    }
    return isFinite(box[0]) ? box : [-5, -5, 5, 5];
  }

  updateView(width, height) {
    if (this.fitted) {
      const [x0, y0, x1, y1] = this.bounds();
      this.centre = [(x0 + x1) / 2, (y0 + y1) / 2];
      this.scale = Math.min((width - 60) / Math.max(x1 - x0, 2), (height - 120) / Math.max(y1 - y0, 2));
    } else if (this.following !== null) {
      const found = this.poses.find((a) => a.agent === this.following);
      if (found) this.centre = found.position.slice(0, 2);
    }
  }

  draw() {
    const ratio = devicePixelRatio || 1;
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width || !height) return;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    this.updateView(width, height);
    const g = this.context, s = this.scale;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    this.showEmpty();
    this.toScreen = (x, y) => [width / 2 + (x - this.centre[0]) * s, height / 2 - (y - this.centre[1]) * s];

    if (this.layers.grid) {
      g.imageSmoothingEnabled = false;
      const side = TILE * this.cell_m;
      for (const { column, row, image } of this.tiles.values()) {
        const [x, y] = this.toScreen(column * side, (row + 1) * side);
        const [x2, y2] = this.toScreen((column + 1) * side, row * side);
        if (x2 > 0 && y2 > 0 && x < width && y < height) g.drawImage(image, Math.round(x), Math.round(y), Math.round(x2) - Math.round(x), Math.round(y2) - Math.round(y));
      }
    }
    this.drawGridLines(g, width, height);
    if (this.layers.points && this.points) this.drawPoints(g, width, height);
    if (this.layers.paths) for (const [agent, path] of this.paths) this.drawPath(g, agent, path);
    for (const a of this.poses) this.drawAgent(g, a);
    this.drawScaleBar(g, width, height);
  }

  showEmpty() {
    const some = this.tiles.size + (this.points?.n ?? 0) > 0 || [...this.paths.values()].some((path) => path.n > 0);
    this.empty.hidden = some;
    if (!some) this.empty.textContent = this.mapped ? "No map has a place in the world yet" : "Waiting for the first keyframe";
  }

  gridStep() { // a round number of metres, about 90 px wide
    const raw = 90 / this.scale, power = 10 ** Math.floor(Math.log10(raw));
    return power * [1, 2, 5, 10].find((k) => k * power >= raw);
  }

  drawGridLines(g, width, height) {
    const step = this.gridStep();
    g.strokeStyle = css("--lines");
    g.lineWidth = 1;
    g.beginPath();
    const first = (centre, size) => Math.ceil((centre - size / 2 / this.scale) / step) * step;
    for (let x = first(this.centre[0], width); this.toScreen(x, 0)[0] < width; x += step) {
      const at = Math.round(this.toScreen(x, 0)[0]) + 0.5;
      g.moveTo(at, 0); g.lineTo(at, height);
    }
    for (let y = first(this.centre[1], height); this.toScreen(0, y)[1] > 0; y += step) {
      const at = Math.round(this.toScreen(0, y)[1]) + 0.5;
      g.moveTo(0, at); g.lineTo(width, at);
    }
    g.stroke();
  }

  drawPoints(g, width, height) {
    const { n, scale, xyz, labels } = this.points;
    const colours = [css("--other"), css("--ground"), css("--obstacle")];
    const size = Math.min(3, Math.max(1.2, this.scale / 30));
    g.globalAlpha = 0.7;
    for (let label = 0; label < 3; label++) {
      g.fillStyle = colours[label];
      for (let i = 0; i < n; i++) if (labels[i] === label) {
        const [x, y] = this.toScreen(xyz[3 * i] * scale, xyz[3 * i + 1] * scale);
        if (x > 0 && y > 0 && x < width && y < height) g.fillRect(x - size / 2, y - size / 2, size, size);
      }
    }
    g.globalAlpha = 1;
  }

  drawPath(g, agent, { n, scale, xyz }) {
    const at = (i) => this.toScreen(xyz[3 * i] * scale, xyz[3 * i + 1] * scale);
    const whole = (i) => xyz[3 * i] !== INTERRUPTED;
    g.lineJoin = g.lineCap = "round";
    for (const [colour, wide] of [[css("--page"), 5], [agentColour(agent), 2.2]]) {
      g.strokeStyle = colour;
      g.lineWidth = wide;
      g.beginPath();
      for (let i = 0; i < n; i++) if (whole(i)) g[i && whole(i - 1) ? "lineTo" : "moveTo"](...at(i));
      g.stroke();
    }
    if (this.scale > 25) {
      g.fillStyle = agentColour(agent);
      for (let i = 0; i < n; i++) if (whole(i)) { g.beginPath(); g.arc(...at(i), 2.6, 0, 7); g.fill(); }
    }
  }

  drawAgent(g, a) {
    const [x, y] = this.toScreen(a.position[0], a.position[1]);
    const inactive = this.stale || a.link === "lost" || a.link === "never" || (a.quality !== null && a.quality < 0);
    g.save();
    g.translate(x, y);
    g.save();
    g.rotate((-(a.heading_deg ?? 0) * Math.PI) / 180);
    g.beginPath();
    g.moveTo(14, 0); g.lineTo(-8, 8.5); g.lineTo(-4, 0); g.lineTo(-8, -8.5); g.closePath();
    g.fillStyle = inactive ? css("--faint") : agentColour(a.agent);
    g.strokeStyle = css("--page");
    g.lineWidth = 2.5;
    g.stroke();
    g.fill();
    g.restore();
    g.font = "600 12px system-ui, sans-serif";
    const text = `${a.agent}`;
    g.lineWidth = 4;
    g.strokeStyle = css("--page");
    g.strokeText(text, 12, -10);
    g.fillStyle = css("--ink");
    g.fillText(text, 12, -10);
    g.restore();
  }

  drawScaleBar(g, width, height) {
    const step = this.gridStep(), long = step * this.scale, right = width - 20, y = height - 20;
    g.strokeStyle = g.fillStyle = css("--soft");
    g.lineWidth = 1.5;
    g.beginPath();
    g.moveTo(right - long, y - 5); g.lineTo(right - long, y); g.lineTo(right, y); g.lineTo(right, y - 5);
    g.stroke();
    g.font = "12px system-ui, sans-serif";
    g.textAlign = "center";
    g.fillText(this.own_unit ? `${step} (own unit)` : step >= 1 ? `${step} m` : `${Math.round(step * 100)} cm`, right - long / 2, y - 6);
    g.textAlign = "left";
  }

  addListeners() {
    const c = this.canvas;
    const held = new Map();
    const place = (event) => [event.offsetX - c.clientWidth / 2, event.offsetY - c.clientHeight / 2];
    const zoom = (factor, [px, py]) => {
      const next = Math.min(2000, Math.max(0.05, this.scale * factor));
      this.centre = [this.centre[0] + px / this.scale - px / next, this.centre[1] - py / this.scale + py / next];
      this.scale = next;
      this.fitted = false;
      this.redraw();
    };
    const move = (dx, dy) => {
      this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
      this.fitted = false;
      this.keepInMiddle(null);
      this.redraw();
    };
    c.addEventListener("wheel", (e) => { e.preventDefault(); zoom(1.0015 ** -e.deltaY, place(e)); }, { passive: false });
    c.addEventListener("pointerdown", (e) => { c.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.offsetX, e.offsetY]); });
    c.addEventListener("pointermove", (e) => {
      const [px, py] = place(e);
      this.cursor.textContent = `${(this.centre[0] + px / this.scale).toFixed(2)}, ${(this.centre[1] - py / this.scale).toFixed(2)}${this.own_unit ? "" : " m"}`;
      const old = held.get(e.pointerId);
      if (!old) return;
      const now = [e.offsetX, e.offsetY];
      if (held.size === 1) move(now[0] - old[0], now[1] - old[1]);
      else { // two fingers
        const other = [...held.entries()].find(([id]) => id !== e.pointerId)[1];
        const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        zoom(gap(now) / Math.max(gap(old), 1), [(now[0] + other[0]) / 2 - c.clientWidth / 2, (now[1] + other[1]) / 2 - c.clientHeight / 2]);
      }
      held.set(e.pointerId, now);
    });
    for (const name of ["pointerup", "pointercancel"]) c.addEventListener(name, (e) => held.delete(e.pointerId));
    c.addEventListener("pointerleave", () => { this.cursor.textContent = ""; });
    c.addEventListener("dblclick", () => this.fit());
    c.addEventListener("keydown", (e) => {
      const step = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[e.key];
      if (step) move(...step);
      else if (e.key === "+" || e.key === "=") zoom(1.25, [0, 0]);
      else if (e.key === "-") zoom(0.8, [0, 0]);
      else if (e.key === "f" || e.key === "0") this.fit();
    });
  }
}
