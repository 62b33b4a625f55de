// The page: view, status and buttons.

import { Histogram, INK, LoopChart, Outline, TimeChart, text } from "./charts.js";
import { NO_STATE, OUTLINE, Store, connect } from "./stream.js";

const CHANNEL = { command: 0, sent: 1, measured: 2, tracking: 3, force: 4, alpha: 5, stiffness: 6, energy: 7 };
const STILL_MS = 1000, NUMBERS_MS = 200, SURE_MS = 4000, SURE_AFTER_MS = 600, ANSWER_MS = 8000, LEAST_S = 0.05;
const LOOK_MS = 500, DEAF_LOOKS = 8;
const STIFFNESS_CHART = 4;
const SLOW = [CHANNEL.alpha, CHANNEL.stiffness, CHANNEL.energy];
const $ = (id) => document.getElementById(id);

let hello = null, status = null, store = null, send = () => false, connected = false;
let following = true, seconds = 10, shown = [0, 0], playing = 0;
let dirty = false, numbersDue = 0, rowsCame = 0, lastRow = -1, shownState = NO_STATE;
let heard = 0, deafLooks = 0;
// With several axes, one is shown at a time, with the channels of a rig with one axis.
let axes = [], axis = 0;

// For the tests and the benchmark: newest row painted, and when (Unix time, ms).
const drawn = [];
window.rthybLive = { drawn, frames: 0, get store() { return store; }, get shown() { return shown; } };

const painted = new MessageChannel();
painted.port1.onmessage = ({ data }) => { drawn.push([data, performance.timeOrigin + performance.now()]); if (drawn.length > 4096) drawn.splice(0, 2048); };

// ---- charts -------------------------------------------------------------------------------------

const on = { select: (first, last) => look(position(first), position(last)), zoom: (factor, at) => zoom(factor, position(at)), all: () => everything() };
const one = (channel, ink, digits) => [{ channel, label: "", ink, width: 1.6, digits }];
let charts = [], loop = null, histogram = null, outline = null;

function build() {
  if (charts.length) return;
  const symmetric = (least) => ({ least, symmetric: true }), free = (least) => ({ least, symmetric: false });
  charts = [
    new TimeChart($("displacement"), "Displacement", "mm", [
      { channel: CHANNEL.measured, label: "measured", ink: INK.sky, width: 3, digits: 3 },
      { channel: CHANNEL.sent, label: "compensated", ink: INK.red, width: 1.6, dash: [7, 4], digits: 3 },
      { channel: CHANNEL.command, label: "command", ink: INK.black, width: 1.2, digits: 3 },
    ], symmetric(0.05), on),
    new TimeChart($("tracking"), "Tracking error", "mm, measured minus command", one(CHANNEL.tracking, INK.red, 4), symmetric(0.02), on),
    new TimeChart($("force"), "Force", "kN, measured", one(CHANNEL.force, INK.blue, 3), symmetric(0.1), on),
    new TimeChart($("alpha"), "Delay α", "samples", one(CHANNEL.alpha, INK.green, 2), free(0.5), on),
    new TimeChart($("stiffness"), "Tangent stiffness", "kN/mm", one(CHANNEL.stiffness, INK.purple, 3), free(0.01), on),
    new TimeChart($("energy"), "Energy error", "J", one(CHANNEL.energy, INK.black, 3), free(0.01), on),
  ];
  loop = new LoopChart(document.querySelector("#loop canvas"));
  histogram = new Histogram(document.querySelector("#jitter canvas"));
  outline = new Outline($("outline"), CHANNEL.measured, look);
}

function draw() {
  dirty = false;
  const head = store.head;
  if (!head) return;
  const range = following ? [store.seconds(head.last) - seconds, store.seconds(head.last)] : shown.map((p) => store.seconds(p));
  if (following) shown = [head.last - seconds * hello.fs_hz, head.last];
  // Slowly changing parts are drawn in turn, one per frame, so that no frame is late.
  const slow = window.rthybLive.frames % SLOW.length;
  charts.forEach((chart, i) => { if (!following || i < charts.length - SLOW.length || i === charts.length - SLOW.length + slow) chart.draw(store, range); });
  loop.draw(store.loop, [head.values[CHANNEL.measured], head.values[CHANNEL.force]]);
  if (performance.now() >= numbersDue || !following) {
    numbersDue = performance.now() + NUMBERS_MS;
    numbers(hello.past || (following && flows()) || !status || !status.now ? head.values : newest());
    sayShown();
  }
  tell();
}

function animate() {
  const newest = store && store.head ? store.head.last : -1, draws = dirty;
  if (playing) play();
  if (draws) {
    draw();
    window.rthybLive.frames++;
    // The browser paints after this callback; the message arrives after that.
    painted.port2.postMessage(newest);
  }
  requestAnimationFrame(animate);
}

// ---- numbers and words --------------------------------------------------------------------------

// Newest values of the axis shown.
function newest() { const n = hello.channels.length; return status.now.slice(axis * n, (axis + 1) * n); }

function peak(channel) {
  let most = 0;
  for (const y of store.y[channel]) if (y !== null && Math.abs(y) > most) most = Math.abs(y);
  return most;
}

function numbers(values) {
  const put = (id, channel, digits, more) => { $(`n-${id}`).value = text(values[channel], digits); $(`s-${id}`).textContent = more; };
  put("x", CHANNEL.measured, 2, `command ${text(values[CHANNEL.command], 2)}, peak ${text(peak(CHANNEL.measured), 2)}`);
  put("e", CHANNEL.tracking, 3, `peak ${text(peak(CHANNEL.tracking), 3)}`);
  put("f", CHANNEL.force, 2, `peak ${text(peak(CHANNEL.force), 2)}`);
  put("a", CHANNEL.alpha, 1, values[CHANNEL.alpha] === null ? "" : `${text(values[CHANNEL.alpha] / hello.fs_hz * 1000, 1)} ms`);
  put("k", CHANNEL.stiffness, 3, $("s-k").textContent);
  put("w", CHANNEL.energy, 2, "");
}

function flows() { return connected && performance.now() - rowsCame < STILL_MS; }

// An open socket proves nothing: it may belong to a tunnel whose network is down.
function deaf() { return deafLooks >= DEAF_LOOKS && !hello.past; }

// State and first cause: of the newest row while rows arrive, else as reported by the service.
function tell() {
  if (!hello) return;
  const of = (number) => (number === NO_STATE ? "" : hello.states[number] || "");
  let state = of(shownState), cause = "", words = "";
  if (!connected) { state = "none"; words = "NO CONNECTION"; cause = "The curves are out of date. rthyb live has ended, or the connection was lost."; }
  else if (deaf()) { state = "none"; words = "NO CONNECTION"; cause = `No data for ${ago(performance.now() - heard)}. The curves are out of date.`; }
  else if (status && !status.reachable) { state = "none"; words = "NO SERVICE"; cause = status.trouble || "rthyb serve does not answer."; }
  else if (status) {
    // The present state must be visible even while an earlier view is shown.
    if (!hello.past && !(following && flows())) state = status.state || state;
    cause = state === status.state || status.mode !== "service" ? status.cause : "";
    if (hello.past) {
      words = "RECORDING";
      cause = `${status.end_reason || "end unknown"}${store.head ? `; at ${text(store.seconds(store.head.at), 2)} s ${state.replace("_", " ")}` : ""}`;
      state = status.state;
      $("band").dataset.past = "";
    }
    else if (status.ended) cause = ended(state);
    else if (state === "TRIPPED") cause = cause ? `first cause: ${cause}` : "first cause: not yet determined";
    else if (state === "" && status.trouble) { state = "none"; words = "NO TEST"; cause = status.trouble; }
    else if (!status.flows) { words = "NO ROWS"; cause = standing(state); state = "none"; }
    else if (state === "") words = "WAITING";
    else if (state === "IDLE" && status.last && status.last.end_reason !== "completed") cause = `last test ${status.last.end_reason}`;
    else if (cause && state !== "RAMP_OUT" && state !== "HOLD") cause = "";
    if (!cause && (state === "ZEROED" || state === "ARMED")) cause = status.tare;
    if (!cause && status.indicated && status.indicated.length) cause = `indicated: ${status.indicated.join(", ")}`;
  }
  const name = words || state.replace("_", " ");
  if ($("state").textContent !== name) $("state").textContent = name;
  if ($("cause").textContent !== cause) $("cause").textContent = cause;
  $("band").dataset.state = state;
  $("band").classList.toggle("off", state === "RAMP_OUT" && cause !== "");
  $("band").classList.toggle("doubt", Boolean(status) && status.attention.length > 0);
}

// Coarser as it grows, so that a screen reader does not announce every second.
function ago(ms) {
  const s = Math.floor(ms / 1000);
  return s < 10 ? `${s} s` : s < 120 ? `${s - s % 10} s` : `${Math.floor(s / 60)} min`;
}

// The curves are out of date, but the status of the service is not.
function standing(state) {
  const says = status.mode === "service" && state ? ` The service reports ${state.replace("_", " ")}.` : "";
  return `${status.trouble || `No rows for ${ago(1000 * status.still_s)}: the curves are out of date.`}${says}`;
}

function ended(state) {
  return state === "TRIPPED" && status.cause ? `first cause: ${status.cause}` : status.end_reason;
}

function sayShown() {
  const [first, last] = shown.map((p) => store.seconds(p));
  $("shown").textContent = following ? "" : `${text(first, 2)} to ${text(last, 2)} s`;
  const slider = $("outline"), head = store.head;
  slider.setAttribute("aria-valuemin", store.seconds(head.first).toFixed(2));
  slider.setAttribute("aria-valuemax", store.seconds(head.last).toFixed(2));
  slider.setAttribute("aria-valuenow", last.toFixed(2));
  slider.setAttribute("aria-valuetext", `${text(first, 2)} to ${text(last, 2)} seconds`);
}

function onStatus(found) {
  status = found;
  $("test-name").textContent = found.test || (found.mode === "service" ? "no test loaded" : "");
  const facts = [found.rig, found.link, found.created_utc, found.armed_by ? `armed by ${found.armed_by}` : ""];
  $("test-facts").textContent = facts.filter(Boolean).join(" · ");
  document.title = `${found.flows ? found.state || "rthyb live" : "NO ROWS"}${found.test ? ` · ${found.test}` : ""}`;
  $("progress").hidden = !found.progress;
  if (found.progress) {
    const [done, of] = found.progress;
    $("progress-bar").max = of;
    $("progress-bar").value = done;
    $("progress-text").textContent = `${text(done, 1)} of ${text(of, 1)} s`;
  }
  $("counters").replaceChildren(...found.counters.map(counter));
  attend(found.attention);
  const wake = found.wake;
  $("wake").textContent = wake.max_us > 0 ? `p50 ${micro(wake.p50_us)}, p99 ${micro(wake.p99_us)}, longest ${micro(wake.max_us)}` : hello.past ? "not in real time" : "";
  histogram.draw(hello.edges_us, wake.counts, wake.p99_us);
  enable();
  showAxes(found.axes);
  nameStiffness();
  if (store.head && found.now && !(following && flows())) numbers(newest());
  tell();
}

function showAxes(names) {
  if (names.join("\n") === axes.join("\n")) return;
  axes = names;
  $("axes").hidden = !names.length;
  $("axes").replaceChildren(...names.map((name, k) => {
    const made = document.createElement("button");
    made.textContent = name;
    made.addEventListener("click", () => turnTo(k));
    return made;
  }));
  turnTo(axis < names.length ? axis : 0);
}

function turnTo(k) {
  axis = k;
  [...$("axes").children].forEach((button, i) => button.setAttribute("aria-current", String(i === k)));
  nameStiffness();
  store.clear();
  ask(true);
}

// With several axes the tangent stiffness belongs to a direction, which must be named with its unit.
function nameStiffness() {
  const own = status && axes.length ? (status.directions || [])[axis] : null;
  const unit = own ? own.unit : "kN/mm";
  $("u-k").textContent = unit;
  charts[STIFFNESS_CHART].name(own ? `${unit}, direction ${own.name}` : axes.length ? "no direction" : unit);
  $("s-k").textContent = own ? own.name : "";
}

// Only new sentences, so that a screen reader announces each once.
function attend(sentences) {
  const list = $("attention"), shown = [...list.children].map((item) => item.textContent);
  list.hidden = !sentences.length;
  if (sentences.length === shown.length && sentences.every((sentence, i) => sentence === shown[i])) return;
  list.replaceChildren(...sentences.map((sentence) => { const item = document.createElement("li"); item.textContent = sentence; return item; }));
}

function counter({ label, value, alarm }) {
  const made = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
  dt.textContent = label;
  dd.textContent = value;
  if (alarm) made.className = "alarm";
  made.append(dt, dd);
  return made;
}

function micro(us) { return us < 1000 ? `${us < 10 ? us.toFixed(1) : us.toFixed(0)} µs` : `${(us / 1000).toFixed(us < 1e4 ? 1 : 0)} ms`; }

// ---- commands -----------------------------------------------------------------------------------

const buttons = [...document.querySelectorAll("[data-command]")];

// A button that is not available keeps its place in the tab order, and the focus.
function enable() {
  for (const button of buttons) {
    const command = button.dataset.command;
    const may = connected && !deaf() && status && status.reachable && status.role !== "none" && hello.commands.includes(command);
    const useless = !may || !status.allowed.includes(command);
    if (button.getAttribute("aria-disabled") !== String(useless)) button.setAttribute("aria-disabled", String(useless));
    button.title = useless ? why(command, may) : "";
  }
}

function why(command, may) {
  if (!connected || deaf() || !status || !status.reachable) return "The service cannot be reached.";
  if (status.role === "none") return "The user of this live view is not in a group with this permission.";
  if (!may) return "Use the operator's address of this page.";
  return `Not available in ${status.state}.`;
}

// The page may briefly be behind the service: safe commands are always sent.
const SAFE = ["hold", "stop"];

function mayTry(command) { return SAFE.includes(command) && connected && status && status.reachable && status.role !== "none"; }

// An accidental second activation, such as a double click or a held key, must not start a test.
const asking = { button: null, since: 0, label: "", timer: 0 };

function askBack(button) {
  settle();
  // Its text changes but not its size, so that no other button moves under the pointer.
  const { width, height } = button.getBoundingClientRect();
  Object.assign(button.style, { flex: "none", width: `${width}px`, height: `${height}px` });
  Object.assign(asking, { button, label: button.textContent, timer: setTimeout(settle, SURE_MS), since: performance.now() });
  button.classList.add("sure");
  button.textContent = button.dataset.sure;
}

function settle() {
  if (!asking.button) return;
  clearTimeout(asking.timer);
  asking.button.classList.remove("sure");
  asking.button.textContent = asking.label;
  Object.assign(asking.button.style, { flex: "", width: "", height: "" });
  asking.button = null;
}

function give(button, { detail, timeStamp }) {
  const { command, sure } = button.dataset;
  if (button.getAttribute("aria-disabled") === "true" && !mayTry(command)) {
    answer({ ok: false, text: button.title });
    return;
  }
  if (sure && detail > 1) return;
  if (sure && asking.button !== button) { askBack(button); return; }
  if (sure && timeStamp - asking.since < SURE_AFTER_MS) return;
  settle();
  if (!send(command === "arm" ? { command, digest: status.digest } : { command })) answer({ ok: false, text: "Not sent: there is no connection" });
}

let answered = 0;
function answer({ ok, text: words }) {
  clearTimeout(answered);
  answered = setTimeout(() => { $("answer").textContent = ""; }, ANSWER_MS);
  $("answer").textContent = words;
  $("answer").className = ok ? "" : "bad";
}

for (const button of buttons) {
  button.addEventListener("click", (event) => give(button, event));
  button.addEventListener("keydown", (event) => { if (event.repeat && event.key === "Enter") event.preventDefault(); });
}

// ---- the view -----------------------------------------------------------------------------------

function position(atSeconds) { return store.zero + atSeconds * hello.fs_hz; }

function columns() { return Math.max(64, Math.min(2048, Math.round($("displacement").clientWidth - 68))); }

function ask(withOutline) {
  if (following) send({ view: { follow: true, seconds, columns: columns(), axis } });
  else send({ view: { first: shown[0], last: shown[1], columns: columns(), outline: withOutline === true, axis } });
}

function look(first, last, withOutline) {
  const head = store.head;
  if (!head) return;
  const [low, high] = [head.first, head.last], length = Math.min(Math.max(last - first, LEAST_S * hello.fs_hz), Math.max(high - low, 1));
  first = Math.max(low, Math.min(first, high - length));
  const turned = following;
  following = false;
  shown = [first, first + length];
  outline.window = shown;
  outline.draw();
  press();
  ask(turned || withOutline);
}

function follow() {
  following = true;
  playing = 0;
  press();
  ask();
}

function zoom(factor, about) {
  const [first, last] = shown, at = about === undefined ? (first + last) / 2 : about;
  if (following) {
    setLength(Math.max(0.5, Math.min(120, seconds * factor)));
    return;
  }
  look(at - (at - first) * factor, at + (last - at) * factor);
}

function scrub(part) { const by = part * (shown[1] - shown[0]); look(shown[0] + by, shown[1] + by); }

function everything() { if (store.head) look(store.head.first, store.head.last); }

function setLength(length) {
  seconds = length;
  if (following) { press(); ask(); } else look(shown[1] - seconds * hello.fs_hz, shown[1]);
}

function togglePlay() {
  playing = playing ? 0 : performance.now();
  if (playing && shown[1] >= store.head.last - 1) look(store.head.first, store.head.first + shown[1] - shown[0]);
  press();
}

let asked = 0;
function play() {
  const now = performance.now();
  if (now - asked < 33) return;
  const by = (now - playing) / 1000 * hello.fs_hz;
  asked = playing = now;
  if (shown[1] >= store.head.last) { playing = 0; press(); return; }
  look(shown[0] + by, shown[1] + by);
}

function press() {
  const still = !following;
  $("follow").hidden = hello.past;
  $("follow").textContent = following ? "Pause" : "Follow";
  $("follow").setAttribute("aria-pressed", String(following));
  $("play").hidden = !still;
  $("play").textContent = playing ? "Pause" : "Play";
  $("play").setAttribute("aria-pressed", String(Boolean(playing)));
  $("outline").hidden = !still;
  $("all").hidden = !still;
  $("back").disabled = $("forth").disabled = following;
  for (const button of document.querySelectorAll("[data-seconds]")) {
    const length = following ? seconds : (shown[1] - shown[0]) / hello.fs_hz;
    button.setAttribute("aria-current", String(Math.abs(Number(button.dataset.seconds) - length) < 0.01));
  }
  if (store && store.head) sayShown();
}

$("follow").addEventListener("click", () => (following ? look(shown[0], shown[1]) : follow()));
$("play").addEventListener("click", togglePlay);
$("all").addEventListener("click", everything);
$("back").addEventListener("click", () => scrub(-0.5));
$("forth").addEventListener("click", () => scrub(0.5));
$("out").addEventListener("click", () => zoom(2));
$("in").addEventListener("click", () => zoom(0.5));
for (const button of document.querySelectorAll("[data-seconds]")) button.addEventListener("click", () => setLength(Number(button.dataset.seconds)));

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !store || !store.head) return;
  const keys = {
    ArrowLeft: () => scrub(event.shiftKey ? -1 : -0.1), ArrowRight: () => scrub(event.shiftKey ? 1 : 0.1),
    "+": () => zoom(0.8), "-": () => zoom(1.25),
    Home: () => look(store.head.first, store.head.first + shown[1] - shown[0]),
    End: () => (hello.past ? look(store.head.last - shown[1] + shown[0], store.head.last) : follow()),
  };
  // A space on a button presses that button.
  if (event.key === " " && event.target.tagName !== "BUTTON") keys[" "] = () => (hello.past || playing ? togglePlay() : $("follow").click());
  const act = keys[event.key];
  if (act) { event.preventDefault(); act(); }
});

// ---- the socket ---------------------------------------------------------------------------------

function hears() { heard = performance.now(); deafLooks = 0; }

send = connect({
  hello(found) {
    hears();
    connected = true;
    const again = hello !== null;
    hello = found;
    store = new Store(found.channels.length, found.fs_hz);
    build();
    $("commands").hidden = found.past || !found.commands.length;
    $("operator").hidden = !found.operator;
    $("foot").textContent = `rthyb ${found.version}`;
    if (found.past) {
      following = false;
      // The whole test first; the user can then zoom in.
      if (!again) shown = [found.first, Math.max(found.last, found.first + 1)];
    }
    press();
    ask(true);
  },
  status(found) { hears(); onStatus(found); },
  answer,
  frame(frame) {
    hears();
    if (frame.kind === OUTLINE) { outline.window = shown; outline.show(frame); return; }
    if (frame.last !== lastRow) { lastRow = frame.last; rowsCame = performance.now(); }
    shownState = frame.state;
    store.take(frame, following ? seconds * hello.fs_hz : 0);
    dirty = true;
  },
  closed() {
    connected = false;
    enable();
    tell();
  },
});

// Missing data must be visible as well. Checks are counted rather than time: a page that the browser
// has suspended checks once, then receives what has arrived meanwhile.
setInterval(() => {
  deafLooks++;
  if (!hello) return;
  tell();
  if (deafLooks === DEAF_LOOKS) enable();
}, LOOK_MS);

let resized = 0;
addEventListener("resize", () => { clearTimeout(resized); resized = setTimeout(() => { if (hello) ask(true); }, 200); });
requestAnimationFrame(animate);
