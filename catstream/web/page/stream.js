// The page of a stream: passes updates to the parts of the page, and commands of the user to the pipeline.

import { Charts } from "./charts.js";
import { $, post, write } from "./dom.js";
import { BoxForm, Objects } from "./objects.js";
import { Stage } from "./stage.js";
import { Trees } from "./trees.js";

const PAUSE = { seconds: 30, renewed: 10_000 }; // timeout of the pause while a box is drawn; milliseconds until it is renewed
const TONES = { lost: "silent", starting: "waiting" };
const MESSAGE = 9000; // milliseconds for which an informational message is shown

export class StreamPage {
  /** server: {closed, silent}, whether it has announced its shutdown, and the start of its silence. */
  constructor(server) {
    this.server = server;
    this.name = decodeURIComponent(location.pathname).match(/\/streams\/([^/]+)\/$/)?.[1] ?? ""; // empty if there is one stream
    this.status = { phase: "waiting", state: "none", paused: false };
    this.charts = new Charts($(".charts"));
    this.trees = new Trees($(".trees"), $("#tree-summary"));
    this.objects = new Objects($(".objects"), { choose: (name) => this.showChosen(name), forget: (name) => this.forget(name) });
    this.form = new BoxForm(this.objects, { accept: () => this.stage.accept(), cancel: () => this.stage.cancel() });
    this.stage = new Stage($("#stage"), this.objects, { freeze: () => this.freeze(), follow: (box, still) => this.follow(box, still),
      changed: (drawing, box) => this.showDrawing(drawing, box) });
    $("#all").hidden = !this.name;
    this.listen();
    this.showState();
  }

  /** Attach the handlers of the controls. */
  listen() {
    $("#draw").onclick = () => { $("#stage").focus(); this.stage.begin(); };
    $("#pause").onclick = () => this.send(this.status.paused ? "resume" : "pause");
    $("#stop").onclick = () => {
      if (confirm("Stop the pipeline?\n\nEverything learned is stored first. The pipeline cannot be restarted from this page.")) this.send("stop");
    };
    addEventListener("pagehide", () => this.stage.cancel()); // otherwise the pipeline resumes only after the timeout of its pause
    const sizes = new ResizeObserver(() => { this.stage.draw(); this.charts.draw(); this.trees.show(); });
    for (const drawn of [$("#stage"), $(".charts"), $(".trees")]) sizes.observe(drawn);
  }

  /** Show changed parts; `pipeline` is sent, with all parts, if they are of another pipeline. */
  take({ pipeline, status, tracks, picture, points, trees }) {
    if (pipeline !== undefined) this.clear();
    if (status) {
      this.status = status;
      this.showState();
    }
    if (tracks) {
      write($("#frame"), tracks.frame === null ? "" : `frame ${tracks.frame}, ${tracks.time.toFixed(1)} s`);
      this.objects.show(tracks.objects);
      this.showObjects();
      this.showState();
    }
    if (picture) this.stage.show(picture).then(() => this.showState());
    if (points) this.charts.add(points);
    if (trees) this.trees.show(trees);
  }

  clear() {
    this.stage.clear();
    this.charts.clear();
    this.showMessage("");
  }

  /** Send a command; returns the answer, or null after showing the reason of a rejection. */
  async send(verb, fields = {}) {
    const answer = await post("control", { verb, ...fields });
    this.showMessage(answer.reason, !answer.done);
    return answer.done ? answer : null;
  }

  /**
   * Freeze the picture for drawing a box. A live source continues: the box applies to the frame at the time of the picture.
   * A file is paused; returns the frame of the box, and a function that resumes. The pause has a timeout, which this page
   * renews. A pause by the user or another program is not resumed.
   */
  async freeze() {
    if (this.isLive) return { frame: -1, time: this.stage.picture.time, leave: null };
    await this.left; // the end of the previous pause
    if (this.status.state === "waiting") return { frame: Infinity, leave: null };
    const answer = await this.send("pause", { seconds: PAUSE.seconds });
    if (!answer) return null;
    this.showMessage("Paused for your box.", false, false);
    this.renewing = setInterval(() => this.renew(answer.frame), PAUSE.renewed);
    const leave = () => {
      clearInterval(this.renewing);
      return (this.left = this.send("pause", { seconds: 0 }));
    };
    // A paused pipeline waits with the frame after the last tracked one, to which the box applies.
    return { frame: answer.frame + 1, leave };
  }

  /** Renew the pause; if the pipeline has continued after this frame, cancel the drawing on the old picture. */
  async renew(frame) {
    const answer = await post("control", { verb: "pause", seconds: PAUSE.seconds });
    if (!answer.done || answer.frame === frame || !this.stage.drawing || this.stage.asking) return;
    this.stage.cancel();
    await this.left;
    this.showMessage("The pipeline has continued: draw the box again.", true);
  }

  /** Send the box of a new or of the chosen object. */
  async follow(box, { time, leave }) {
    if (!this.form.check()) return false;
    const answer = await this.send("set-box", { ...this.form.fields, time, box: box.map((side) => Math.round(side * 10) / 10) });
    if (!answer) return false;
    this.objects.choose(answer.object);
    if (leave) {
      await leave();
      this.showMessage(answer.reason);
    }
    return true;
  }

  forget(name) {
    const question = `Forget ${name || "the object without a name"}?`;
    if (confirm(`${question}\n\nIt is no longer tracked, and everything learned about it is dropped. The other objects continue.`)) {
      this.send("forget", { object: name });
    }
  }

  /** Show a message until the next one, or for some seconds. */
  showMessage(text, wrong = false, fades = !wrong) {
    const message = $("#message");
    message.textContent = text;
    message.classList.toggle("wrong", wrong);
    clearTimeout(this.clearing);
    if (fades) this.clearing = setTimeout(() => write(message, ""), MESSAGE);
  }

  showDrawing(drawing, box) {
    if (!drawing) clearInterval(this.renewing);
    if (drawing && $("#drawing").hidden) this.form.begin();
    $("#watching").hidden = drawing;
    $("#drawing").hidden = !drawing;
    $("#follow").disabled = !box;
  }

  /** Show the charts and the trees of another object. */
  showChosen(name) {
    this.charts.choose(name);
    this.trees.choose(name);
    if (this.stage.drawing) this.form.offer();
    this.showObjects();
  }

  /** Show the list, unless there is a single unnamed object. */
  showObjects() {
    const { single, chosen } = this.objects;
    $("#objects").hidden = single;
    $("#stream").classList.toggle("several", !single);
    for (const target of document.querySelectorAll(".of")) write(target, single ? "" : ` of ${chosen || "the object without a name"}`);
    this.stage.draw();
  }

  showState() {
    const { status, stage, server } = this;
    const running = status.phase === "running" && server.silent === null;
    if (!running) stage.cancel(false);
    const [state, words] = this.state(running);
    $("#state").dataset.state = state;
    write($("#state b"), words);
    this.showSource();
    write($("#overlay"), this.overlay());
    $("#stage").classList.toggle("over", Boolean(stage.picture) && (status.phase === "ended" || status.state === "lost"));
    $("#draw").classList.toggle("main", state === "waiting" || state === "absent"); // highlight it if a box is needed
    write($("#pause"), status.paused ? "Resume" : "Pause");
    $("#pause").setAttribute("aria-pressed", String(status.paused));
    for (const button of [$("#draw"), $("#pause"), $("#stop")]) button.disabled = !running;
  }

  /** True if the source is live: then the detector counts skipped frames. */
  get isLive() {
    return (this.status.skipped ?? null) !== null;
  }

  /** The state of the pipeline: a name for its colour, and a description. */
  state(running) {
    const { status, server, objects: { list } } = this;
    if (server.silent !== null && status.phase !== "ended") return ["silent", "page stopped"];
    if (!running) return [status.phase, status.phase === "silent" ? "pipeline silent" : status.phase];
    if (status.state !== "running") return [TONES[status.state] ?? status.state, status.words];
    const state = ["present", "bootstrapping", "absent"].find((each) => list.some((one) => one.state === each)) ?? "waiting";
    const words = list.length > 1 ? `${list.filter((one) => one.state !== "absent").length} of ${list.length} present` : state;
    return [state, words];
  }

  /** Show the name of the source; the tooltip has its address and the endpoint of the pipeline. */
  showSource() {
    const { source = "", endpoint, skipped } = this.status;
    const last = source.includes("://") ? source : source.split("/").filter(Boolean).at(-1) || source;
    const shown = [this.name, /^\d+$/.test(last) ? `camera ${last}` : last || (this.name ? "" : endpoint)].filter(Boolean).join(", ");
    write($("#source"), shown && `${shown}${this.isLive ? `, ${skipped} frames skipped` : ""}`);
    $("#source").title = source && endpoint ? `${source}, tracked by the pipeline at ${endpoint}` : "";
    document.title = shown ? `${this.name || shown} – catstream` : "catstream";
  }

  /** Text over the picture: the reason if it does not change. */
  overlay() {
    const { status, stage, server: { closed, silent } } = this;
    if (status.phase === "ended") {
      const page = closed ? "The server of this page has ended too" : silent !== null ? "The server of this page does not answer" : "";
      return `The end: ${status.reason}. ${page ? `${page}: this is the last picture.` : "This page waits for the next pipeline."}`;
    }
    if (closed) return "The server of this page was stopped: this is the last picture. The pipeline may still run.";
    if (silent !== null) return "The server of this page does not answer. This page tries again.";
    if (status.phase === "waiting") return status.reason || "Waiting for a pipeline";
    if (status.phase === "silent") return `The pipeline does not send messages. This page waits for it. The reason: ${status.reason}`;
    if (!stage.picture) return "Waiting for a picture";
    return status.state === "lost" ? `${status.words[0].toUpperCase()}${status.words.slice(1)}: this is the last picture.` : "";
  }
}
