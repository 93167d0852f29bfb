// Passes updates of the server to the parts of the page, and commands of the user to the pipeline.

import { BoxForm } from "./boxform.js";
import { Charts } from "./charts.js";
import { Objects } from "./objects.js";
import { Stage } from "./stage.js";
import { SurprisingFrames } from "./surprising.js";
import { Trees } from "./trees.js";

const MESSAGE_SECONDS = 8;
const $ = (selector) => document.querySelector(selector);
const charts = new Charts($(".charts"));
const trees = new Trees($(".trees"), $("#tree-summary"));
const surprising = new SurprisingFrames($(".surprising"), $("#surprising-summary"));
const objects = new Objects($(".objects"), { choose: showChosen, forget: askToForget });
const form = new BoxForm(objects);
const stage = new Stage($("#stage"), $("#picture"), objects, { pause, follow, changed: showDrawing });
let status = { phase: "waiting" };
let frame = null; // number and time of the newest frame
let paused = false;
let closed = false; // whether the server has announced its shutdown
let silent = false; // whether the server does not answer
let fading = 0; // the timer of the message
let events = null; // the connection to the server, null while the page is hidden
const stream = decodeURIComponent(location.pathname).match(/\/streams\/([^/]+)\/$/)?.[1] ?? ""; // its name, on the page of a fleet

/** Send a command; returns the answer, or null if it was rejected, after showing the reason. */
async function sendCommand(verb, more = {}) {
  let answer;
  try {
    const response = await fetch("control", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ verb, ...more }),
    });
    const json = (response.headers.get("Content-Type") || "").startsWith("application/json");
    answer = json ? await response.json() : { done: false, reason: (await response.text()).trim() };
  } catch {
    answer = { done: false, reason: "the server of this page does not answer" };
  }
  showMessage(answer.reason, !answer.done);
  if (!answer.done) return null;
  if (verb === "pause" || verb === "resume") showPaused(verb === "pause");
  return answer;
}

/** Show a message until the next one; one that nothing has to be done about fades. */
function showMessage(text, wrong = false, fades = !wrong) {
  const message = $("#message");
  message.textContent = text;
  message.classList.toggle("wrong", wrong);
  message.classList.remove("faded");
  clearTimeout(fading);
  if (fades) fading = setTimeout(() => message.classList.add("faded"), MESSAGE_SECONDS * 1000);
}

/** Pause for drawing a box; returns the frame that the box will apply to, and the function that resumes. */
async function pause() {
  if (isWaiting()) return { frame: Infinity, leave: null };
  const before = paused;
  const answer = await sendCommand("pause");
  if (!answer) return null;
  showMessage("Paused for your box.", false, false);
  // A paused pipeline holds the frame after the last tracked one; the box applies to that frame.
  return { frame: answer.frame + 1, leave: before ? null : () => sendCommand("resume") };
}

/** Send the box, as that of a new object or of the chosen one. */
async function follow(box, leave) {
  if (form.error) {
    showMessage(form.error, true);
    form.name.focus();
    return false;
  }
  const answer = await sendCommand("set-box", { ...form.fields, box: box.map((side) => Math.round(side * 10) / 10) });
  if (!answer) return false;
  objects.choose(answer.object);
  if (leave) {
    await leave();
    showMessage(answer.reason);
  }
  return true;
}

function showDrawing(drawing, box) {
  if (drawing && $("#drawing").hidden) form.begin();
  $("#watching").hidden = drawing;
  $("#drawing").hidden = !drawing;
  $("#follow").disabled = !box;
}

function askToForget(name) {
  $("#forget-title").textContent = `Forget ${name || "the object without a name"}?`;
  $("#forget-dialog").dataset.object = name;
  $("#forget-dialog").showModal();
}

/** Show the charts and the trees of another object. */
function showChosen(name) {
  charts.choose(name);
  trees.choose(name);
  if (stage.drawing) form.offer();
  showFrame();
  showObjects();
}

/** Show the list, unless the only object has no name. */
function showObjects() {
  $("#objects").hidden = objects.single;
  $("main").classList.toggle("several", !objects.single);
  for (const target of document.querySelectorAll(".of")) target.textContent = objects.single ? "" : ` of ${objects.chosen || "the object without a name"}`;
  stage.draw();
}

function showFrame() {
  const model = objects.get(objects.chosen)?.version;
  $("#frame").textContent = frame ? `frame ${frame.number}, ${frame.time.toFixed(1)} s${model === undefined ? "" : `, model ${model}`}` : "";
}

function showPaused(now) {
  paused = now;
  $("#pause").textContent = paused ? "Resume" : "Pause";
  $("#pause").setAttribute("aria-pressed", String(paused));
  showState();
}

function showState() {
  const running = status.phase === "running" && !silent;
  const lost = running && status.lost_seconds > 0;
  const waiting = running && isWaiting();
  let state = running && !waiting ? stateOfAll() : running ? "waiting" : status.phase;
  let words = { waiting: "waiting", silent: "pipeline silent", ended: "ended" }[state] || state;
  if (silent && status.phase !== "ended") [state, words] = ["silent", "page stopped"];
  else if (lost) [state, words] = ["silent", `source lost for ${Math.round(status.lost_seconds)} s`];
  else if (waiting) words = "waiting for a box";
  else if (running && objects.list.length > 1) words = `${objects.list.filter((one) => one.state !== "absent").length} of ${objects.list.length} present`;
  if (running && !lost && !waiting && paused) words = `paused, ${words}`;
  const pill = $("#state");
  pill.dataset.state = state;
  if (pill.lastElementChild.textContent !== words) pill.lastElementChild.textContent = words;
  showSource();
  $("#overlay").textContent = overlay(running);
  $("#stage").classList.toggle("over", status.phase === "ended" && stage.hasPicture);
  $("#draw").classList.toggle("main", state === "waiting" || state === "absent"); // else there is no need of one
  for (const button of [$("#draw"), $("#pause"), $("#stop")]) button.disabled = !running;
}

/** Whether there is no object. The status is one of each second, so after the first box the tracks are newer. */
function isWaiting() {
  return status.waiting && !objects.list.length;
}

/** The state of the objects together: present if one of them is. */
function stateOfAll() {
  return ["present", "bootstrapping", "absent"].find((state) => objects.list.some((one) => one.state === state)) ?? "waiting";
}

/** The name of the source; its whole address and the endpoint of the pipeline as the tooltip. */
function showSource() {
  const source = status.source || "";
  const name = source.includes("://") ? source : source.split("/").filter(Boolean).at(-1) || source;
  const shown = [stream, /^\d+$/.test(name) ? `camera ${name}` : name || (stream ? "" : status.endpoint)].filter(Boolean).join(", ");
  const skipped = status.skipped === null || status.skipped === undefined ? "" : `, ${status.skipped} frames skipped`;
  $("#source").textContent = shown ? `${shown}${skipped}` : "";
  $("#source").title = source && status.endpoint ? `${source}, followed by the pipeline at ${status.endpoint}` : "";
  document.title = shown ? `${stream || shown} – catstream` : "catstream";
}

/** Text over the picture: the reason why it does not change. */
function overlay(running) {
  if (status.phase === "ended") {
    const page = closed ? "The server of this page has ended too" : silent ? "The server of this page does not answer" : "";
    return `The end: ${status.reason}. ${page ? `${page}: this is the last picture.` : "This page waits for the next pipeline."}`;
  }
  if (closed) return "The server of this page was stopped: this is the last picture. The pipeline may still run.";
  if (silent) return "The server of this page does not answer. This page tries again.";
  if (status.phase === "waiting") return status.reason || "Waiting for a pipeline";
  if (status.phase === "silent") return "The pipeline does not send messages. This page waits for it.";
  return running && !stage.hasPicture ? "Waiting for a picture" : "";
}

const show = {
  pipeline() { // another pipeline: clear everything
    stage.clear();
    charts.clear();
    surprising.clear();
    objects.clear();
    frame = null;
    showMessage("");
    showFrame();
  },
  closed() {
    closed = true;
    showState();
  },
  status(part) {
    if (part.phase !== "running" && status.phase === "running") stage.cancel(false);
    status = part;
    showPaused(Boolean(part.paused));
  },
  tracks(part) {
    frame = part.frame === null ? null : { number: part.frame, time: part.time };
    const before = objects.list.map((one) => one.name).join();
    objects.show(part.objects);
    if (objects.list.map((one) => one.name).join() !== before) showObjects();
    showFrame();
    showState();
  },
  picture(part) {
    if (part) stage.show(part).then(showState);
  },
  points: (part) => charts.add(part),
  trees: (part) => trees.show(part),
  surprising: (part) => surprising.show(part),
};

function listen() {
  events = new EventSource("events");
  events.onopen = () => {
    closed = silent = false;
    showState();
  };
  events.onmessage = (event) => {
    for (const [name, part] of Object.entries(JSON.parse(event.data))) show[name](part);
  };
  events.onerror = () => {
    silent = true;
    stage.cancel(false);
    showState();
    if (events?.readyState !== EventSource.CLOSED) return;
    stop();
    setTimeout(async () => {
      const page = await fetch(".").catch(() => null);
      if (page && page.status === 401) location.reload();
      else if (!events && !document.hidden) listen();
    }, 2000);
  };
}

function stop() {
  events?.close();
  events = null;
}

$("#draw").onclick = () => { $("#stage").focus(); stage.begin(); };
$("#follow").onclick = () => stage.accept();
$("#cancel").onclick = () => stage.cancel();
form.name.onkeydown = (event) => {
  if (event.key === "Enter") stage.accept();
  if (event.key === "Escape") stage.cancel();
};
$("#forget-dialog").onclose = ({ target }) => {
  if (target.returnValue === "forget") sendCommand("forget", { object: target.dataset.object });
  target.returnValue = "";
};
$("#pause").onclick = () => sendCommand(paused ? "resume" : "pause");
$("#stop").onclick = () => $("#stop-dialog").showModal();
$("#stop-dialog").onclose = (event) => {
  if (event.target.returnValue === "stop") sendCommand("stop");
  event.target.returnValue = "";
};
addEventListener("resize", () => { stage.draw(); charts.draw(); trees.redraw(); });
$("#trees details").open = matchMedia("(min-width: 40rem)").matches; // on a phone, they are much longer than the rest
$("#trees details").ontoggle = () => trees.redraw();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { stage.draw(); surprising.draw(); });
$("#fleet").hidden = !stream;
document.addEventListener("visibilitychange", () => { // a browser opens few connections to a server, over all its tabs
  if (document.hidden && !stage.drawing) stop();
  else if (!document.hidden && !events) listen();
});
showState();
listen();
