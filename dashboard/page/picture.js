// @ts-check
// Draws pictures together with their detections. Runs in a worker, or on the page where workers are missing.

const RECONNECT_MS = 500;
const MAX_RECONNECT_MS = 2000;
/** A connection with a message within this time does not hang, in milliseconds. */
const ALIVE_MS = 1000;
/** Messages that request refused candidates from the server, and end that request. */
const REFUSED = 'refused';
const NOTHING_REFUSED = 'nothing refused';

/** Receives the pictures: `reconnect` connects again if nothing arrives, `showRefused` turns refused candidates on or off.
 * @typedef {{ reconnect: () => void, showRefused: (on: boolean) => void }} Follower */

/** Receives the pictures and draws each; `report` gets a message for each, and for the end of a connection.
 * @param {HTMLCanvasElement | OffscreenCanvas} canvas @param {string} address @param {(message: any) => void} report @returns {Follower} */
export function follow(canvas, address, report) {
  const context = /** @type {any} */ (canvas.getContext('2d', { alpha: false }));
  let pause = RECONNECT_MS;
  let drawn = 0;
  let receivedAt = -Infinity;
  let timer = 0;
  let showsRefused = false;
  /** @type {WebSocket | null} */
  let current = null;
  const connect = () => {
    const socket = new WebSocket(address);
    current = socket;
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => {
      pause = RECONNECT_MS;
      if (showsRefused) socket.send(REFUSED);
    };
    /** @param {ArrayBuffer} message */
    const show = async (message) => {
      const { header, bitmaps } = await decode(message);
      // A picture of a closed connection is not drawn over a newer one.
      if (socket !== current) return;
      // The candidates may have been requested by another browser only.
      if (!showsRefused) header.refused = null;
      draw(canvas, context, header, bitmaps);
      drawn += 1;
      // Only drawn pictures are acknowledged, so at most two are in transit.
      if (socket.readyState === WebSocket.OPEN) socket.send(String(header.number));
      report({ kind: 'drawn', header, drawn });
    };
    // One after the other, so that no picture is drawn over a newer one.
    let last = Promise.resolve();
    socket.onmessage = (event) => {
      receivedAt = performance.now();
      last = last.then(() => show(event.data)).catch(() => socket.close());
    };
    socket.onclose = () => {
      if (socket !== current) return;
      report({ kind: 'closed' });
      timer = Number(setTimeout(connect, pause));
      pause = Math.min(2 * pause, MAX_RECONNECT_MS);
    };
  };
  connect();
  const reconnect = () => {
    if (performance.now() - receivedAt < ALIVE_MS) return;
    clearTimeout(timer);
    const old = current;
    connect();
    old?.close();
  };
  /** @param {boolean} on */
  const showRefused = (on) => {
    showsRefused = on;
    if (current?.readyState === WebSocket.OPEN) current.send(on ? REFUSED : NOTHING_REFUSED);
  };
  return { reconnect, showRefused };
}

/** Header and bitmaps of a message. @param {ArrayBuffer} message */
async function decode(message) {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  let at = 4 + length;
  const full = { x: 0, y: 0, width: header.width, height: header.height, scale: 1, bytes: message.byteLength - at };
  const parts = header.parts.length > 0 ? header.parts : [full];
  const bitmaps = [];
  for (const part of parts) {
    const file = new Blob([new Uint8Array(message, at, part.bytes)], { type: 'image/jpeg' });
    at += part.bytes;
    try {
      bitmaps.push({ part, bitmap: await createImageBitmap(file) });
    } catch {
      // The area of a damaged part stays black.
    }
  }
  return { header, bitmaps };
}

/** Draws the parts, the finest on top, and the detections.
 * @param {HTMLCanvasElement | OffscreenCanvas} canvas @param {any} context @param {any} header @param {any[]} bitmaps */
function draw(canvas, context, header, bitmaps) {
  if (canvas.width !== header.width || canvas.height !== header.height) {
    canvas.width = header.width;
    canvas.height = header.height;
  }
  // Detections are never drawn over another picture, also if this one is damaged.
  context.fillStyle = '#000';
  context.fillRect(0, 0, canvas.width, canvas.height);
  for (const { part, bitmap } of bitmaps.reverse()) {
    context.drawImage(bitmap, part.x, part.y, part.width * part.scale, part.height * part.scale);
    bitmap.close();
  }
  // The centre of the first pixel is (0, 0) in detections, and (0.5, 0.5) on a canvas.
  context.save();
  context.translate(0.5, 0.5);
  const unit = header.width / 650;
  refusals(context, header.refused ?? [], unit);
  for (const marker of header.markers ?? []) {
    overlay(context, marker, unit, header.is_used ? '#59ff8b' : '#ffd166');
  }
  context.restore();
}

/** Draws outlines of refused candidates, with the reasons where there is room for them.
 * @param {any} context @param {any[]} refused @param {number} unit */
function refusals(context, refused, unit) {
  context.lineWidth = unit;
  context.strokeStyle = '#ff8cf0';
  context.font = `${Math.round(9 * unit)}px sans-serif`;
  /** @type {number[][]} */
  const written = [];
  for (const { reason, corners, edges } of refused) {
    context.beginPath();
    for (const { centre: [u, v], axes: [minor, major], angle } of edges ?? []) {
      context.moveTo(u + (minor / 2) * Math.cos(angle), v + (minor / 2) * Math.sin(angle));
      context.ellipse(u, v, minor / 2, major / 2, angle, 0, 2 * Math.PI);
    }
    for (const [u, v] of corners ?? []) context.lineTo(u, v);
    context.closePath();
    context.stroke();
    const points = corners ?? edges.map((/** @type {any} */ it) => [it.centre[0] - it.axes[1] / 2, it.centre[1] + it.axes[1] / 2]);
    const x = Math.min(...points.map((/** @type {number[]} */ it) => it[0]));
    const y = Math.max(...points.map((/** @type {number[]} */ it) => it[1]));
    const width = context.measureText(reason).width;
    // The largest come first, and their text is not covered.
    const isFree = written.every(([left, base, wide]) => Math.abs(base - y) > 11 * unit || x > left + wide || left > x + width);
    if (isFree) {
      context.fillStyle = 'rgba(0, 0, 0, 0.7)';
      context.fillRect(x - unit, y, width + 2 * unit, 11 * unit);
      context.fillStyle = '#ff8cf0';
      context.fillText(reason, x, y + 9 * unit);
      written.push([x, y, width]);
    }
  }
}

/** Draws outline, centre and name of a marker.
 * @param {any} context @param {any} marker @param {number} unit @param {string} colour */
function overlay(context, marker, unit, colour) {
  const [u, v] = marker.centre;
  context.lineWidth = 1.6 * unit;
  context.strokeStyle = colour;
  context.beginPath();
  if (marker.corners) {
    const [first, ...rest] = marker.corners;
    context.moveTo(first[0], first[1]);
    for (const corner of rest) context.lineTo(corner[0], corner[1]);
    context.closePath();
  } else {
    context.arc(u, v, marker.size / 2, 0, 2 * Math.PI);
  }
  context.stroke();
  context.beginPath();
  context.moveTo(u - 6 * unit, v);
  context.lineTo(u + 6 * unit, v);
  context.moveTo(u, v - 6 * unit);
  context.lineTo(u, v + 6 * unit);
  context.stroke();
  const distance = marker.distance_m === null ? '' : ` ${marker.distance_m.toFixed(2)} m`;
  const text = `${marker.name}${distance}`;
  context.font = `${Math.round(12 * unit)}px sans-serif`;
  const width = context.measureText(text).width;
  const x = Math.max(0, Math.min(u + marker.size / 2 + 4 * unit, context.canvas.width - width - 8 * unit));
  const y = Math.max(14 * unit, Math.min(v, context.canvas.height - 4 * unit));
  context.fillStyle = 'rgba(0, 0, 0, 0.7)';
  context.fillRect(x, y - 13 * unit, width + 8 * unit, 17 * unit);
  context.fillStyle = colour;
  context.fillText(text, x + 4 * unit, y);
}
