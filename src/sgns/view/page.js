// What is said and asked for: the socket, numbers, sliders, keys and gamepad. Charts are
// drawn by charts.js, soil by soil.js.

import { COLOURS, fixed, number, paint } from "./charts.js";
import { View } from "./soil.js";

const $ = (id) => document.getElementById(id);
const SHOWN = 12; // of the charts while driving [s]
const socket = new WebSocket(`ws://${location.host}/socket`);
socket.binaryType = "arraybuffer";

let about = null, view = null, paused = false;
const arrays = []; // what comes before the first frame

socket.onclose = () => say("the connection has ended: start sgns view again, then reload this page", true, true);
socket.onmessage = ({ data }) => {
  if (typeof data === "string") return told(JSON.parse(data));
  if (about.mode === "drive") return arrays.length < 4 ? begun(data) : driven(new Float32Array(data));
  return arrays.length < wanted() ? begun(data) : replayed(data);
};

// --- Before the first frame ----------------------------------------------------------------------------------

const wanted = () => about.bodies.reduce((sum, many) => sum + 1 + 2 * many, 0);

function told(message) {
  if ("mode" in message) return begin(message);
  if ("outside" in message) {
    document.body.classList.toggle("outside", message.outside !== "");
    $("words").textContent = message.outside && `outside the training range: ${message.outside}. Soil and force are a guess`;
  }
  if ("error" in message) say(message.error, true);
  if ("said" in message) say(message.said);
  if ("paused" in message) pause(message.paused);
  for (const [key, value] of Object.entries(message.wanted ?? {})) {
    slide(key, value);
    asked[key] = sliders[key].value; // known there
  }
}

function begin(message) {
  about = message;
  document.title = `sgns view: ${about.title}`;
  $("title").textContent = about.title;
  document.body.classList.add(about.mode);
  for (const one of document.querySelectorAll(".drives")) one.hidden = about.mode !== "drive";
  try {
    view = new View($("soil"), about);
  } catch (error) {
    say(`this browser draws no soil (${error.message}); WebGL 2 is needed`, true, true);
  }
  for (const name of Object.keys(about.scales)) {
    const label = document.createElement("label"), choice = document.createElement("input");
    Object.assign(choice, { type: "radio", name: "colour", value: name });
    choice.onchange = () => colour(name);
    label.append(choice, name);
    $("colours").append(label);
  }
  panels();
  if (about.mode === "drive") controls();
  else film();
}

function begun(data) {
  arrays.push(data);
  if (about.mode === "drive" && arrays.length === 4) {
    const [mean, modes, rest, corners] = arrays;
    view?.decoded(new Float32Array(mean), new Uint16Array(modes), new Float32Array(rest), new Float32Array(corners));
    ready();
  } else if (about.mode === "replay" && arrays.length === wanted()) {
    let at = 0;
    for (const many of about.bodies) {
      const run = { numbers: new Float32Array(arrays[at++]), poses: [] }, corners = [];
      for (let i = 0; i < many; i++) {
        run.poses.push(new Float32Array(arrays[at++]));
        corners.push(new Float32Array(arrays[at++]));
      }
      runs.push(run);
      view?.recorded(about.particles, corners);
    }
    curves();
    ready();
    ask(0);
  }
}

function ready() {
  const first = "error" in about.scales ? "error" : "speed";
  document.querySelector(`#colours [value=${first}]`).checked = true;
  colour(first);
  view?.resize();
  requestAnimationFrame(drawing);
}

function colour(name) {
  const stops = about.colours[name === "error" ? "error" : "speed"], top = about.scales[name];
  view?.colour(name, stops, top);
  $("bar").style.background = `linear-gradient(to right, ${stops.join(",")})`;
  $("top").textContent = name === "speed" ? `${number(1e3 * top, 3)} mm/s` : `${number(1e3 * top, 3)} mm`;
}

function say(words, wrong = false, stay = false) {
  const box = $("said");
  box.textContent = words;
  box.className = wrong ? "there wrong" : "there";
  clearTimeout(say.timer);
  if (!stay) say.timer = setTimeout(() => (box.className = ""), wrong ? 9000 : 5000);
}

// --- Numbers and charts --------------------------------------------------------------------------------------

const reads = {}, charts = [];

function read(name, unit, paint = "", id = name) {
  const grid = $("reads").querySelector(".reads") ?? $("reads").appendChild(Object.assign(document.createElement("div"), { className: "reads" }));
  const [label, value, after] = ["name", "value", "unit"].map((kind) => Object.assign(document.createElement("span"), { className: kind }));
  if (paint) label.append(Object.assign(document.createElement("i"), { style: `background:${paint}` }));
  label.append(name);
  value.id = id;
  after.textContent = unit;
  grid.append(label, value, after);
  reads[id] = value;
}

function chart(title, unit, names) {
  const head = Object.assign(document.createElement("h2"), { textContent: `${title} [${unit}]` });
  const canvas = Object.assign(document.createElement("canvas"), { className: "chart" });
  $("charts").append(head, canvas);
  charts.push({ canvas, names, curves: names.map(() => []), low: 0, high: 1 });
  return charts.at(-1);
}

function panels() {
  const sideways = about.sliders?.some((one) => one.key === "slip_angle") || about.turned;
  about.forces.forEach((name, i) => i !== 1 || sideways ? read(name, "N", [COLOURS[0], "", COLOURS[1]][i], `force${i}`) : null);
  read(about.torques[1], "N m", "", "torque1");
  if (about.wheel) read("sinkage", "mm", "", "sinkage");
  else if (about.mode === "drive") read("depth", "mm", "", "depth");
  chart("force", "N", ["force0", "force2"]);
  chart(about.torques[1], "N m", ["torque1"]);
  if (about.wheel) chart("sinkage", "mm", ["sinkage"]);
}

// The largest that a number reached on its chart; what is small beside it has as many digits.
function sizes(id) {
  const kind = id.replace(/\d/, "");
  const values = charts.flatMap((one) => one.curves.filter((_, i) => one.names[i % one.names.length].startsWith(kind)));
  return values.flat().reduce((most, one) => Math.max(most, Math.abs(one.v) || 0), kind === "depth" ? 100 : 10);
}

// --- Drive ---------------------------------------------------------------------------------------------------

const sliders = {}, held = new Set();
let frame = null, fresh = false, before = "", asked = {};

function controls() {
  $("drive").hidden = false;
  $("cut").hidden = about.wheel;
  for (const one of about.sliders) {
    const box = document.createElement("label"), input = document.createElement("input");
    box.className = "slider";
    const out = document.createElement("output"), track = document.createElement("span");
    Object.assign(input, { type: "range", min: one.low, max: one.high, step: one.step, value: one.value, id: `slider-${one.key}` });
    track.className = "track";
    if (one.trained) {
      const share = (v) => (100 * (Math.min(Math.max(v, one.low), one.high) - one.low)) / (one.high - one.low);
      const band = document.createElement("i");
      Object.assign(band.style, { left: `${share(one.trained[0])}%`, right: `${100 - share(one.trained[1])}%` });
      track.append(band);
    }
    box.append(one.label, out, input, track);
    $("sliders").append(box);
    sliders[one.key] = { ...one, input, out };
    input.oninput = () => slide(one.key, Number(input.value));
    input.onpointerup = () => input.blur(); // arrow keys drive again
    slide(one.key, one.value);
  }
  const way = about.wheel
    ? [["← →  A D", "drive"], ["Q E", "slip"]]
    : [["← →  A D", "drive"], ["↑ ↓  W S", "lift, lower"], ["Q E", "rake"]];
  for (const [keys, what] of [...way, ["gamepad", about.wheel ? "left stick; A pauses, B resets" : "sticks; A cuts again, B resets"], ["drag, wheel", "turn, zoom the view"]]) {
    $("keys").append(Object.assign(document.createElement("b"), { textContent: keys }), Object.assign(document.createElement("span"), { textContent: what }));
  }
  for (const name of ["pause", "reset", "cut", "record"])
    $(name).onclick = (event) => (wish(name), event.currentTarget.blur());
  for (const button of document.querySelectorAll("[data-hold]")) {
    button.onpointerdown = (event) => (button.setPointerCapture(event.pointerId), held.add(button.dataset.hold));
    button.onpointerup = button.onpointercancel = () => held.delete(button.dataset.hold);
  }
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const sliding = event.target instanceof HTMLInputElement && event.target.type === "range";
    if (sliding && event.code.startsWith("Arrow")) return;
    const does = { Space: "pause", KeyR: "reset", KeyP: "cut", KeyV: "record" }[event.code];
    if (does && !(event.target instanceof HTMLButtonElement && event.code === "Space")) {
      event.preventDefault();
      if (!event.repeat) wish(does);
    } else if (DRIVES.includes(event.code)) {
      event.preventDefault();
      held.add(event.code);
    }
  });
  addEventListener("keyup", (event) => held.delete(event.code));
  addEventListener("blur", () => held.clear());
  document.addEventListener("visibilitychange", () => document.hidden && !paused && wish("pause"));
}

const DRIVES = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "KeyA", "KeyD", "KeyW", "KeyS", "KeyQ", "KeyE"];

function wish(name) {
  tell({ way: asked.way ?? 0 }); // sliders that were moved just before
  if (socket.readyState === 1) socket.send(JSON.stringify({ do: name }));
}

// What has changed since the last time.
function tell(now) {
  for (const [key, one] of Object.entries(sliders)) now[key] = one.value;
  const changed = Object.fromEntries(Object.entries(now).filter(([key, value]) => asked[key] !== value));
  if (Object.keys(changed).length && socket.readyState === 1) socket.send(JSON.stringify(changed));
  asked = now;
}

function slide(key, value) {
  const one = sliders[key];
  if (!one) return;
  one.value = Math.min(Math.max(value, one.low), one.high);
  one.input.value = one.value;
  const shown = one.value * one.scale;
  one.out.textContent = `${number(Math.abs(shown) < 1e-9 ? 0 : shown, Math.abs(shown) < 1 ? 2 : 3)} ${one.unit}`;
}

function pause(now) {
  paused = now;
  $("pause").firstElementChild.textContent = paused ? "Go on" : "Pause";
  $("pace").textContent = paused ? "paused" : "…";
}

// What keys, gamepad and sliders ask for, `dt` seconds after the last time.
function steer(dt) {
  const on = (...codes) => (codes.some((code) => held.has(code)) ? 1 : 0);
  let way = on("ArrowRight", "KeyD") - on("ArrowLeft", "KeyA");
  let down = on("ArrowDown", "KeyS") - on("ArrowUp", "KeyW");
  let turn = on("KeyE") - on("KeyQ");
  for (const pad of navigator.getGamepads?.() ?? []) {
    if (!pad) continue;
    const [x = 0, y = 0, z = 0] = pad.axes.map((value) => (Math.abs(value) > 0.15 ? value : 0));
    [way, down, turn] = [way + x, down + y, turn + z];
    const buttons = pad.buttons.map((one) => one.pressed), was = steer.buttons ?? [];
    [about.wheel ? "pause" : "cut", "reset"].forEach((name, i) => buttons[i] && !was[i] && wish(name));
    steer.buttons = buttons;
  }
  if (down && sliders.depth) slide("depth", sliders.depth.value + down * dt * (sliders.speed?.value ?? 0.1));
  if (turn && sliders.rake) slide("rake", sliders.rake.value + 15 * turn * dt);
  if (turn && sliders.slip) slide("slip", sliders.slip.value + 0.2 * turn * dt);
  tell({ way: Math.min(Math.max(way, -1), 1) });
}

function driven(numbers) {
  const at = Object.fromEntries(about.fields.map((name, i) => [name, numbers[i]]));
  if (at.frame && at.frame === frame?.frame) return void ([frame, fresh] = [at, true]); // it is recorded, or no more
  const jumped = frame !== null && at.frame <= frame.frame;
  view?.coordinates(numbers.subarray(about.fields.length));
  if (jumped || frame === null) view?.still();
  frame = at;
  fresh = true;
  for (const one of charts) {
    one.names.forEach((name, i) => {
      const curve = one.curves[i], factor = name === "sinkage" ? 1e3 : 1;
      if (jumped) curve.length = 0;
      curve.push({ t: at.time, v: factor * at[name], s: name.startsWith("force") ? at[`spread${name.at(-1)}`] : NaN });
      if (curve.length > 2 && curve[1].t < at.time - SHOWN) curve.shift();
    });
  }
}

function show() {
  view?.dig(about.wheel ? frame.sinkage : frame.depth);
  view?.panels[0].move(0, [frame.x, frame.y, frame.z, frame.qx, frame.qy, frame.qz, frame.qw]);
  view?.panels[0].push([frame.fx, frame.fy, frame.fz]);
  for (const [id, out] of Object.entries(reads)) {
    out.textContent = fixed(["sinkage", "depth"].includes(id) ? 1e3 * frame[id] : frame[id], sizes(id));
  }
  $("clock").textContent = `${frame.time.toFixed(1)} s`;
  $("pace").textContent = paused ? "paused" : frame.real_time ? `×${frame.real_time.toFixed(2)}` : "…";
  $("step").textContent = `${frame.step_ms.toFixed(1)} ms`;
  const recording = frame.recorded > 0;
  $("record").classList.toggle("on", recording);
  $("record").firstElementChild.textContent = recording ? `Stop, keep ${((frame.recorded - 1) / about.rate).toFixed(1)} s` : "Record";
  const to = Math.max(frame.time, SHOWN);
  for (const one of charts) paint(one, to - SHOWN, to);
}

// --- Replay --------------------------------------------------------------------------------------------------

const runs = [], NUMBERS = ["time", "fx", "fy", "fz", "force0", "force1", "force2", "torque0", "torque1", "torque2", "spread0", "spread1", "spread2", "sinkage"];
let at = -1, waits = false, time = 0, playing = true, got = null;

function film() {
  $("film").hidden = false;
  document.body.classList.toggle("pair", about.runs.length > 1);
  $("when").max = about.frames - 1;
  $("when").oninput = () => (play(false), (time = Number($("when").value) / about.rate));
  $("play").onclick = () => play(!playing);
  addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.code];
    if (event.code === "Space" && !(event.target instanceof HTMLButtonElement)) event.preventDefault(), play(!playing);
    else if (step && event.target.id !== "when") play(false), (time = Math.min(Math.max(at + step, 0), about.frames - 1) / about.rate);
  });
}

function play(now) {
  playing = now;
  if (playing && time * about.rate >= about.frames - 1) time = 0;
  $("play").textContent = playing ? "Pause" : "Play";
}

function curves() {
  const of = (run, name) => Array.from({ length: about.frames }, (_, i) => run.numbers[i * NUMBERS.length + NUMBERS.indexOf(name)]);
  for (const one of charts) {
    const pairs = runs.flatMap((run, r) => one.names.map((name, i) => ({ run, r, name, i })));
    one.curves = pairs.map(({ run, name }) => {
      const time = of(run, "time"), factor = name === "sinkage" ? 1e3 : 1, values = of(run, name);
      const spread = name.startsWith("force") ? of(run, `spread${name.at(-1)}`) : [];
      return values.map((v, i) => ({ t: time[i], v: factor * v, s: spread[i] ?? NaN }));
    });
    one.paints = pairs.map(({ i }) => COLOURS[i]);
    one.dashes = pairs.map(({ r }) => (r ? [4, 3] : []));
  }
  about.runs.forEach((name, i) => {
    const label = Object.assign(document.createElement("div"), { textContent: about.who[i] + (i ? " (dashed)" : ""), title: name });
    label.append(Object.assign(document.createElement("small"), { textContent: name }));
    $("names").append(label);
  });
}

function ask(index) {
  if (waits || index === at || socket.readyState !== 1) return;
  waits = true;
  socket.send(JSON.stringify({ frame: index }));
}

function replayed(data) {
  const many = runs.length, head = new Float32Array(data, 0, 1 + 7 * many), count = (data.byteLength - head.byteLength) / 8 / many;
  at = head[0];
  runs.forEach((_, i) => {
    const [x, y, z, X, Y, Z, fastest] = head.subarray(1 + 7 * i, 8 + 7 * i);
    const shares = new Uint16Array(data, head.byteLength + 8 * count * i, 4 * count);
    view?.positions(i, shares, [x, y, z], [X, Y, Z], fastest, got === null);
  });
  if (got === null) view?.order();
  got = data;
  waits = false;
  fresh = true;
}

function showRuns() {
  const row = at * NUMBERS.length;
  runs.forEach((run, r) => {
    run.poses.forEach((poses, i) => view?.panels[r].move(i, poses, 7 * at));
    view?.panels[r].push(run.numbers.subarray(row + 1, row + 4));
  });
  for (const [id, out] of Object.entries(reads)) {
    const factor = id === "sinkage" ? 1e3 : 1;
    out.textContent = runs.map((run) => fixed(factor * run.numbers[row + NUMBERS.indexOf(id)], sizes(id))).join(" / ");
  }
  const numbers = runs[0].numbers, now = numbers[row], end = numbers[(about.frames - 1) * NUMBERS.length];
  $("when").value = at;
  $("now").textContent = `${now.toFixed(2)} / ${end.toFixed(2)} s`;
  for (const one of charts) paint(one, numbers[0], Math.max(end, 1e-3), now);
  const across = view?.across;
  [...$("names").children].forEach((label, i) => {
    label.style.left = across ? `${(100 * i) / runs.length}%` : "0";
    label.style.top = across ? "0" : `${(100 * i) / runs.length}%`;
    label.style.width = across ? `${100 / runs.length}%` : "100%";
  });
}

// --- Every picture -------------------------------------------------------------------------------------------

let last = 0, pictures = 0, since = 0, slow = 0, moved = 0;

function drawing(now) {
  requestAnimationFrame(drawing);
  const dt = Math.min((now - last) / 1e3, 0.1);
  last = now;
  if (about.mode === "drive") {
    steer(dt);
    if (fresh) show();
  } else {
    if (playing) {
      time += dt * Number($("speed").value);
      if (time * about.rate >= about.frames - 1) time = (about.frames - 1) / about.rate, play(false);
    }
    ask(Math.min(Math.round(time * about.rate), about.frames - 1));
    if (fresh) showRuns();
  }
  if (view && (fresh || view.stale)) {
    view.draw();
    moved = now;
  } else if (view && !view.fine && now - moved > 400) view.draw(true);
  pictures += fresh ? 1 : 0;
  fresh = false;
  slow += 1;
  if (now - since > 1000) {
    $("drawn").textContent = `${Math.round((1e3 * pictures) / (now - since))} /s`;
    if (view && slow < 24 && since && !document.hidden) view.coarser();
    [pictures, since, slow] = [0, now, 0];
  }
}
