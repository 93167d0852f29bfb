// A subscriber in Node.js, with zeromq and @msgpack/msgpack.
//
//     npm ci --prefix examples
//     catstream track walk.mp4 --box 120,80,64,48 --set endpoint=run
//     node examples/subscriber.mjs run
//
// Where the pipeline asks for keys, their folder is a second argument. Prints every track and each new model, until the pipeline ends. docs/protocol.md says what travels.

import { readFileSync } from "node:fs";

import { decode } from "@msgpack/msgpack";
import { Subscriber } from "zeromq";

const PORTS = { models: 2, tracks: 3 }; // counted from that of the endpoint

// Of a channel; the endpoint is a folder of sockets, or tcp://127.0.0.1:PORT.
function address(endpoint, channel) {
  const [, host, port] = endpoint.match(/^(tcp:\/\/.*):(\d+)$/) ?? [];
  return host ? `${host}:${Number(port) + PORTS[channel]}` : `ipc://${endpoint}/${channel}`;
}

// The key of this name in one of the files of keys.
function key(folder, file, name) {
  return readFileSync(`${folder}/${file}`, "utf8").match(new RegExp(`^${name} = "(.{40})"$`, "m"))[1];
}

// The options of a socket that holds these keys.
function secured(folder) {
  if (!folder) return {};
  return {
    curveServerKey: key(folder, "server.pub", "public"),
    curvePublicKey: key(folder, "client.key", "public"),
    curveSecretKey: key(folder, "client.key", "secret"),
  };
}

// A socket that hears the channel from now on.
function attach(endpoint, channel, options) {
  const socket = new Subscriber(options);
  socket.subscribe("");
  socket.connect(address(endpoint, channel)); // the pipeline may come later
  return socket;
}

// The kind and the fields of each message.
async function* messages(socket) {
  for await (const [data] of socket) {
    const [version, kind, fields] = decode(data);
    if (version !== 2) throw new Error("this catstream speaks another protocol");
    yield { kind, fields };
  }
}

// Length of a vector as it travels: dtype "<f4", shape, and the bytes of its numbers.
function norm({ data }) {
  const numbers = new Float32Array(new Uint8Array(data).buffer); // copied, so that it begins on a multiple of four
  return Math.hypot(...numbers);
}

async function followModels(models) {
  let version = 0;
  for await (const { fields: model } of messages(models)) {
    if (model.version === version) continue; // the last one may come twice
    version = model.version;
    console.log(`model ${version} of frame ${model.frame}, norm ${norm(model.weights).toFixed(4)}`);
  }
}

async function followTracks(tracks) {
  let seq = 0;
  let missed = 0;
  for await (const { kind, fields: track } of messages(tracks)) {
    if (seq) missed += Math.max(0, track.seq - seq - 1); // who comes late has missed nothing
    seq = track.seq;
    if (kind === "end") {
      console.log(`end: ${track.reason}, ${missed} tracks missed`);
      return;
    }
    const box = track.box?.map((side) => side.toFixed(1)).join(",") ?? "-";
    console.log(`track ${track.frame} ${track.state} ${box} ${track.score.toFixed(3)}`);
  }
}

const [endpoint, keys] = process.argv.slice(2);
if (!endpoint) {
  console.error("usage: node subscriber.mjs ENDPOINT [KEYS] (a folder, or tcp://127.0.0.1:PORT; a folder of keys)");
  process.exit(1);
}
const tracks = attach(endpoint, "tracks", secured(keys));
const models = attach(endpoint, "models", { conflate: true, ...secured(keys) });
const following = followModels(models);
await followTracks(tracks);
models.close(); // ends the other loop
await following;
