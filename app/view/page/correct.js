"use strict";
// The photo with outlined and numbered objects, beside the viewer or over it: what is chosen there is merged or split.
// Uses the bar's functions; the server checks and answers commands as it does the bar's.
const panel = document.getElementById("correct");
const canvas = panel.querySelector("canvas");
const outlines = document.createElement("canvas");
const chosen = new Set();
let picture = null;
let asked = 0;
let fetching = false;

function tool(label, line, isUsable) {
  const button = make("button", { type: "button", textContent: label });
  button.addEventListener("click", () => send(button, line()));
  panel.querySelector("nav").append(button);
  return { button, isUsable };
}

const list = () => [...chosen].join(" ");
const tools = [
  tool("Merge", () => `merge ${list()}`, () => chosen.size > 1),
  tool("Split", () => `split ${list()}`, () => chosen.size === 1),
  tool("Split all", () => `split ${list()} all`, () => chosen.size === 1),
  tool("Undo", () => "undo", (state) => state.corrections !== ""),
  tool("Save", () => "save", () => true),
];
let newest = { corrections: "", values: {} };

function enable() {
  for (const { button, isUsable } of tools) button.disabled = !newest.values.Pause || !isUsable(newest);
}

const toggle = make("button", { type: "button", id: "toggle", title: "correct the objects of this frame: merge, split, undo, save" });
face(toggle, "Correct", "Correct");
toggle.setAttribute("aria-pressed", "false");
toggle.addEventListener("click", () => {
  const isOpen = document.body.classList.toggle("correcting");
  toggle.setAttribute("aria-pressed", String(isOpen));
  panel.hidden = !isOpen;
  if (isOpen && !newest.values.Pause) send(toggle, "pause");
  update();
});
actions.append(toggle);

document.addEventListener("run", ({ detail }) => {
  newest = detail;
  toggle.disabled = newest.ended;
  update();
});

// One request at a time; the newest picture is the only one of interest.
async function update() {
  enable();
  if (panel.hidden || fetching || !newest.shown || newest.shown === asked) return;
  fetching = true;
  asked = newest.shown;
  try {
    const answer = await fetch("objects", { headers: { "X-Token": token }, cache: "no-store" });
    if (!answer.ok) throw new Error(await answer.text());
    const content = await answer.json();
    const photo = new Image();
    photo.src = `data:image/jpeg;base64,${content.photo}`;
    await photo.decode();
    picture = { ...content, photo, labels: labelsOf(content) };
    picture.places = placesOf(picture);
    chosen.clear();
    draw();
  } catch (error) {
    // Tried again with the next state.
    asked = 0;
    fetching = false;
    return say(error.message);
  }
  fetching = false;
  update();
}

function labelsOf({ width, height, runs }) {
  const labels = new Uint16Array(width * height);
  let end = 0;
  for (let n = 0; n < runs.length; n += 2) labels.fill(runs[n], end, (end += runs[n + 1]));
  return labels;
}

// The pixel of each object that is nearest to the mean of all of its pixels.
function placesOf({ width, labels }) {
  const sums = new Map();
  labels.forEach((label, n) => {
    if (!label) return;
    if (!sums.has(label)) sums.set(label, { label, count: 0, x: 0, y: 0, least: Infinity });
    const sum = sums.get(label);
    sum.count += 1;
    sum.x += n % width;
    sum.y += Math.floor(n / width);
  });
  labels.forEach((label, n) => {
    if (!label) return;
    const sum = sums.get(label);
    const away = Math.hypot((n % width) - sum.x / sum.count, Math.floor(n / width) - sum.y / sum.count);
    if (away < sum.least) Object.assign(sum, { least: away, place: n });
  });
  return [...sums.values()].sort((one, other) => other.count - one.count);
}

function draw() {
  if (!picture) return;
  const { width, height, photo, labels, places, colors } = picture;
  Object.assign(outlines, { width, height });
  const image = new ImageData(width, height);
  labels.forEach((label, n) => {
    const isEdge = [1, 2].some((step) => [step, -step, step * width, -step * width].some((by) => (labels[n + by] ?? label) !== label));
    const isPlain = !chosen.has(label) && (!isEdge || label === places[0].label);
    if (label && !isPlain) image.data.set([...colors[label], isEdge ? 255 : 150], 4 * n);
  });
  outlines.getContext("2d").putImageData(image, 0, 0);
  const scale = Math.min(canvas.clientWidth / width, canvas.clientHeight / height) * devicePixelRatio;
  Object.assign(canvas, { width: Math.round(width * scale), height: Math.round(height * scale) });
  const pen = canvas.getContext("2d");
  pen.drawImage(photo, 0, 0, canvas.width, canvas.height);
  pen.drawImage(outlines, 0, 0, canvas.width, canvas.height);
  const size = Math.min(14 * devicePixelRatio, 18 * scale);
  Object.assign(pen, { font: `600 ${size}px system-ui, sans-serif`, textAlign: "center", textBaseline: "middle" });
  Object.assign(pen, { lineWidth: 0.28 * size, lineJoin: "round", strokeStyle: "#000", fillStyle: "#fff" });
  for (const { label, place } of places) {
    const at = [((place % width) + 0.5) * scale, (Math.floor(place / width) + 0.5) * scale];
    pen.strokeText(label, ...at);
    pen.fillText(label, ...at);
  }
  enable();
}
new ResizeObserver(draw).observe(canvas);

// The object at a click, or within a finger's breadth of it.
canvas.addEventListener("click", ({ offsetX, offsetY }) => {
  if (!picture) return;
  const { width, height, labels } = picture;
  const scale = Math.min(canvas.clientWidth / width, canvas.clientHeight / height);
  const [left, top] = [(canvas.clientWidth - width * scale) / 2, (canvas.clientHeight - height * scale) / 2];
  const [x, y] = [Math.floor((offsetX - left) / scale), Math.floor((offsetY - top) / scale)];
  const reach = Math.ceil(12 / scale);
  let [found, least] = [0, reach];
  for (let v = Math.max(0, y - reach); v <= Math.min(height - 1, y + reach); v += 1) {
    for (let u = Math.max(0, x - reach); u <= Math.min(width - 1, x + reach); u += 1) {
      const away = Math.hypot(u - x, v - y);
      if (labels[v * width + u] && away < least) [found, least] = [labels[v * width + u], away];
    }
  }
  if (!found) return;
  if (!chosen.delete(found)) chosen.add(found);
  draw();
});
