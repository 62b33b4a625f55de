// Charts: curves over time by uPlot; loop, histogram and overview on separate canvases.

// Okabe and Ito (2008): distinguishable with any colour vision, together with dashes and widths.
export const INK = { black: "#1a1a1a", orange: "#e69f00", green: "#009e73", blue: "#0072b2", sky: "#56b4e9", red: "#d55e00", purple: "#cc79a7", grey: "#555", grid: "#e7e7e3" };
const FONT = '14px "Liberation Sans", "Noto Sans", Arial, system-ui, sans-serif';

export function text(value, digits) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const shown = value.toFixed(digits);
  return (Number(shown) === 0 ? shown.replace("-", "") : shown).replace("-", "−");
}

// The smallest size with few digits that is not below `size`.
function nice(size, steps) {
  const power = 10 ** Math.floor(Math.log10(size));
  return steps.find((step) => step * power >= size * (1 - 1e-9)) * power;
}
const BOUNDS = [1, 1.2, 1.6, 2, 3, 4, 5, 6, 8, 10], STEPS = [1, 2, 5, 10];

// A range that grows at once and shrinks only when it is far too large, so that it rarely changes.
class Steady {
  constructor(least, symmetric) { this.least = least; this.symmetric = symmetric; this.low = 0; this.high = 0; }

  over(low, high) {
    if (!(low <= high)) { low = 0; high = 0; }
    if (this.symmetric) { high = Math.max(Math.abs(low), Math.abs(high)); low = -high; }
    const span = Math.max(high - low, this.least);
    const fits = this.high > this.low && low >= this.low && high <= this.high && span > 0.3 * (this.high - this.low);
    if (!fits) {
      if (this.symmetric) { this.high = nice(Math.max(1.05 * high, this.least), BOUNDS); this.low = -this.high; }
      else {
        const step = nice(span / 4, STEPS);
        this.low = Math.floor((low - 0.1 * span) / step) * step;
        this.high = Math.ceil((high + 0.1 * span) / step) * step;
        if (low >= 0 && this.low < 0) this.low = 0;
      }
    }
    return [this.low, this.high];
  }
}

function extent(rows) {
  let low = Infinity, high = -Infinity;
  for (const row of rows) for (const y of row) if (y !== null) { if (y < low) low = y; if (y > high) high = y; }
  return [low, high];
}

const SYNC = "time";

// A chart over time.
// series: [{ channel, label, ink, width, dash, digits }]; on.select(first, last) in seconds, on.zoom(factor, at).
export class TimeChart {
  constructor(figure, title, unit, series, range, on) {
    this.series = series;
    this.steady = new Steady(range.least, range.symmetric);
    figure.innerHTML = "";
    const caption = document.createElement("figcaption");
    this.unit = element("span", unit, "unit");
    caption.append(element("b", title), this.unit);
    this.outputs = series.map((one) => this.#key(caption, one, series.length > 1));
    this.plot = element("div", "", "plot");
    figure.append(caption, this.plot);
    this.range = [0, 1];
    this.chart = new uPlot(this.#options(series, on), [[], ...series.map(() => [])], this.plot);
    this.plot.addEventListener("wheel", (event) => {
      event.preventDefault();
      on.zoom(event.deltaY > 0 ? 1.25 : 0.8, this.chart.posToVal(event.offsetX, "x"));
    }, { passive: false });
    new ResizeObserver(() => this.chart.setSize({ width: this.plot.clientWidth, height: this.plot.clientHeight })).observe(this.plot);
  }

  #key(caption, one, named) {
    const key = element("span", "", "key");
    if (named) {
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
      for (const [name, value] of Object.entries({ x1: 0, x2: 26, y1: 4, y2: 4, stroke: one.ink, "stroke-width": one.width + 0.5, "stroke-dasharray": (one.dash || []).join(" ") })) line.setAttribute(name, value);
      svg.append(line);
      key.append(svg, element("span", one.label));
    }
    const output = element("output", "");
    key.append(output);
    caption.append(key);
    return output;
  }

  #options(series, on) {
    const axis = { font: FONT, stroke: INK.black, grid: { stroke: INK.grid, width: 1 }, ticks: { show: false } };
    return {
      width: Math.max(this.plot.clientWidth, 50), height: Math.max(this.plot.clientHeight, 50),
      padding: [9, 22, 0, 0],
      legend: { show: false },
      cursor: { sync: { key: SYNC }, y: false, points: { size: 7 }, drag: { x: true, y: false, setScale: false }, bind: { dblclick: () => () => { on.all(); return null; } } },
      scales: { x: { time: false, range: () => this.range }, y: { range: () => this.steady.over(...extent(this.chart ? this.chart.data.slice(1) : [])) } },
      axes: [
        { ...axis, size: 24, gap: 3, space: 70, values: (_, splits) => splits.map((s) => `${trimmed(s)}${s === splits[splits.length - 1] ? " s" : ""}`) },
        { ...axis, size: 58, gap: 6, space: 26, values: (_, splits) => splits.map(trimmed) },
      ],
      series: [{}, ...series.map((one) => ({ stroke: one.ink, width: one.width, dash: one.dash, points: { show: false } }))],
      hooks: {
        setSelect: [(u) => {
          if (u.select.width > 4) on.select(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        }],
        setCursor: [(u) => { this.#read(u.cursor.idx); }],
      },
    };
  }

  #read(index) {
    this.series.forEach((one, i) => {
      const value = index === null || index === undefined ? null : this.chart.data[i + 1][index];
      this.outputs[i].value = value === null || value === undefined ? "" : text(value, one.digits);
    });
  }

  name(unit) { if (this.unit.textContent !== unit) this.unit.textContent = unit; }

  draw(store, range) {
    this.range = range;
    this.chart.setData([store.x, ...this.series.map((one) => store.y[one.channel])]);
  }
}

function trimmed(value) { return String(Number(value.toFixed(6))).replace("-", "−"); }

function element(tag, content, name) {
  const made = document.createElement(tag);
  made.textContent = content;
  if (name) made.className = name;
  return made;
}

// A canvas that is as sharp as the screen; draws in CSS pixels.
class Sheet {
  constructor(canvas, redraw) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => { this.#fit(); redraw(); }).observe(canvas);
    this.#fit();
  }

  #fit() {
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth;
    this.height = this.canvas.clientHeight;
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  clear() {
    this.context.clearRect(0, 0, this.width, this.height);
    this.context.font = FONT;
    this.context.fillStyle = INK.black;
  }
}

export class LoopChart {
  constructor(canvas) {
    this.sheet = new Sheet(canvas, () => this.draw(this.points || [], this.now));
    this.x = new Steady(0.05, true);
    this.f = new Steady(0.1, true);
  }

  draw(points, now) {
    this.points = points;
    this.now = now;
    const { sheet } = this, c = sheet.context;
    sheet.clear();
    const box = { left: 52, right: sheet.width - 12, top: 8, bottom: sheet.height - 24 };
    if (box.right - box.left < 40 || box.bottom - box.top < 40) return;
    let big = 0, strong = 0;
    for (const [, x, f] of points) { big = Math.max(big, Math.abs(x)); strong = Math.max(strong, Math.abs(f)); }
    const [, xMax] = this.x.over(-big, big), [, fMax] = this.f.over(-strong, strong);
    const px = (x) => box.left + (x + xMax) / (2 * xMax) * (box.right - box.left);
    const py = (f) => box.bottom - (f + fMax) / (2 * fMax) * (box.bottom - box.top);
    this.#axes(c, box, xMax, fMax, px, py);
    c.lineJoin = "round";
    // Older parts are paler.
    const parts = [["#b9d5e6", 1.2, 0, 0.5], ["#66a9cf", 1.4, 0.5, 0.8], [INK.blue, 2, 0.8, 1]];
    for (const [ink, width, from, to] of parts) {
      c.strokeStyle = ink;
      c.lineWidth = width;
      c.beginPath();
      const first = Math.floor(from * points.length), end = Math.min(points.length, Math.ceil(to * points.length) + 1);
      for (let i = first; i < end; i++) { const [, x, f] = points[i]; if (i === first) c.moveTo(px(x), py(f)); else c.lineTo(px(x), py(f)); }
      c.stroke();
    }
    if (now && Number.isFinite(now[0]) && Number.isFinite(now[1])) {
      c.fillStyle = INK.red;
      c.strokeStyle = "#fff";
      c.lineWidth = 2;
      c.beginPath();
      c.arc(px(now[0]), py(now[1]), 6, 0, 2 * Math.PI);
      c.fill();
      c.stroke();
    }
  }

  #axes(c, box, xMax, fMax, px, py) {
    c.strokeStyle = INK.grid;
    c.lineWidth = 1;
    for (const part of [-1, -0.5, 0, 0.5, 1]) {
      c.strokeStyle = part === 0 ? "#9a9a94" : INK.grid;
      const x = Math.round(px(part * xMax)) + 0.5, y = Math.round(py(part * fMax)) + 0.5;
      c.beginPath();
      c.moveTo(x, box.top); c.lineTo(x, box.bottom);
      c.moveTo(box.left, y); c.lineTo(box.right, y);
      c.stroke();
      c.textAlign = part === 1 ? "right" : part === -1 ? "left" : "center"; c.textBaseline = "top";
      c.fillText(trimmed(part * xMax) + (part === 1 ? " mm" : ""), part === 1 ? box.right + 10 : x, box.bottom + 6);
      c.textAlign = "right"; c.textBaseline = part === 1 ? "top" : "middle";
      c.fillText(trimmed(part * fMax), box.left - 6, part === 1 ? box.top - 4 : y);
    }
  }
}

// Bars over two logarithmic axes.
export class Histogram {
  constructor(canvas) { this.sheet = new Sheet(canvas, () => { if (this.counts) this.draw(this.edges, this.counts, this.p99); }); }

  draw(edges, counts, p99) {
    Object.assign(this, { edges, counts, p99 });
    const { sheet } = this, c = sheet.context;
    sheet.clear();
    const box = { left: 52, right: sheet.width - 14, top: 8, bottom: sheet.height - 22 };
    if (box.right - box.left < 40 || box.bottom - box.top < 20) return;
    const decades = Math.max(1, Math.ceil(Math.log10(Math.max(8, ...counts) * 1.2)));
    const low = Math.log10(edges[0]), high = Math.log10(edges[edges.length - 1]);
    const px = (us) => box.left + (Math.log10(us) - low) / (high - low) * (box.right - box.left);
    const py = (count) => box.bottom - Math.max(0, Math.log10(count) + 0.15) / (decades + 0.15) * (box.bottom - box.top);
    c.lineWidth = 1;
    c.textBaseline = "middle";
    c.textAlign = "right";
    for (let d = 0; d <= decades; d += decades > 3 ? 2 : 1) {
      const y = Math.round(py(10 ** d)) + 0.5;
      c.strokeStyle = INK.grid;
      c.beginPath(); c.moveTo(box.left, y); c.lineTo(box.right, y); c.stroke();
      c.fillText(d < 3 ? String(10 ** d) : `10${"⁰¹²³⁴⁵⁶⁷⁸⁹"[d]}`, box.left - 6, y);
    }
    c.fillStyle = INK.blue;
    counts.forEach((count, i) => { if (count) { const x = px(edges[i]); c.fillRect(x, py(count), Math.max(1, px(edges[i + 1]) - x - 1), box.bottom - py(count)); } });
    c.fillStyle = INK.black;
    c.textBaseline = "top";
    const names = ["1 µs", "10", "100", "1 ms", "10", "100"];
    names.forEach((name, d) => { c.textAlign = d === 5 ? "right" : d === 0 ? "left" : "center"; c.fillText(name, px(10 ** d), box.bottom + 5); });
    c.strokeStyle = INK.grey;
    c.beginPath(); c.moveTo(box.left, box.bottom + 0.5); c.lineTo(box.right, box.bottom + 0.5); c.stroke();
    if (p99 > 0) {
      const x = Math.round(px(Math.min(p99, edges[edges.length - 1]))) + 0.5;
      c.strokeStyle = INK.red;
      c.lineWidth = 2;
      c.setLineDash([5, 3]);
      c.beginPath(); c.moveTo(x, box.top); c.lineTo(x, box.bottom); c.stroke();
      c.setLineDash([]);
      c.fillStyle = INK.black;
      c.textAlign = x > box.right - 40 ? "right" : "left";
      c.fillText("p99", x + (x > box.right - 40 ? -5 : 5), box.top);
    }
  }
}

// An overview of the whole test, with a window that can be dragged.
export class Outline {
  constructor(canvas, channel, on) {
    this.channel = channel;
    this.on = on;
    this.sheet = new Sheet(canvas, () => this.draw());
    this.window = [0, 1];
    canvas.addEventListener("pointerdown", (event) => this.#grab(canvas, event));
  }

  #grab(canvas, event) {
    if (!this.frame) return;
    const at = (e) => this.#position(e.offsetX), [first, last] = this.window, begin = at(event);
    const near = 8 * this.#position(1) - 8 * this.#position(0);
    const edge = Math.abs(begin - first) < near ? "first" : Math.abs(begin - last) < near ? "last" : "";
    // A click elsewhere in the overview moves the window there.
    const shift = begin < first || begin > last ? begin - (first + last) / 2 : 0;
    const move = (e) => {
      const by = at(e) - begin;
      if (edge === "first") this.on(Math.min(first + by, last - 32), last);
      else if (edge === "last") this.on(first, Math.max(last + by, first + 32));
      else this.on(first + shift + by, last + shift + by);
    };
    canvas.setPointerCapture(event.pointerId);
    canvas.onpointermove = move;
    canvas.onpointerup = () => { canvas.onpointermove = null; };
    move(event);
  }

  #position(x) {
    const { frame } = this;
    return frame.first + x / this.sheet.width * (frame.last - frame.first);
  }

  show(frame) { this.frame = frame; this.draw(); }

  draw() {
    const { sheet, frame } = this, c = sheet.context;
    sheet.clear();
    if (!frame || !frame.columns) return;
    const px = (position) => (position - frame.first) / Math.max(1, frame.last - frame.first) * sheet.width;
    const part = frame.extremes.subarray(2 * this.channel * frame.columns, 2 * (this.channel + 1) * frame.columns);
    let big = 1e-6;
    for (const value of part) if (Math.abs(value) > big) big = Math.abs(value);
    const py = (value) => sheet.height / 2 - value / big * (sheet.height / 2 - 3);
    c.fillStyle = INK.blue;
    for (let i = 0; i < frame.columns; i++) {
      const low = part[2 * i], high = part[2 * i + 1];
      if (Number.isNaN(low)) continue;
      const x = px((frame.column + i) * frame.wide);
      c.fillRect(x, py(high) - 0.5, Math.max(1, px((frame.column + i + 1) * frame.wide) - x), py(low) - py(high) + 1);
    }
    const left = px(this.window[0]), right = px(this.window[1]);
    c.fillStyle = "rgba(255, 255, 255, 0.72)";
    c.fillRect(0, 0, Math.max(0, left), sheet.height);
    c.fillRect(right, 0, Math.max(0, sheet.width - right), sheet.height);
    c.strokeStyle = INK.black;
    c.lineWidth = 2;
    c.strokeRect(left + 1, 1, Math.max(3, right - left - 2), sheet.height - 2);
  }
}
