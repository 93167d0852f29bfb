// The page of `catstream annotate`: a frame, the timelines of the objects, and changes of boxes, which are sent at once.
// One of several videos is open.

import { $, add, Items, make, many, post, write } from "./dom.js";
import { FrameStage } from "./frame.js";

const JUMP = 25; // frames of a page key
const WAYS = { "1 forwards": "#74c0fc", "2 backwards": "#f783ac" }; // names and colours of proposals; names of objects have no blanks
const CHECKS = { keyframe: "your box", hidden: "hidden, its box is estimated", checked: "checked", unchecked: "may be wrong" };
const KEYS = { n: "next", enter: "next", b: "back", u: "undo", 1: "first", 2: "second", d: "draw", a: "absent", h: "hidden", o: "new",
  v: "video", delete: "delete", backspace: "delete", "+": "closer", "=": "closer", "-": "farther", 0: "whole", "?": "help" };

/** The name of a key in `KEYS`: by its label or, on keyboards with other letters, by its position. */
function nameOf({ key, code }) {
  const label = key.toLowerCase();
  return label in KEYS ? label : code.replace(/^(Key|Digit|Numpad)/, "").toLowerCase();
}

class AnnotatePage {
  constructor() {
    Object.assign(this, { state: null, frame: 0, chosen: null, boxes: {}, visited: [], lastFrames: {}, edits: [], sent: Promise.resolve(), silent: false, ended: "" });
    this.stage = new FrameStage($("#stage"), this, { freeze: () => ({ frame: this.frame }), follow: (box) => this.set(box, this.stage.picture.frame), changed: () => {},
      zoomed: (scale) => write($("#whole span"), `${Math.round(100 * scale)} %`) });
    this.rows = new Items($("#timelines"), { make: (name) => this.makeRow(name), fill: (row, one) => this.fillRow(row, one) });
    this.videos = new Items($("#list"), { make: (number) => this.makeVideo(Number(number)), fill: (item, one) => this.fillVideo(item, one) });
    const actions = { next: () => this.next(), back: () => this.visited.length && this.go(...this.visited.pop()), undo: () => this.undo(),
      first: () => this.take("1 forwards"), second: () => this.take("2 backwards"), draw: () => this.draw(), absent: () => this.set(null), hidden: () => this.set("hidden"),
      delete: () => this.delete(this.frame), forget: () => this.delete(null), new: () => { this.stage.leave(); this.choose(null); }, help: () => $("#keys").showModal(),
      closer: () => this.stage.zoomBy(1.5), farther: () => this.stage.zoomBy(1 / 1.5), whole: () => this.stage.zoomBy(0), video: () => this.open(this.other), done: () => this.done() };
    for (const [id, act] of Object.entries(actions)) $(`#${id}`).onclick = act;
    $("#slider").oninput = () => this.go(Number($("#slider").value));
    $("#name").onchange = () => this.rename();
    $("#naming").onsubmit = (event) => { event.preventDefault(); $("#name").blur(); };
    addEventListener("keydown", (event) => this.key(event));
    addEventListener("keyup", ({ code }) => { if (code === "Space") this.stage.grabs = false; });
    addEventListener("pagehide", () => this.commit());
    addEventListener("click", ({ detail, target }) => detail && target.closest("button")?.blur()); // so that Enter means "next" again
    new ResizeObserver(() => this.stage.draw()).observe($("#stage"));
    this.events = new EventSource("events");
    this.events.onmessage = ({ data }) => this.receive(JSON.parse(data));
    this.events.onerror = () => { this.silent = true; this.arrived?.(); this.show(); };
    this.choose(null);
  }

  /** Show the changes of the server's state, or its end. */
  receive({ closed, ...changes }) {
    const state = { ...this.state, ...changes };
    if (!closed && this.state && state.server !== this.state.server) return this.end("Another command serves this address now: reload the page.");
    this.silent = Boolean(closed);
    if (!closed) {
      const before = this.state;
      this.state = state;
      if (before && state.video !== before.video) this.change(before.video);
      if (!before && state.objects.length) this.choose(state.objects[0].name);
      if (!this.edits.length && before?.objects.some(({ name }) => name === this.chosen) && !this.get(this.chosen)) this.choose(null, this.chosen);
      if (state.revision !== before?.revision) this.load();
    }
    this.arrived?.();
    this.show();
  }

  // The interface of the objects on a stage.
  get focus() {
    return Object.values(this.proposals).find(Boolean) ?? this.boxes[this.chosen]?.box;
  }

  get single() {
    return false;
  }

  get(name) {
    return Object.hasOwn(WAYS, name) ? { colour: WAYS[name] } : this.state?.objects.find((one) => one.name === name);
  }

  /** Choose an object, null for a new one, or accept a proposal. */
  choose(name, typed = name) {
    if (Object.hasOwn(WAYS, name)) return this.take(name);
    this.chosen = name;
    let number = 1;
    while (this.get(`object-${number}`) || this.edits.some(({ object }) => object === `object-${number}`)) number += 1;
    $("#name").value = typed ?? `object-${number}`;
    if (typed === null && this.state?.objects.length) $("#name").select(), $("#name").focus();
    this.showBoxes();
    this.show();
  }

  /** Go to a frame, and choose an object. */
  go(frame, name = this.chosen) {
    this.stage.leave();
    this.frame = Math.max(0, Math.min((this.state?.frames ?? 1) - 1, frame));
    this.boxes = {}; // proposals of another frame cannot be accepted
    if (name !== this.chosen) this.choose(name);
    this.show();
    this.load();
  }

  /** Show another video at its last shown frame. */
  change(previous) {
    const { objects, video } = this.state;
    this.lastFrames[previous] = this.frame;
    Object.assign(this, { boxes: {}, visited: [], frame: this.lastFrames[video] ?? 0 });
    this.stage.clear();
    this.stage.zoom = 1;
    this.choose(objects[0]?.name ?? null);
  }

  /** Save pending changes, and open another video. */
  async open(video) {
    if (video !== undefined && await this.commit()) this.send("open", { video });
  }

  /** The next unchecked video, or undefined. */
  get other() {
    const { video = 0, videos = [] } = this.state ?? {}, order = [...videos.keys()];
    return [...order.slice(video + 1), ...order.slice(0, video)].find((number) => videos[number][1] < 1);
  }

  jump(frame, name) {
    this.visited.push([this.frame, this.chosen]);
    this.go(frame, name);
  }

  /** Load the boxes and the picture of the frame; while loading, only the last requested frame is loaded next. */
  async load() {
    this.wanted = true;
    if (this.loading) return;
    this.loading = true;
    while (this.wanted) {
      this.wanted = false;
      const { frame, sent, edits: { length }, state: { video } } = this, query = video ? `video=${video}` : "";
      const answer = await fetch(`frames/${frame}?${query}`).then((response) => response.ok && response.json(), () => null);
      if (!answer || video !== this.state.video) continue;
      if (this.stage.picture?.frame === frame && (length || this.edits.length || sent !== this.sent)) { // the answer may be older than a pending edit
        await this.sent;
        this.wanted = true;
        continue;
      }
      const { size: [width, height], objects } = answer;
      const shown = this.stage.picture?.frame === frame;
      if (!shown) await this.stage.show({ frame, query, width, height, boxes: {} });
      this.boxes = objects; // together with their picture, because they can be edited
      this.showBoxes();
      if (!shown && this.stage.picture) this.stage.reveal();
      this.show();
    }
    this.loading = false;
  }

  /** The proposals for the chosen object in this frame by name: a box, or null if it is absent. */
  get proposals() {
    const { checked, proposals } = this.boxes[this.chosen] ?? {};
    if (checked !== "unchecked") return {};
    return Object.fromEntries(Object.keys(WAYS).flatMap((name, way) => (proposals[way] ? [[name, proposals[way][0]]] : [])));
  }

  /** Description of the chosen object in this frame. */
  get check() {
    const { box, checked, proposals } = this.boxes[this.chosen] ?? {};
    if (!checked) return "";
    if (checked === "unchecked" && !proposals.some(Boolean)) return "not tracked yet";
    return (box || checked === "hidden" ? "" : "absent, ") + CHECKS[checked];
  }

  showBoxes() {
    if (!this.stage.picture) return;
    const proposed = Object.entries(this.proposals), known = Object.entries(this.boxes).map(([name, { box }]) => [name, box]);
    const boxes = [...known.filter(([name]) => !proposed.length || name !== this.chosen), ...proposed];
    this.stage.picture.boxes = Object.fromEntries(boxes.filter(([, box]) => box));
    this.stage.draw();
  }

  /** Send a change after earlier ones; returns the answer once the new state has arrived, or null after showing the reason of a rejection. */
  send(verb, more = {}) {
    const edit = { verb, video: this.state.video, ...more };
    this.edits.push(edit);
    this.sent = this.sent.then(async () => {
      const answer = await post("edit", { server: this.state.server, ...edit });
      write($("#message"), answer.reason ?? "");
      while (answer.done && verb !== "done" && this.state.revision < answer.revision && !this.silent) await new Promise((resolve) => { this.arrived = resolve; });
      this.edits.shift();
      if (!answer.done) return null;
      if (verb === "rename") {
        for (const later of this.edits) if (later.object === edit.object) later.object = edit.name;
        if (this.chosen === edit.object) this.chosen = edit.name;
      }
      return answer;
    });
    return this.sent;
  }

  /** Delete the chosen object's box in a frame, or the object if the frame is null or it has no other box. */
  async delete(frame) {
    this.stage.cancel();
    const { chosen } = this;
    if (frame !== null && !this.shows(frame)) return;
    if (await this.send("delete", { object: chosen, frame }) && !this.get(chosen) && this.chosen === chosen) this.choose(null, chosen);
  }

  /** True if the picture of a frame is shown; otherwise the action is refused with a message. */
  shows(frame) {
    return this.stage.picture?.frame === frame || Boolean(this.refuse(`Frame ${frame} is not shown yet: try again`));
  }

  refuse(reason) {
    write($("#message"), reason);
    return null;
  }

  /** Send pending changes of the box and of the name; returns false if one is rejected. */
  async commit() {
    return !(await Promise.all([this.stage.leave(), this.rename()])).includes(null);
  }

  /** Save the box of the chosen or of a new object in the shown frame: null if it is absent, "hidden" if it is occluded. */
  async set(box, frame = this.frame) {
    this.stage.cancel();
    const { chosen, typed } = this, object = chosen ?? typed;
    if (!this.shows(frame)) return null;
    if (chosen === null && this.get(object)) return this.refuse(`There is an object ${object} already: use another name`);
    const is = box === "hidden" ? { ...this.boxes[object], checked: box } : { box, checked: "keyframe" };
    if (this.get(object)) this.boxes[object] = { proposals: [null, null], ...is }; // until the answer
    this.showBoxes();
    const answer = await this.send("draw", { object, frame, box: Array.isArray(box) ? box.map((side) => Math.round(side * 10) / 10) : box });
    if (!answer) this.load();
    if (answer && this.chosen === null && this.typed === object) this.choose(object);
    return answer;
  }

  take(name) {
    if (name in this.proposals) this.set(this.proposals[name]);
  }

  /** Begin to change the present box with the keyboard. */
  async draw() {
    if (this.stage.drawing || !this.shows(this.frame)) return;
    await this.stage.begin();
    const { width, height } = this.stage.picture;
    const [x, y, w, h] = this.boxes[this.chosen]?.box ?? [width * 0.4, height * 0.4, width * 0.2, height * 0.2];
    this.stage.set(x, y, w, h);
  }

  /** The name in its field. */
  get typed() {
    return $("#name").value.trim().normalize("NFC");
  }

  async rename() {
    const { chosen, typed } = this;
    if (chosen === null || typed === chosen) return true;
    const answer = await this.send("rename", { object: chosen, name: typed });
    if (!answer && this.chosen === chosen) $("#name").value = chosen;
    return answer;
  }

  async undo() {
    if (this.stage.drawing) return this.stage.cancel();
    const { object, frame } = (await this.send("undo")) ?? {};
    if (object === undefined) return;
    this.go(frame ?? this.frame, this.chosen);
    this.choose(this.get(object) ? object : null, object);
  }

  async done() {
    if (await this.commit() && await this.send("done")) this.end("Done: the results are written, and the command has ended. This tab can be closed.");
  }

  /** Stop the updates, and show the reason. */
  end(reason) {
    this.events.close();
    this.ended = reason;
    this.show();
  }

  /** The next frames to check, without this one. */
  get following() {
    return (this.state?.next ?? []).filter(([frame, name]) => frame !== this.frame || name !== this.chosen);
  }

  next() {
    const [[frame, name] = []] = this.following;
    if (name !== undefined) this.jump(frame, name);
    else if (this.isChecked) this.open(this.other);
  }

  key(event) {
    const { key, code, target, ctrlKey, metaKey, shiftKey } = event, modified = ctrlKey || metaKey, name = nameOf(event);
    const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: -JUMP, PageDown: JUMP, Home: -Infinity, End: Infinity };
    if (event.isComposing || event.altKey || $("#keys").open) return;
    if (this.stage.pointer !== null) return key === "Escape" && this.stage.abort(this.stage);
    if (key === "Enter" && modified) return $("#done").click();
    if (target.id === "name") return;
    if (this.stage.drawing && this.stage.key(event)) return event.preventDefault();
    if (code === "Space" && target.tagName !== "BUTTON") this.stage.grabs = true;
    else if (modified && !shiftKey && (key === "z" || (code === "KeyZ" && key > "\x7f"))) this.undo();
    else if (modified) return;
    else if (key in steps) this.go(this.frame + steps[key]);
    else if (name in KEYS && (key !== "Enter" || target.tagName !== "BUTTON")) event.repeat || $(`#${name === "delete" && shiftKey ? "forget" : KEYS[name]}`).click();
    else return;
    event.preventDefault();
  }

  /** Whether all frames of the video are checked. */
  get isChecked() {
    const { objects, decoded, next, remaining } = this.state;
    return objects.length > 0 && decoded && !next.length && !remaining;
  }

  /** The share of checked frames of the open video. */
  get part() {
    const { objects, frames } = this.state, wrong = objects.reduce((sum, one) => sum + one.wrong, 0);
    return objects.length ? 1 - wrong / frames / objects.length : 0;
  }

  makeVideo(number) {
    const element = document.createElement("li");
    const choose = add(element, "button", { type: "button", className: "choose", onclick: () => this.open(number) });
    const [name, state] = [add(choose, "b"), add(choose, "span", { className: "number" })];
    return { element, choose, name, state, share: add(add(choose, "span", { className: "share" }), "i") };
  }

  fillVideo({ choose, name, state, share }, { label, part, open }) {
    choose.setAttribute("aria-pressed", String(open));
    write(name, label);
    write(state, `${Math.floor(100 * part)}% checked`);
    share.style.width = `${100 * part}%`;
  }

  makeRow(name) {
    const element = document.createElement("li");
    const choose = add(element, "button", { type: "button", onclick: () => { this.stage.leave(); this.choose(name); } });
    add(choose, "i", { className: "swatch" });
    add(choose, "b", { textContent: name || "no name" });
    const line = make("svg", { role: "img", preserveAspectRatio: "none" });
    line.onclick = ({ clientX }) => {
      const { left, width } = line.getBoundingClientRect();
      this.jump(Math.floor(this.state.frames * (clientX - left) / width), name);
    };
    element.append(line);
    return { element, choose, line, share: add(element, "span", { className: "share number" }) };
  }

  fillRow({ element, choose, line, share }, { name, colour, keyframes, wrong, unchecked, frames, frame, chosen }) {
    element.style.setProperty("--colour", colour);
    choose.setAttribute("aria-pressed", String(chosen));
    const bar = (kind, first, last) => make("rect", { class: kind, x: first, width: last - first + 1, y: 1, height: 3 });
    const mark = (kind, at) => make("line", { class: kind, x1: at + 0.5, x2: at + 0.5, y2: 5 });
    line.setAttribute("viewBox", `0 0 ${frames} 5`);
    line.replaceChildren(bar("right", 0, frames - 1), ...unchecked.map(([first, last]) => bar("wrong", first, last)),
      mark("now", frame), ...keyframes.map((at) => mark("", at)));
    const percent = Math.floor(100 * (1 - wrong / frames));
    write(share, `${percent}%`);
    line.setAttribute("aria-label", `${name}: ${many(keyframes.length, "box", "boxes")}, ${percent} % of the frames checked`);
  }

  show() {
    const { state, frame, chosen, ended, silent, following, proposals } = this;
    const objects = state?.objects ?? [], known = this.get(chosen);
    const [kind, words] = this.progress();
    $("#state").dataset.state = kind;
    write($("#state b"), words);
    write($("#overlay"), this.overlay());
    if (!state) return;
    const { videos, video } = state, [name] = videos[video], several = videos.length > 1;
    write($("#source"), several ? `${name}, ${video + 1} of ${videos.length}` : name);
    document.title = `${name} – catstream annotate`;
    write($("#problem"), state.problem);
    Object.assign($("#slider"), { max: state.frames - 1, value: frame });
    write($("#frame"), `${frame} of ${state.frames}`);
    $("#naming").style.setProperty("--colour", known?.colour ?? "transparent");
    write($("#check"), known ? `${chosen || "The object"} in frame ${frame}: ${this.check}` : "A new object: draw its box");
    for (const [id, way] of [["first", "1 forwards"], ["second", "2 backwards"]]) {
      write($(`#${id} span`), `Take ${way.slice(2)}${way in proposals && !proposals[way] ? ": absent" : ""}`);
      $(`#${id}`).disabled = !(way in proposals);
    }
    const [[place, object, errors] = []] = following, more = this.isChecked ? this.other : undefined;
    write($("#next span"), place !== undefined ? `Look next at frame ${place}, ${object || "the object"}: about ${many(Math.max(1, Math.round(errors)), "frame")} around it may be wrong`
      : this.isChecked ? `All frames are checked${more === undefined ? "" : `: go to ${videos[more][0]}`}`
      : state.next.length ? "Draw the box here, or take one" : objects.length ? "Tracking" : "Draw the first box");
    const off = silent || ended;
    $("#next").disabled = off || (place === undefined && more === undefined);
    $("#absent").disabled = $("#hidden").disabled = off || !known;
    $("#delete").disabled = off || !["keyframe", "hidden"].includes(this.boxes[chosen]?.checked);
    $("#forget").disabled = off || !known;
    $("#undo").disabled = off || !state.undo;
    $("#back").disabled = !this.visited.length;
    for (const id of ["draw", "new", "done", "name"]) $(`#${id}`).disabled = off;
    $("#objects").hidden = !objects.length;
    this.rows.show(objects.map((one) => [one.name, { ...one, frames: state.frames, frame, chosen: one.name === chosen }]));
    $("#videos").hidden = !several;
    $("#video").disabled = off || this.other === undefined;
    this.videos.show(videos.map(([label, share], number) => [String(number), { label, part: number === video ? this.part : share, open: number === video }]));
  }

  /** The activity of the server: a state for its colour, and a description. */
  progress() {
    const { state, ended, silent } = this;
    if (ended) return ["ended", "page ended"];
    if (silent || !state) return ["silent", silent ? "page stopped" : "connecting"];
    if (!state.decoded) return ["bootstrapping", `reading the video: ${many(state.frames, "frame")}`];
    if (!state.remaining) return ["present", "all boxes saved"];
    return ["bootstrapping", `tracking: ${many(state.remaining, "frame")} left`];
  }

  overlay() {
    if (this.ended) return this.ended;
    if (this.silent) return "The server of this page does not answer. The boxes that it has shown are saved: run the same command to continue.";
    return this.stage.picture ? "" : "Waiting for the first frame";
  }
}

new AnnotatePage();
