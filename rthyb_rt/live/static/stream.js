// The socket, its frames, and the data available from them.
// The layout of a frame is in rthyb_rt/live/frames.py.

const MORE = 0, OUTLINE = 2, NO_STATE = 255;

export function parse(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < 64 || view.getUint32(0) !== 0x524c5631) throw new Error("not a frame");
  const channels = view.getUint16(6, true), columns = view.getUint32(8, true), points = view.getUint32(16, true);
  const wide = view.getUint32(12, true), f64 = (at) => view.getFloat64(at, true);
  let at = 64;
  const floats = (count) => { const part = new Float32Array(buffer, at, count); at += 4 * count; return part; };
  return {
    kind: view.getUint8(4), state: view.getUint8(5), channels, columns, wide, points,
    column: f64(24), at: f64(32), zero: f64(40), first: f64(48), last: f64(56),
    values: floats(channels), extremes: floats(2 * channels * columns), loop: floats(3 * points),
  };
}

// The columns of all channels, two points per column, in the format of uPlot; and the loop.
export class Store {
  constructor(channels, fs) {
    this.fs = fs;
    this.count = channels;
    this.clear();
  }

  clear() {
    this.x = [];
    this.y = Array.from({ length: this.count }, () => []);
    this.column = 0;
    this.wide = 1;
    this.zero = 0;
    this.loop = [];
    this.head = null;
  }

  seconds(position) { return (position - this.zero) / this.fs; }

  take(frame, windowTicks) {
    if (frame.kind === OUTLINE) return;
    if (frame.kind !== MORE || frame.wide !== this.wide || !this.x.length) {
      this.clear();
      this.column = frame.column;
      this.wide = frame.wide;
    }
    this.head = frame;
    if (frame.zero !== this.zero) {
      const shift = (this.zero - frame.zero) / this.fs;
      this.x = this.x.map((x) => x + shift);
      this.zero = frame.zero;
    }
    this.#columns(frame);
    this.#points(frame);
    if (windowTicks) this.#forget(frame.last + 1 - windowTicks);
  }

  #columns(frame) {
    const keep = 2 * Math.max(0, frame.column - this.column), n = frame.columns;
    this.x.length = Math.min(keep, this.x.length);
    for (let c = 0; c < n; c++) {
      const left = (frame.column + c) * this.wide;
      this.x.push(this.seconds(left + 0.25 * this.wide), this.seconds(left + 0.75 * this.wide));
    }
    for (let k = 0; k < this.count; k++) {
      const y = this.y[k];
      y.length = Math.min(keep, y.length);
      let before = y.length ? y[y.length - 1] : null;
      for (let i = 2 * k * n; i < 2 * (k + 1) * n; i += 2) {
        const low = frame.extremes[i], high = frame.extremes[i + 1];
        if (Number.isNaN(low)) { y.push(null, null); before = null; continue; }
        // The order within a pixel is invisible; the shorter line looks best.
        if (before !== null && Math.abs(high - before) < Math.abs(low - before)) { y.push(high, low); before = low; }
        else { y.push(low, high); before = high; }
      }
    }
  }

  #points(frame) {
    const base = frame.column * this.wide, loop = this.loop;
    while (loop.length && loop[loop.length - 1][0] >= base) loop.pop();
    for (let i = 0; i < frame.loop.length; i += 3) loop.push([base + frame.loop[i], frame.loop[i + 1], frame.loop[i + 2]]);
  }

  #forget(position) {
    const old = Math.floor(position / this.wide) - this.column;
    if (old > 0) {
      this.x.splice(0, 2 * old);
      for (const y of this.y) y.splice(0, 2 * old);
      this.column += old;
    }
    let gone = 0;
    while (gone < this.loop.length && this.loop[gone][0] < position) gone++;
    if (gone) this.loop.splice(0, gone);
  }
}

// Reconnects automatically; meanwhile the page shows that there are no data.
export function connect(on) {
  const address = new URL("socket", location.href.replace(/^http/, "ws"));
  let socket = null, pause = 500;
  function open() {
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { pause = 500; };
    socket.onmessage = ({ data }) => {
      if (typeof data !== "string") { on.frame(parse(data)); return; }
      const said = JSON.parse(data);
      on[said.kind](said);
    };
    socket.onclose = () => {
      on.closed();
      setTimeout(open, pause);
      pause = Math.min(2 * pause, 5000);
    };
  }
  open();
  return (message) => {
    if (socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  };
}

export { NO_STATE, OUTLINE };
