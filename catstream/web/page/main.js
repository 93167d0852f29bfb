// Connects to the server, and passes its updates to the page.

import { StreamPage } from "./stream.js";

const server = { closed: false, silent: null }; // whether it has announced its shutdown; start of its silence
const page = new StreamPage(server);
let events = null; // the connection to the server, null while the page is hidden

function listen() {
  events = new EventSource("events");
  events.onopen = () => {
    Object.assign(server, { closed: false, silent: null });
    page.showState();
  };
  events.onmessage = ({ data }) => {
    const { closed, ...parts } = JSON.parse(data);
    if (closed) server.closed = true;
    page.take(parts);
  };
  events.onerror = () => {
    server.silent ??= Date.now();
    page.showState();
    if (events?.readyState !== EventSource.CLOSED) return;
    stop();
    setTimeout(async () => {
      const answer = await fetch(".").catch(() => null);
      if (answer && answer.status === 401) location.reload();
      else if (!events && !document.hidden) listen();
    }, 2000);
  };
}

function stop() {
  events?.close();
  events = null;
}

document.addEventListener("visibilitychange", () => { // the tabs of a browser share few connections to a server
  if (document.hidden && !page.stage.drawing) stop();
  else if (!document.hidden && !events) listen();
});
addEventListener("pageshow", (event) => event.persisted && !events && listen());
if (!document.hidden) listen();
