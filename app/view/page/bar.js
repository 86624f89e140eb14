"use strict";
// The bar is made of the widgets that the server names, and shows the state that it sends. Text from the server is
// set as text, never as HTML.
const token = location.hash.slice(1);
const [actions, settings, status, said] = ["actions", "settings", "status", "said"].map((id) => document.getElementById(id));
const icons = {
  Pause: "M3 1h4v14H3zM9 1h4v14H9z",
  Resume: "M3 1l11 7-11 7z",
  Back: "M2 1h3v14H2zM14 1v14L5 8z",
  Step: "M2 1l9 7-9 7zM11 1h3v14h-3z",
  Record: "M8 2a6 6 0 1 0 .01 0z",
  Snapshot: "M5 3l1-2h4l1 2h4v11H1V3zM8 5a3.5 3.5 0 1 0 .01 0z",
  Explain: "M2 2h12v9H8l-4 3v-3H2zM5 5h6v1H5zM5 7h4v1H5z",
  Settings: "M1 3h8v2H1zM11 1h2v6h-2zM13 3h2v2h-2zM1 11h3v2H1zM5 9h2v6H5zM8 11h7v2H8z",
};
const drawn = new Map();
let version = 0;
let sending = Promise.resolve();
// The newest state, and what was pressed since, by the number of its command.
let current = null;
// The explanation that was shown last: one from before this page was loaded is not news.
let explained = null;
const why = document.getElementById("why");
const pending = new Map();

// The viewer is a page of another port, for which the browser gets a cookie. It is drawn in a process of its own: a
// slow viewer does not delay the bar, and does not learn the token.
async function openViewer() {
  const answer = await fetch("viewer", { headers: { "X-Token": token }, cache: "no-store" });
  if (!answer.ok) return;
  const address = new URL(location.href);
  address.port = await answer.text();
  address.hash = "";
  address.searchParams.set("url", `rerun+${address.origin}/proxy`);
  document.getElementById("viewer").src = address.href;
}

function make(name, attributes = {}, ...children) {
  const element = Object.assign(document.createElement(name), attributes);
  element.append(...children);
  return element;
}

function face(button, icon, text) {
  if (button.dataset.face === icon + text) return;
  button.dataset.face = icon + text;
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", icons[icon] ?? "");
  const image = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  image.setAttribute("viewBox", "0 0 16 16");
  image.setAttribute("aria-hidden", "true");
  image.append(path);
  button.replaceChildren(...(icon in icons ? [image] : []), make("span", {}, text));
}

function say(text, refused = true) {
  // A program that shows its own frames has no state, and no bar.
  document.querySelector("footer").hidden = false;
  said.textContent = text;
  said.classList.toggle("refused", refused);
}

// In the order of the clicks. The mark stays until the run has answered.
function send(element, line) {
  element.classList.add("pending");
  pending.set(element, Infinity);
  sending = sending.then(async () => {
    try {
      const answer = await fetch("run", { method: "POST", headers: { "X-Token": token }, body: line });
      const text = await answer.text();
      if (!answer.ok) throw new Error(text);
      pending.set(element, Number(text));
      // The run may have been faster.
      if (current.answered >= Number(text)) show(current);
    } catch (error) {
      settle(element);
      say(error instanceof TypeError ? "the run does not answer" : error.message);
    }
  });
}

function settle(element) {
  pending.delete(element);
  element.classList.remove("pending");
}

function widget({ kind, label, lines, choices, step, title }) {
  const isAction = label in icons;
  let control;
  if (kind === "button" || kind === "switch") {
    control = make("button", { type: "button", title });
    face(control, label, label);
    control.addEventListener("click", () => {
      send(control, control.getAttribute("aria-pressed") === "true" ? lines[1] : lines[0]);
    });
    (isAction ? actions : settings).append(control);
  } else {
    control = kind === "choice"
      ? make("select", { title }, ...choices.map((each) => make("option", {}, each)))
      : make("input", { type: "number", step, inputMode: "decimal", title });
    control.addEventListener("change", () => send(control, lines[0] + control.value));
    settings.append(make("label", { title }, label, control));
  }
  control.dataset.label = label;
  drawn.set(label, { control, kind });
}

function show(state) {
  current = state;
  for (const [element, number] of pending) if (number <= state.answered) settle(element);
  for (const each of state.widgets ?? []) if (!drawn.has(each.label)) widget(each);
  for (const [label, { control, kind }] of drawn) {
    const value = state.values[label];
    control.disabled = state.ended || value === null;
    if (kind === "switch") control.setAttribute("aria-pressed", String(value === true));
    else if (!pending.has(control) && (kind === "choice" || (kind === "number" && control !== document.activeElement))) {
      control.value = value ?? "";
    }
    if (label === "Pause") face(control, value ? "Resume" : "Pause", value ? "Resume" : "Pause");
    if (label === "Record") face(control, "Record", value ? state.recording : "Record");
  }
  status.replaceChildren(...state.status.map((part) => make("span", {}, part)));
  say(state.said, state.refused);
  explained ??= state.explained;
  if (state.explained !== explained) explain(state.explained);
}

// The page of an explanation, in a frame of its own: its scripts reach neither this page nor the token.
async function explain(path) {
  explained = path;
  const answer = await fetch("explanation", { headers: { "X-Token": token } });
  const text = await answer.text();
  if (!answer.ok) return say(text);
  why.querySelector("iframe").srcdoc = text;
  why.hidden = false;
}
why.querySelector("button").addEventListener("click", () => (why.hidden = true));

function stop(text) {
  for (const { control } of drawn.values()) control.disabled = true;
  say(text);
}

async function follow() {
  for (;;) {
    try {
      const answer = await fetch(`run?after=${version}`, { headers: { "X-Token": token }, cache: "no-store" });
      if (answer.status === 403) return stop(await answer.text());
      const state = await answer.json();
      if (state.version !== version) show(state);
      version = state.version;
    } catch {
      stop("the run has ended, or cannot be reached");
      version = 0;
      await new Promise((resolve) => setTimeout(resolve, 1000));
    }
  }
}

const more = make("button", { type: "button", id: "more", title: "settings of the segmentation" });
face(more, "Settings", "Settings");
more.setAttribute("aria-expanded", "false");
more.addEventListener("click", () => {
  more.setAttribute("aria-expanded", String(document.body.classList.toggle("open")));
});
actions.append(more);
openViewer();
follow();
