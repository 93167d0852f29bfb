// A subscriber in Node.js, with zeromq and @msgpack/msgpack.
//
//     npm ci --prefix examples
//     catstream track walk.mp4 --box 120,80,64,48 --set run.endpoint=run
//     node examples/subscriber.mjs run
//
// If the pipeline requires keys, give their folder as the second argument.
//
// Prints every track and each new model, with the name of its object, until the pipeline ends. docs/protocol.md
// describes the messages.

import { readFileSync } from "node:fs";

import { decode } from "@msgpack/msgpack";
import { Subscriber } from "zeromq";

const PORTS = { models: 2, tracks: 3 }; // offset from the port of the endpoint

// The address of a channel; the endpoint is a folder of sockets, or tcp://127.0.0.1:PORT.
function address(endpoint, channel) {
  const [, host, port] = endpoint.match(/^(tcp:\/\/.*):(\d+)$/) ?? [];
  return host ? `${host}:${Number(port) + PORTS[channel]}` : `ipc://${endpoint}/${channel}`;
}

// The key of this name in one of the files of keys.
function key(folder, file, name) {
  return readFileSync(`${folder}/${file}`, "utf8").match(new RegExp(`^${name} = "(.{40})"$`, "m"))[1];
}

// The options of a socket that uses these keys.
function secured(folder) {
  if (!folder) return {};
  return {
    curveServerKey: key(folder, "server.pub", "public"),
    curvePublicKey: key(folder, "client.key", "public"),
    curveSecretKey: key(folder, "client.key", "secret"),
  };
}

// A socket that subscribes to a channel.
function attach(endpoint, channel, options) {
  const socket = new Subscriber(options);
  socket.subscribe("");
  socket.connect(address(endpoint, channel)); // the pipeline may start later
  return socket;
}

// The kind and the fields of each message.
async function* messages(socket) {
  for await (const [data] of socket) {
    const [version, kind, , , fields] = decode(data);
    if (version !== 5) throw new Error("this catstream speaks another protocol");
    yield { kind, fields };
  }
}

// The Euclidean norm of an encoded vector: dtype "<f4", shape, and bytes.
function norm({ data }) {
  const numbers = new Float32Array(new Uint8Array(data).buffer); // copied, so that it begins on a multiple of four
  return Math.hypot(...numbers);
}

async function followModels(models) {
  const versions = new Map(); // of the last model of each object
  for await (const { fields: model } of messages(models)) {
    if (versions.get(model.object) === model.version) continue; // the last model may arrive twice
    versions.set(model.object, model.version);
    const length = `norm ${norm(model.weights).toFixed(4)}`;
    console.log(`model ${model.version} of frame ${model.frame}, ${length} ${model.object}`.trimEnd());
  }
}

async function followTracks(tracks) {
  let expected = 0; // number of the next frame
  let missed = 0;
  for await (const { kind, fields: track } of messages(tracks)) {
    if (expected) missed += Math.max(0, track.frame - expected);
    expected = track.frame + 1;
    if (kind === "end") {
      console.log(`end: ${track.reason}, ${missed} tracks missed`);
      return;
    }
    const box = track.box?.map((side) => side.toFixed(1)).join(",") ?? "-";
    console.log(`track ${track.frame} ${track.state} ${box} ${track.score.toFixed(3)} ${track.object}`.trimEnd());
  }
}

const [endpoint, keys] = process.argv.slice(2);
if (!endpoint) {
  console.error("usage: node subscriber.mjs ENDPOINT [KEYS] (a folder, or tcp://127.0.0.1:PORT; a folder of keys)");
  process.exit(1);
}
const tracks = attach(endpoint, "tracks", secured(keys));
const models = attach(endpoint, "models", secured(keys));
const following = followModels(models);
await followTracks(tracks);
models.close(); // ends the other loop
await following;
