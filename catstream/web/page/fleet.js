// The page of a fleet: passes updates to the cards of the streams and to the table of the nodes.

import { Nodes, Streams } from "./cards.js";
import { $, duration, write } from "./dom.js";
import { Search } from "./search.js";

export class FleetPage {
  /** server: {closed, silent}, whether it has announced its shutdown, and the time since which it does not answer. */
  constructor(server) {
    this.server = server;
    this.fleet = { phase: "waiting", name: "", reason: "", age: 0 };
    this.streams = new Streams($(".cards"));
    this.search = new Search($("#search"), $(".states"), () => this.showMatching());
    this.nodes = new Nodes($("#nodes"), (text) => this.search.ask(text));
    $("#streams").hidden = false;
    addEventListener("pagehide", () => sessionStorage.setItem("top", String(scrollY)));
    setInterval(() => server.silent !== null && this.showState(), 1000);
    this.showState();
  }

  take({ status, streams, nodes }) {
    this.fleet = status ?? this.fleet;
    if (nodes) this.nodes.show(nodes);
    if (streams) this.streams.show(streams, this.nodes.rows);
    this.showMatching();
    this.showState();
    this.restorePosition();
  }

  showMatching() {
    const { streams, search, fleet } = this;
    search.offer(streams.cards);
    const shown = streams.filter((card) => search.matches(card));
    const empty = fleet.phase === "running" && !streams.cards.length;
    $(".find").hidden = !streams.cards.length;
    write($(".none"), empty ? "This fleet has no streams. Add some to its file, and apply it with “catstream fleet up”."
      : streams.cards.length && !shown ? `No stream matches “${search.text}”.` : "");
  }

  showState() {
    const { fleet, server: { silent, closed }, streams: { cards } } = this;
    const troubled = cards.filter((card) => card.level).length;
    const current = fleet.phase === "running" && silent === null && !closed;
    const [state, words] = this.state(cards, troubled);
    $("#state").dataset.state = state;
    write($("#state b"), words);
    write($("#source"), fleet.name && `fleet ${fleet.name}`);
    document.title = [troubled && current ? `(${troubled})` : "", fleet.name && `${fleet.name} –`, "catstream"].filter(Boolean).join(" ");
    const message = this.explanation();
    write($("#silence"), message);
    $("#silence").hidden = !message;
    for (const each of document.querySelectorAll("#streams section")) each.hidden = fleet.phase === "waiting";
    $("#streams").classList.toggle("old", !current);
    this.streams.pictures.paused = !current;
  }

  /** The state of the fleet for its colour, and in words. */
  state(cards, troubled) {
    const { fleet, server: { silent, closed } } = this;
    if (silent !== null || closed) return ["silent", "page stopped"];
    if (fleet.phase !== "running") return [fleet.phase, fleet.phase === "silent" ? "fleet silent" : "waiting"];
    if (troubled) return ["absent", `${troubled} in trouble`];
    const running = cards.filter((card) => card.state === "running").length;
    if (!cards.length) return ["waiting", "no streams"];
    return [running ? "present" : "waiting", `${running === cards.length ? "" : `${running} of `}${cards.length} running`];
  }

  /** Why the page is not current; empty if it is. */
  explanation() {
    const { fleet, server: { silent, closed } } = this;
    const age = fleet.age + (silent === null ? 0 : Math.round((Date.now() - silent) / 1000));
    const shown = fleet.name ? ` It shows the state of ${duration(age)} ago.` : "";
    if (closed) return "The server of this page was stopped. The fleet may still run.";
    if (silent !== null) return `The server of this page does not answer. This page tries again.${shown}`;
    if (fleet.phase === "silent") return `The fleet does not answer.${shown.replace("It", "This page")} The reason: ${fleet.reason}`;
    return fleet.phase === "waiting" && fleet.reason ? `Waiting for the fleet: ${fleet.reason}` : "";
  }

  /** After a page of a stream, return to the same cards. */
  restorePosition() {
    const top = sessionStorage.getItem("top");
    if (top === null || !this.streams.cards.length) return;
    sessionStorage.removeItem("top");
    scrollTo(0, Number(top));
  }
}
