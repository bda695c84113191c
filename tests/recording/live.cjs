#!/usr/bin/env node
// Follows a flight with an independent client: Foxglove's `@foxglove/ws-protocol`, which its own viewer used, with
// `protobufjs` for the types that the recorder describes.
//
// It looks for a picture with the stamp of each of some overlays, and prints the result as one JSON object.
//
//     npm install @foxglove/ws-protocol protobufjs ws        (NODE_PATH is where)
//     node tests/recording/live.cjs ws://127.0.0.1:8765 foxglove.websocket.v1
//
// Exit status: 0 found, 1 something is wrong, 77 a package is missing.

"use strict";

let FoxgloveClient, WebSocket, protobuf;
try {
  ({ FoxgloveClient } = require("@foxglove/ws-protocol"));
  ({ WebSocket } = require("ws"));
  protobuf = require("protobufjs");
  require("protobufjs/ext/descriptor");
} catch (problem) {
  console.log(`skipped: ${problem.message.split("\n")[0]} (npm install @foxglove/ws-protocol protobufjs ws)`);
  process.exit(77);
}

const [address, subprotocol] = process.argv.slice(2);
const OVERLAYS = 20;
const PATIENCE_MS = 60_000;

const channels = new Map(); // by topic
const subscribed = new Map(); // channel and decoder by subscription
const counts = {};
const pictures = new Set();
const overlays = [];
const lines = [];
let server, warning, firstBytes, newestMs;

function fail(why) {
  console.log(`${why}; ${JSON.stringify({ server, counts, warning })}`);
  process.exit(1);
}

function decoder(channel) {
  if (channel.encoding === "json") {
    return (data) => JSON.parse(new TextDecoder().decode(data));
  }
  const types = protobuf.Root.fromDescriptor(
    protobuf.descriptor.FileDescriptorSet.decode(Buffer.from(channel.schema, "base64")),
  );
  const type = types.lookupType(channel.schemaName);
  return (data) => type.decode(new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
}

const stamp = (time) => `${time.seconds}.${time.nanos}`;

function end() {
  const paired = overlays.filter((it) => pictures.has(it)).length;
  const topics = Object.fromEntries([...channels].map(([topic, it]) => [topic, it.schemaName]));
  console.log(
    JSON.stringify({
      server: server.name,
      topics,
      counts,
      overlays: overlays.length,
      paired,
      firstBytes,
      lines,
      newestMs,
      warning,
    }),
  );
  process.exit(0);
}

function connect() {
  const ws = new WebSocket(address, [subprotocol]);
  const client = new FoxgloveClient({ ws });
  client.on("open", () => {
    if (ws.protocol !== subprotocol) fail(`the protocol is ${ws.protocol}`);
  });
  // The recorder may not be there yet.
  client.on("error", (problem) => {
    if (problem.code === "ECONNREFUSED") setTimeout(connect, 200);
    else fail(`${problem}`);
  });
  client.on("close", () => server && fail("the recorder closed the connection"));
  client.on("serverInfo", (info) => (server = info));
  client.on("status", (status) => (warning = status.message));
  client.on("advertise", (advertised) => {
    for (const channel of advertised) {
      if (channels.has(channel.topic)) fail(`${channel.topic} is advertised twice`);
      channels.set(channel.topic, channel);
      subscribed.set(client.subscribe(channel.id), { channel, decode: decoder(channel) });
    }
  });
  client.on("message", ({ subscriptionId, timestamp, data }) => {
    const { channel, decode } = subscribed.get(subscriptionId);
    const message = decode(data);
    counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
    if (channel.topic.endsWith("/picture")) {
      firstBytes ??= Buffer.from(message.data.slice(0, 3)).toString("hex");
      pictures.add(stamp(message.timestamp));
      newestMs = Date.now() - Number(timestamp / 1_000_000n);
    } else if (channel.topic.endsWith("/overlay")) {
      overlays.push(...message.texts.map((text) => stamp(text.timestamp)));
      // The picture of the last one has come before it.
      if (overlays.length >= OVERLAYS) setTimeout(end, 500);
    } else if (channel.topic === "log") {
      lines.push(message.message);
    }
  });
}

setTimeout(() => fail("nothing was found in time"), PATIENCE_MS);
connect();
