"use strict";
// The page of quest live and quest pick. What comes from outside is set as text, never as markup.

const $ = id => document.getElementById(id);
const mode = document.body.dataset.mode;
const view = $("view"), pen = view.getContext("2d");
const CURVE = 150, EVENTS = 200, NEAR = 14;

let picture = null;            // the ImageBitmap that is shown
let size = [640, 480];         // of the source, pixels
let answers = [];              // of the frame that is shown: the queries of a line of states
let shown = -1;                // its index
let found = [];                // what the finder sees in it (pick)
let placing = null;            // the query whose place is to be pointed at (live)
let drag = null, cross = null; // pixels of the source
let socket = null, paused = false;
const cards = new Map(), curves = new Map();

// ---- picture -------------------------------------------------------------------------------------------------------

function draw() {
  const ratio = window.devicePixelRatio || 1, width = view.clientWidth, height = width * size[1] / size[0];
  view.style.height = `${height}px`;
  view.width = Math.round(width * ratio);
  view.height = Math.round(height * ratio);
  const scale = view.width / size[0];
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  if (picture) pen.drawImage(picture, 0, 0, size[0], size[1]);
  const unit = ratio / scale;  // one pixel of the page
  for (const one of found) drawFound(one, unit);
  for (const one of answers) drawAnswer(one, unit);
  if (mode === "pick" && !running()) for (const one of picked) if (one.kind === "point" && one.frame === shown) drawAnswer(one, unit);
  pen.lineWidth = 1.5 * unit;
  pen.strokeStyle = "#fff";
  if (drag && drag.moved) pen.strokeRect(drag.x0, drag.y0, drag.x - drag.x0, drag.y - drag.y0);
  if (cross) {
    pen.beginPath();
    pen.moveTo(cross[0] - 12 * unit, cross[1]); pen.lineTo(cross[0] + 12 * unit, cross[1]);
    pen.moveTo(cross[0], cross[1] - 12 * unit); pen.lineTo(cross[0], cross[1] + 12 * unit);
    pen.stroke();
  }
}

function drawAnswer(one, unit) {
  if (!one.uv_px || one.uv_px[0] === null) return;
  const [x, y] = one.uv_px, lost = one.state === "lost", r = 7 * unit;
  const colour = lost ? "#ff4842" : one.colour;
  if (one.lines && !lost) drawJoint(one, unit);
  for (const [style, width] of [["#000c", 5], [colour, 2.5]]) {
    pen.strokeStyle = style; pen.lineWidth = width * unit;
    pen.setLineDash(one.state === "held" ? [4 * unit, 3 * unit] : []);
    pen.beginPath();
    if (lost) {
      pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r); pen.moveTo(x + r, y - r); pen.lineTo(x - r, y + r);
    } else pen.arc(x, y, r, 0, 2 * Math.PI);
    pen.stroke();
  }
  pen.setLineDash([]);
  write(one.name || one.label || "point", x + 10 * unit, y - 8 * unit, colour, unit);
}

function drawJoint(one, unit) {
  for (const [name, dash] of [["path", []], ["axis", [6 * unit, 4 * unit]]]) {
    pen.setLineDash(dash);
    for (const [style, width] of [["#0008", 4], [one.colour, 2]]) {
      pen.strokeStyle = style; pen.lineWidth = width * unit;
      pen.beginPath();
      for (const [x, y] of one.lines[name] || []) pen.lineTo(x, y);
      pen.stroke();
    }
  }
  pen.setLineDash([]);
}

function drawFound(one, unit) {
  const [x0, y0, x1, y1] = one.box_px;
  pen.setLineDash([5 * unit, 4 * unit]);
  pen.strokeStyle = "#fff"; pen.lineWidth = 1.5 * unit;
  pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
  pen.setLineDash([]);
  write(`${one.label} ${Math.round(100 * one.p)} %`, x0, y0 - 4 * unit, "#fff", unit);
}

function write(text, x, y, colour, unit) {
  pen.font = `${13 * unit}px system-ui, sans-serif`;
  const width = pen.measureText(text).width + 6 * unit;
  x = Math.max(0, Math.min(x, size[0] - width));
  y = Math.max(14 * unit, y);
  pen.fillStyle = "#000b"; pen.fillRect(x, y - 13 * unit, width, 17 * unit);
  pen.fillStyle = colour; pen.fillText(text, x + 3 * unit, y);
}

function at(event) {
  const box = view.getBoundingClientRect();
  const inside = (value, most) => Math.min(Math.max(value, 0), most);
  return [inside((event.clientX - box.left) / box.width * size[0], size[0]),
          inside((event.clientY - box.top) / box.height * size[1], size[1])];
}

view.addEventListener("pointerdown", event => {
  const [x, y] = at(event);
  drag = {x0: x, y0: y, x, y, moved: false, frame: shown};
  view.setPointerCapture(event.pointerId);
});
view.addEventListener("pointermove", event => {
  if (!drag) return;
  [drag.x, drag.y] = at(event);
  drag.moved = drag.moved || Math.hypot(drag.x - drag.x0, drag.y - drag.y0) * view.clientWidth / size[0] > 6;
  draw();
});
view.addEventListener("pointerup", () => {
  if (!drag) return;
  const {x0, y0, x, y, moved, frame} = drag;
  drag = null;
  if (moved) point((x0 + x) / 2, (y0 + y) / 2, frame);  // what a box holds is followed at its centre
  else point(x0, y0, frame);
});
view.addEventListener("keydown", event => {
  const step = event.shiftKey ? 1 : 10, move = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[event.key];
  if (move) {
    cross = cross || [size[0] / 2, size[1] / 2];
    cross = [0, 1].map(i => Math.min(Math.max(cross[i] + step * move[i], 0), size[i]));
  } else if (event.key === "Enter" && cross) { point(cross[0], cross[1], shown); }
  else return;
  event.preventDefault();
  draw();
});
view.addEventListener("blur", () => { cross = null; draw(); });
document.addEventListener("keydown", event => {
  if (event.key !== "Escape") return;
  placing = drag = null; hint("");
});
window.addEventListener("resize", draw);

// ---- words ---------------------------------------------------------------------------------------------------------

function hint(text) { $("hint").textContent = text; $("hint").hidden = !text; }

function say(text, kind = "", frame = null) {
  const line = document.createElement("li");
  line.className = kind;
  line.textContent = (frame === null ? "" : `frame ${frame}  `) + text;
  $("events").prepend(line);
  while ($("events").childElementCount > EVENTS) $("events").lastElementChild.remove();
}

function notes(words) {
  $("notes").replaceChildren(...words.map(word => {
    const line = document.createElement("li");
    line.textContent = `note: ${word}`;
    return line;
  }));
}

function joint(one) {
  if (!one.joint) return "joint unknown";
  const {kind, q, q_seen} = one.joint;
  if (!q_seen) return kind;
  const turn = kind === "revolute", show = v => v === null ? "?" : turn ? `${Math.round(v * 180 / Math.PI)}°` : `${v.toFixed(2)} m`;
  return `${kind} ${show(q)} (${show(q_seen[0])} to ${show(q_seen[1])})`;
}

function place3d(one) {
  const p = one.point_world;
  return p && p[0] !== null ? p.map(v => v.toFixed(2)).join(", ") + " m" : one.uv_px && one.uv_px[0] !== null
    ? one.uv_px.map(v => v.toFixed(0)).join(", ") + " px" : "";
}

// ---- cards ---------------------------------------------------------------------------------------------------------

function element(tag, className, text = "") {
  const made = document.createElement(tag);
  made.className = className; made.textContent = text;
  return made;
}

function card(key, {rename, remove}) {
  const box = element("li", "card"), row = element("div", "row"), name = element("input", "");
  name.setAttribute("aria-label", "name"); name.placeholder = "name";
  name.addEventListener("change", () => rename(name.value));
  name.addEventListener("keydown", event => { if (event.key === "Enter") name.blur(); });
  const state = element("span", ""), drop = element("button", "", "Remove"), numbers = element("div", "numbers");
  drop.addEventListener("click", remove);
  row.append(name, state, drop);
  const curve = document.createElement("canvas"), why = element("p", "why"), answer = element("div", "bar");
  curve.setAttribute("role", "img");
  box.append(row, numbers, curve, why, answer);
  if (mode === "live") {
    const right = element("button", "", "It is right"), there = element("button", "", "It is there …");
    right.addEventListener("click", () => send({do: "confirm", query: key}));
    there.addEventListener("click", () => { placing = key; hint(`Click where ${name.value} is. Escape cancels.`); view.focus(); });
    answer.append(right, there);
  }
  $("queries").append(box);
  const made = {box, name, state, numbers, curve, why, answer, drop};
  cards.set(key, made);
  return made;
}

function show(key, one, made) {
  const alarm = Boolean(one.alarm);
  made.box.style.setProperty("--colour", one.colour);
  made.box.classList.toggle("alarm", alarm);
  if (document.activeElement !== made.name) made.name.value = one.name || "";
  made.state.className = one.state || "muted"; made.state.textContent = one.state || "";
  made.numbers.textContent = one.words || [one.label, place3d(one), joint(one), one.lost_p === null || one.lost_p === undefined ? "" : `P(lost) ${one.lost_p.toFixed(2)}`].filter(Boolean).join(" · ");
  made.why.textContent = alarm ? `Alarm: ${one.alarm.reason}` : "";
  made.why.hidden = !alarm;
  made.answer.hidden = mode !== "live" || !(alarm || one.state);
  plot(key, one, made);
}

function plot(key, one, made) {
  made.curve.hidden = one.lost_p === null || one.lost_p === undefined;
  if (made.curve.hidden) return;
  const values = curves.get(key) || [], ratio = window.devicePixelRatio || 1;
  values.push([one.lost_p, Boolean(one.alarm)]);
  while (values.length > CURVE) values.shift();
  curves.set(key, values);
  const canvas = made.curve, w = canvas.clientWidth * ratio, h = canvas.clientHeight * ratio, p = canvas.getContext("2d");
  canvas.width = w; canvas.height = h;
  const style = getComputedStyle(document.body);
  p.fillStyle = style.getPropertyValue("--alarm-paper");
  values.forEach(([, open], i) => { if (open) p.fillRect(i * w / CURVE, 0, w / CURVE + 1, h); });
  p.strokeStyle = style.getPropertyValue("--line"); p.lineWidth = ratio;
  p.strokeRect(0, 0, w, h);
  p.strokeStyle = one.colour; p.lineWidth = 2 * ratio;
  p.beginPath();
  values.forEach(([v], i) => p.lineTo(i * w / CURVE, h - 2 * ratio - v * (h - 4 * ratio)));
  p.stroke();
  canvas.setAttribute("aria-label", `P(lost), the last ${values.length} frames; now ${one.lost_p.toFixed(2)}`);
}

function showAll(list) {
  const keys = new Set(list.map(([key]) => key));
  for (const [key, made] of cards) if (!keys.has(key)) { made.box.remove(); cards.delete(key); curves.delete(key); }
  for (const [key, one, actions] of list) show(key, one, cards.get(key) || card(key, actions));
  $("empty").hidden = list.length > 0;
}

// ---- what is sent --------------------------------------------------------------------------------------------------

function send(edit) {
  if (running()) socket.send(JSON.stringify(edit));
  else say("nothing is running", "error");
}

async function post(path, body) {
  const answer = await (await fetch(path, {method: "POST", body: JSON.stringify(body)})).json();
  if (answer.error) say(answer.error, "error");
  else if (answer.done) say(answer.done);
  return answer;
}

const running = () => socket !== null && socket.readyState === WebSocket.OPEN;

function given() {
  const name = $("name").value.trim(), label = $("label").value;
  $("name").value = "";
  return {...(name && {name}), ...(label && {label})};
}

function point(x, y, frame) {
  if (mode === "pick") { if (!running()) pick(x, y, frame); return; }
  if (placing !== null) { send({do: "place", query: placing, frame, x, y}); placing = null; hint(""); }
  else send({do: "point", frame, x, y, ...given()});
}

$("ask").addEventListener("submit", event => {
  event.preventDefault();
  const one = given();
  if (!one.label) { say("choose a label first", "error"); return; }
  if (mode === "pick") add({kind: "semantic", ...one}); else send({do: "label", ...one});
});
$("tell").addEventListener("submit", event => {
  event.preventDefault();
  const words = $("words").value.trim();
  if (!words) return;
  $("words").value = "";
  if (mode === "pick") add({kind: "text", words, name: words}); else send({do: "text", words});
});
$("pause").addEventListener("click", () => { send({do: paused ? "resume" : "pause"}); paused = !paused; $("pause").textContent = paused ? "Resume" : "Pause"; });

// ---- what comes ----------------------------------------------------------------------------------------------------

function listen(first = 0) {
  socket = new WebSocket(new URL("feed", location.href.replace(/^http/, "ws")));
  socket.binaryType = "arraybuffer";
  const mine = socket;
  let handled = Promise.resolve();
  const then = what => { handled = handled.then(() => mine === socket && what()).catch(error => say(String(error), "error")); };
  socket.onmessage = event => then(() => hear(mine, event.data, first));  // in the order in which it comes, though pictures take time to decode
  socket.onclose = () => then(() => { if (mode === "live" && !$("status").dataset.ended) finish("the program ended"); socket = null; });
}

async function hear(from, data, first) {
  if (typeof data === "string") {
    const told = JSON.parse(data);
    if (told.error) say(told.error, "error");
    if (told.done) say(told.done);
    if (told.ended) { say(told.ended); finish(told.ended); }
    return;
  }
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], {type: "image/jpeg"}));
  if (from.readyState === WebSocket.OPEN) from.send("ready");
  take(header, bitmap, first);
}

function take(header, bitmap, first) {
  for (const one of header.events) say((one.name ? `${one.name}: ` : "") + one.text, one.kind, one.frame + first);
  if (drag) { bitmap.close(); return; }  // what is pointed at stays until it is pointed out
  if (picture) picture.close();
  picture = bitmap; size = header.size; shown = header.frame + first; found = [];
  answers = header.state.queries.map((one, i) => ({...one, colour: `rgb(${header.colours[i].join(" ")})`, lines: header.joints[i]}));
  $("status").textContent = [`frame ${shown}`, `${header.state.stamp_s.toFixed(2)} s`, header.rate ? `${header.rate.toFixed(1)} frames/s` : "",
    header.watched ? "" : "no alarms: no calibration", ...header.state.flags].filter(Boolean).join(" · ");
  const act = key => ({rename: name => send({do: "rename", query: key, name}), remove: () => send({do: "retire", query: key})});
  if (mode === "live") showAll([
    ...answers.map(one => [one.query, one, act(one.query)]),
    ...header.waiting.map(one => [one.query, {name: "", words: `waits: ${one.words}`, colour: "var(--line)"}, act(one.query)])]);
  else answers.forEach((one, i) => { const made = cards.get(picked[one.query]?.id); if (made) show(picked[one.query].id, {...one, colour: picked[one.query].colour}, made); });
  notes(header.notes);
  if (mode === "pick") { $("slider").value = shown; $("at").textContent = shown; }
  draw();
}

function finish(words) {
  $("status").textContent = words; $("status").dataset.ended = "yes"; $("pause").disabled = true;
  if (mode === "pick") { if (socket) socket.close(); socket = null; $("preview").textContent = "Preview"; go(Number($("slider").value)); }
}

// ---- picking -------------------------------------------------------------------------------------------------------

const picked = [];
const COLOURS = ["#38bdff", "#ffb81c", "#3cdc82", "#ce82ff", "#fff05a", "#20e6d2", "#ff8cbe", "#96a5ff", "#beeb50", "#ff965a"];
let count = 0, asked = 0, changed = false;

function add(one) {
  picked.push({...one, id: `p${count}`, colour: COLOURS[count % COLOURS.length]});
  count += 1; changed = true;
  list();
}

function list() {
  showAll(picked.map(one => [one.id, {...one, words: one.kind === "point" ? `${one.label || "point"} · frame ${one.frame} · ${one.uv_px.map(v => v.toFixed(1)).join(", ")} px`
    : one.kind === "text" ? `in words · ${one.words}` : `the most certain ${one.label || "entity"}`}, {
    rename: name => { one.name = name.trim(); changed = true; draw(); },
    remove: () => { picked.splice(picked.indexOf(one), 1); changed = true; list(); draw(); }}]));
  draw();
}

function pick(x, y, frame) {
  const inside = found.filter(one => x >= one.box_px[0] && x <= one.box_px[2] && y >= one.box_px[1] && y <= one.box_px[3]);
  const near = (inside.length ? inside : found).map(one => [Math.hypot(one.uv_px[0] - x, one.uv_px[1] - y), one]).sort((a, b) => a[0] - b[0])[0];
  const one = near && (inside.length || near[0] < NEAR * size[0] / view.clientWidth) ? near[1] : null;
  add({kind: "point", frame, uv_px: one ? one.uv_px : [x, y], ...(one && {label: one.label}), ...given()});
}

async function go(t) {
  const mine = ++asked;
  const bitmap = await createImageBitmap(await (await fetch(`frame/${t}`)).blob());
  if (mine !== asked || running()) { bitmap.close(); return; }
  if (picture) picture.close();
  picture = bitmap; shown = t; answers = []; found = [];
  $("at").textContent = t;
  list();
}

const plain = () => picked.map(({id, colour, state, ...one}) => Object.fromEntries(Object.entries(one).filter(([, value]) => value !== "")));

async function start() {
  const told = await (await fetch("start")).json();
  size = told.size; notes(told.notes);
  $("slider").max = told.frames - 1;
  $("status").textContent = `${told.frames} frames · saves ${told.out}`;
  told.queries.forEach(add);
  changed = false;
  const step = by => { $("slider").value = Number($("slider").value) + by; if (!running()) go(Number($("slider").value)); };
  $("slider").addEventListener("input", () => step(0));
  $("back").addEventListener("click", () => step(-1));
  $("next").addEventListener("click", () => step(1));
  $("find").addEventListener("click", async () => {
    const t = shown;
    $("find").disabled = true; hint("looking for what can be taken hold of …");
    const seen = (await (await fetch(`found/${t}`)).json()).found;
    $("find").disabled = false; hint("");
    if (t !== shown) return;
    found = seen;
    say(seen.length ? `found ${seen.length}: click those to follow` : "nothing found here; click what you mean");
    draw();
  });
  $("preview").addEventListener("click", async () => {
    if (running()) { await post("stop", {}); return; }
    const answer = await post("preview", {queries: plain()});
    if (answer.error) return;
    $("preview").textContent = "Stop"; curves.clear();
    listen(answer.first);
  });
  $("save").addEventListener("click", async () => { if (!(await post("save", {queries: plain()})).error) changed = false; });
  $("done").addEventListener("click", async () => {
    if (changed && !confirm("Close without saving?")) return;
    changed = false;
    await post("done", {}); $("status").textContent = "closed; this tab can go";
  });
  window.addEventListener("beforeunload", event => { if (changed) event.preventDefault(); });
  await go(0);
}

if (mode === "pick") start(); else listen();
