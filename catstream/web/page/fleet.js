// Passes updates of the server to the parts of the page of a fleet.

import { write } from "./dom.js";
import { Nodes } from "./nodes.js";
import { Pictures } from "./pictures.js";
import { Search } from "./search.js";
import { Streams } from "./streams.js";

const $ = (selector) => document.querySelector(selector);
const pictures = new Pictures();
const streams = new Streams($(".cards"), pictures);
const search = new Search($("#search"), $(".states"), showMatching);
const nodes = new Nodes($("#nodes"), (name) => search.ask(name));
let fleet = { phase: "waiting", name: "", reason: "", age: 0 };
let events = null; // the connection to the server, null while the page is hidden
let complete = false; // whether the next update has all streams and nodes
let closed = false; // whether the server has announced its shutdown
let silent = null; // time since which the server does not answer

function showMatching() {
  const shown = streams.filter((card) => search.matches(card));
  const empty = fleet.phase === "running" && !streams.size;
  $(".find").hidden = !streams.size;
  $(".none").textContent = empty ? "This fleet has no streams. Add some to its file, and apply it with “catstream fleet up”."
    : streams.size && !shown ? `No stream matches ${search.description}.` : "";
}

function showState() {
  const troubled = streams.count((card) => card.level);
  const running = streams.count((card) => card.state === "running");
  const current = fleet.phase === "running" && silent === null && !closed;
  let [state, words] = ["waiting", "no streams"];
  if (silent !== null || closed) [state, words] = ["silent", "page stopped"];
  else if (fleet.phase === "silent") [state, words] = ["silent", "fleet silent"];
  else if (fleet.phase === "waiting") words = "waiting";
  else if (troubled) [state, words] = ["absent", `${troubled} in trouble`];
  else if (streams.size) [state, words] = [running ? "present" : "waiting", `${running === streams.size ? "" : `${running} of `}${streams.size} running`];
  $("#state").dataset.state = state;
  write($("#state b"), words);
  write($("#source"), fleet.name && `fleet ${fleet.name}`);
  document.title = [troubled && current ? `(${troubled})` : "", fleet.name, "– catstream"].filter(Boolean).join(" ").replace(/^– /, "");
  const message = explanation();
  write($("#message"), message);
  $("#message").hidden = !message;
  $("main").classList.toggle("old", !current);
  pictures.paused = !current;
}

/** Why the page is not current; empty if it is. */
function explanation() {
  const age = fleet.age + (silent === null ? 0 : Math.round((Date.now() - silent) / 1000));
  const shown = fleet.name ? ` This is its state of ${duration(age)} ago.` : "";
  if (closed) return "The server of this page was stopped. The fleet may still run.";
  if (silent !== null) return `The server of this page does not answer. This page tries again.${shown.replace("its state", "the state of the fleet")}`;
  if (fleet.phase === "silent") return `The fleet does not answer.${shown} The reason: ${fleet.reason}`;
  return fleet.phase === "waiting" && fleet.reason ? `Waiting for the fleet: ${fleet.reason}` : "";
}

function duration(seconds) {
  if (seconds < 120) return `${seconds} s`;
  return seconds < 7200 ? `${Math.floor(seconds / 60)} minutes` : `${Math.floor(seconds / 3600)} hours`;
}

function take(parts) {
  if (parts.fleet) fleet = parts.fleet;
  if (parts.streams || complete) streams.update(parts.streams ?? {}, complete);
  if (parts.order) streams.sort(parts.order);
  if (parts.nodes || complete) nodes.update(parts.nodes ?? {}, complete);
  complete = false;
  if (parts.closed) closed = true;
  search.offer(streams.cards);
  showMatching();
  showState();
  restorePosition();
}

function listen() {
  events = new EventSource("events");
  events.onopen = () => {
    complete = true;
    closed = false;
    silent = null;
  };
  events.onmessage = (event) => take(JSON.parse(event.data));
  events.onerror = () => {
    silent ??= Date.now();
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

/** After a page of a stream, return to the same cards. */
function restorePosition() {
  const top = sessionStorage.getItem("top");
  if (top === null || !streams.size) return;
  sessionStorage.removeItem("top");
  scrollTo(0, Number(top));
}

document.addEventListener("visibilitychange", () => { // a browser opens few connections to a server, over all its tabs
  if (document.hidden) stop();
  else if (!events) listen();
});
addEventListener("pagehide", () => sessionStorage.setItem("top", String(scrollY)));
addEventListener("pageshow", (event) => event.persisted && !events && listen());
setInterval(() => silent !== null && showState(), 1000);
showState();
if (!document.hidden) listen();
